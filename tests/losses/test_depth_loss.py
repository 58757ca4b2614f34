import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.camera import Camera
from wildgs.losses.objective import depth_correlation

H, W = 30, 40
EVERYWHERE = torch.ones(H, W, dtype=torch.bool)


def plane() -> tuple[torch.Tensor, torch.Tensor]:
    """Depth of a ground plane 1.5 m under a camera that looks down at it, and its disparity (1 / depth)."""
    K = torch.tensor([[40.0, 0, W / 2], [0, 40.0, H / 2], [0, 0, 1]])
    rays = Camera(torch.eye(4), K, W, H).pixel_rays()
    pitch = math.radians(35)
    down = rays[..., 1] * math.cos(pitch) + rays[..., 2] * math.sin(pitch)
    depth = 1.5 / down
    assert (depth > 0).all()
    return depth, 1 / depth


def test_right_depth_of_a_plane_costs_little_and_inverted_depth_costs_two():
    depth, disparity = plane()
    right = depth_correlation(depth, disparity, EVERYWHERE)
    wrong = depth_correlation(depth.max() + depth.min() - depth, disparity, EVERYWHERE)
    assert right.item() < 0.15
    assert wrong.item() > 1.85
    # Where depth is linear in disparity the ends are exact.
    assert depth_correlation(5 - disparity, disparity, EVERYWHERE).item() == pytest.approx(0, abs=1e-5)
    assert depth_correlation(5 + disparity, disparity, EVERYWHERE).item() == pytest.approx(2, abs=1e-5)


def test_descent_turns_a_flat_guess_into_the_plane():
    depth, disparity = plane()
    noise = torch.rand(H, W, generator=torch.Generator().manual_seed(0))
    guess = (3 + 0.01 * noise).requires_grad_()
    optimizer = torch.optim.Adam([guess], lr=0.01)
    for _ in range(150):
        optimizer.zero_grad()
        depth_correlation(guess, disparity, EVERYWHERE).backward()
        optimizer.step()
    correlation = torch.corrcoef(torch.stack([guess.detach().flatten(), depth.flatten()]))[0, 1]
    assert correlation > 0.9


@settings(max_examples=25, deadline=None)
@given(
    scale=st.floats(0.01, 1000),
    shift=st.floats(-5, 5),
    seed=st.integers(0, 50),
)
def test_scale_and_shift_do_not_matter(scale, shift, seed):
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand(H, W, generator=generator, dtype=torch.float64) + 1
    disparity = torch.rand(H, W, generator=generator, dtype=torch.float64) + 0.1
    loss = depth_correlation(depth, disparity, EVERYWHERE)
    moved = depth_correlation(scale * (depth + shift), disparity, EVERYWHERE)
    assert moved.item() == pytest.approx(loss.item(), abs=1e-6)
    expected = 1 + torch.corrcoef(torch.stack([depth.flatten(), disparity.flatten()]))[0, 1]
    assert loss.item() == pytest.approx(expected.item(), abs=1e-9)


def test_gradient_by_finite_differences():
    generator = torch.Generator().manual_seed(2)
    depth = (torch.rand(9, 9, generator=generator, dtype=torch.float64) + 1).requires_grad_()
    disparity = torch.rand(9, 9, generator=generator, dtype=torch.float64) + 0.1
    selection = torch.rand(9, 9, generator=generator) > 0.3
    assert torch.autograd.gradcheck(lambda d: depth_correlation(d, disparity, selection, 10), (depth,))


def test_pixels_left_out_have_no_say_and_no_gradient():
    depth, disparity = plane()
    selection = EVERYWHERE.clone()
    selection[:10] = False
    disparity[:, :5] = 0
    loss = depth_correlation(depth, disparity, selection)
    spoilt = depth.clone()
    spoilt[:10] = torch.inf
    spoilt[:, :5] = torch.nan
    spoilt.requires_grad_()
    again = depth_correlation(spoilt, disparity, selection)
    again.backward()
    assert again.item() == pytest.approx(loss.item(), abs=1e-6)
    assert spoilt.grad.isfinite().all()
    assert (spoilt.grad[:10] == 0).all()
    assert (spoilt.grad[:, :5] == 0).all()
    assert spoilt.grad[12:, 8:].abs().max() > 0


@pytest.mark.parametrize(
    ("depth", "disparity", "selection"),
    [
        pytest.param(torch.full((H, W), 3.3), plane()[1], EVERYWHERE, id="constant depth"),
        pytest.param(torch.zeros(H, W), plane()[1], EVERYWHERE, id="depth all zero"),
        pytest.param(plane()[0], torch.full((H, W), 0.7), EVERYWHERE, id="constant disparity"),
        pytest.param(plane()[0], torch.zeros(H, W), EVERYWHERE, id="no estimate"),
        pytest.param(plane()[0], plane()[1], ~EVERYWHERE, id="nothing selected"),
        pytest.param(plane()[0], plane()[1], torch.arange(H * W).view(H, W) < 20, id="too few pixels"),
    ],
)
def test_without_meaning_there_is_no_loss_and_no_gradient(depth, disparity, selection):
    depth = depth.clone().requires_grad_()
    loss = depth_correlation(depth, disparity, selection)
    loss.backward()
    assert loss.item() == 0
    assert torch.equal(depth.grad, torch.zeros(H, W))
