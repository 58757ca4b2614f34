"""What must hold for any Gaussians, and for any number of threads."""

from __future__ import annotations

import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize import Rendering, blend, project, rasterize

seeds = st.integers(0, 2**31 - 1)


def scene(seed: int, count: int, width: int = 45, height: int = 35) -> tuple[list[Tensor], Camera]:
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=g) + torch.tensor([0.0, 0.0, 3.0])
    scales = torch.exp(1.2 * torch.randn(count, 3, generator=g) - 3)
    opacities, colors = torch.rand(count, generator=g) * 1.02, torch.rand(count, 3, generator=g)
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 22], [0, 42.0, 17], [0, 0, 1]]), width, height)
    return [means, torch.randn(count, 4, generator=g), scales, opacities.clamp(max=1), colors], camera


def gradients(inputs: list[Tensor], camera: Camera) -> tuple[Rendering, list[Tensor]]:
    inputs = [t.clone().requires_grad_() for t in inputs]
    rendering = rasterize(*inputs, camera)
    (rendering.colors.square().sum() + rendering.depth.sum() + rendering.alpha.sum()).backward()
    return rendering, [t.grad for t in inputs]


@settings(max_examples=25, deadline=None)
@given(seed=seeds, count=st.integers(1, 150))
def test_order_of_gaussians_does_not_matter(seed: int, count: int):
    inputs, camera = scene(seed, count)
    shuffle = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    rendering, grads = gradients(inputs, camera)
    shuffled, shuffled_grads = gradients([t[shuffle] for t in inputs], camera)
    # Depths are all different here, so that the same sums are done in the same order.
    assert torch.equal(rendering.colors, shuffled.colors)
    assert torch.equal(rendering.depth, shuffled.depth)
    for grad, other in zip(grads, shuffled_grads, strict=True):
        assert torch.equal(grad[shuffle], other)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, count=st.integers(0, 150))
def test_alpha_background_and_depth_bounds(seed: int, count: int):
    inputs, camera = scene(seed, count)
    background = torch.tensor([0.3, 0.6, 0.9])
    black, coloured = rasterize(*inputs, camera), rasterize(*inputs, camera, background=background)
    assert ((black.alpha >= 0) & (black.alpha <= 1)).all()
    assert torch.allclose(
        coloured.colors, black.colors + (1 - black.alpha)[..., None] * background, atol=1e-6
    )
    seen = black.alpha > 0
    assert not black.depth[~seen].any()
    if seen.any():
        depths = inputs[0][:, 2]
        assert (black.depth[seen] >= depths[depths > 0.01].min() - 1e-4).all()
        assert (black.depth[seen] <= depths.max() + 1e-4).all()


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_a_constant_colour_comes_out_as_alpha(seed: int):
    inputs, camera = scene(seed, 80)
    rendering = blend(project(*inputs[:4], camera), torch.ones(80, 1))
    assert torch.allclose(rendering.colors[..., 0], rendering.alpha, atol=2e-6)


@pytest.mark.parametrize("threads", ["2", "3", "7"])
def test_any_number_of_threads_gives_the_same_bits(threads: str, monkeypatch: pytest.MonkeyPatch):
    inputs, camera = scene(4, 5000, 150, 130)
    monkeypatch.setenv("WILDGS_NUM_THREADS", "1")
    rendering, grads = gradients(inputs, camera)
    monkeypatch.setenv("WILDGS_NUM_THREADS", threads)
    other, other_grads = gradients(inputs, camera)
    assert torch.equal(rendering.colors, other.colors)
    assert torch.equal(rendering.depth, other.depth)
    for grad, other_grad in zip(grads, other_grads, strict=True):
        assert torch.equal(grad, other_grad)


def test_equal_depths_blend_in_the_order_given():
    inputs, camera = scene(0, 400)
    inputs[0][:, 2] = 3.0
    inputs[0][:, :2] *= 0.1
    inputs[2][:] = 0.3
    cpu, reference = rasterize(*inputs, camera), rasterize(*inputs, camera, backend="reference")
    assert torch.allclose(cpu.colors, reference.colors, atol=1e-4)


def test_one_projection_blends_many_times():
    inputs, camera = scene(1, 200)
    inputs = [t.requires_grad_() for t in inputs]
    projection = project(*inputs[:4], camera)
    with torch.no_grad():
        first = blend(projection, None)
    both = blend(projection, inputs[4])
    assert first.colors.shape == (35, 45, 0)
    assert not first.depth.requires_grad
    assert torch.equal(first.depth, both.depth)
    assert torch.equal(first.alpha, both.alpha)
    other = blend(projection, torch.rand(200, 5), depth=False)
    assert torch.equal(other.alpha, both.alpha)
    assert not other.depth.any()
    (both.colors.sum() + other.alpha.sum()).backward()
    assert inputs[0].grad.abs().sum() > 0


def test_depth_gradients_reach_depths_and_alpha():
    inputs, camera = scene(2, 50)
    inputs = [t.requires_grad_() for t in inputs]
    projection = project(*inputs[:4], camera)
    projection.depths.retain_grad()
    blend(projection, None).depth.sum().backward()
    assert projection.depths.grad.abs().sum() > 0
    assert inputs[3].grad.abs().sum() > 0


def test_several_threads_render_at_once():
    inputs, camera = scene(3, 3000, 100, 90)
    expected, _ = gradients(inputs, camera)
    results: list[Tensor] = []
    jobs = [
        threading.Thread(target=lambda: results.append(gradients(inputs, camera)[0].colors)) for _ in range(4)
    ]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    assert len(results) == 4
    assert all(torch.equal(picture, expected.colors) for picture in results)


@settings(max_examples=25, deadline=None)
@given(size=st.floats(0.3, 3.0), eps2d=st.floats(0.2, 0.5), along=st.floats(1.0, 3.0))
def test_antialiased_gaussians_cover_as_much_as_without_the_filter(size: float, eps2d: float, along: float):
    """The sum of alpha over the pixels is that of the unfiltered footprint, where the classic mode enlarges it."""
    camera = Camera(torch.eye(4), torch.tensor([[32.0, 0, 32], [0, 32.0, 32], [0, 0, 1]]), 64, 64)
    inputs = [torch.tensor([[0.02, 0.01, 1.0]]), torch.tensor([[1.0, 0, 0, 0]])]
    inputs += [torch.tensor([[size * along, size, size]]) / 32, torch.tensor([0.9]), torch.ones(1, 3)]
    expected = 0.9 * 2 * torch.pi * size * size * along
    covered = {
        antialiased: float(rasterize(*inputs, camera, eps2d=eps2d, antialiased=antialiased).alpha.sum())
        for antialiased in (False, True)
    }
    # Alpha below 1/255 is cut off: of a peak of 0.2, 2%.
    assert covered[True] == pytest.approx(expected, rel=0.1)
    assert covered[False] > covered[True]
