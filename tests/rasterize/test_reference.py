"""The reference's gradients against finite differences, in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize import blend, project


def small_scene() -> tuple[list[Tensor], Camera]:
    """Three overlapping Gaussians, far from every threshold of the blend but its lower one on alpha."""
    camera = Camera(torch.eye(4), torch.tensor([[8.0, 0, 3], [0, 9.0, 2.5], [0, 0, 1]]), 6, 5)
    means = torch.tensor([[0.05, 0.02, 2.0], [-0.2, 0.1, 3.0], [0.3, -0.2, 4.0]])
    quats = torch.tensor([[0.9, 0.1, -0.3, 0.2], [0.4, -0.5, 0.6, 0.1], [1.0, 0.2, 0.3, -0.7]])
    scales = torch.tensor([[1.5, 1.2, 0.9], [2.0, 1.1, 1.4], [2.2, 1.9, 1.6]])
    opacities, colors = torch.tensor([0.6, 0.8, 0.7]), torch.tensor([[0.1, 0.5], [0.9, 0.3], [0.4, 0.8]])
    inputs = [means, quats, scales, opacities, colors, torch.tensor([0.3, 0.6])]
    return [t.double().requires_grad_() for t in inputs], camera


def test_gradients_match_finite_differences():
    inputs, camera = small_scene()

    def render(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        projection = project(*tensors[:4], camera, backend="reference")
        rendering = blend(projection, tensors[4], background=tensors[5])
        return rendering.colors, rendering.depth, rendering.alpha

    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6)


def test_projection_gradients_match_finite_differences():
    inputs, camera = small_scene()

    def geometry(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        projection = project(*tensors, camera, backend="reference")
        return projection.means2d, projection.depths, projection.conics

    assert torch.autograd.gradcheck(geometry, inputs[:4], eps=1e-6, atol=1e-6)


def test_one_gaussian_by_hand():
    """A round Gaussian straight ahead: its variance in pixels is (focal scale / depth)^2 + 0.3."""
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 2.5], [0, 10.0, 2.5], [0, 0, 1]]), 5, 5)
    for backend in ("reference", "cpu"):
        projection = project(
            torch.tensor([[0.0, 0, 4]]),
            torch.tensor([[1.0, 0, 0, 0]]),
            torch.full((1, 3), 0.4),
            torch.tensor([0.5]),
            camera,
            backend=backend,
        )
        rendering = blend(projection, torch.tensor([[0.2, 0.4, 0.8]]), background=torch.tensor([1.0, 0, 0]))
        offset = torch.arange(5) - 2.0
        squares = offset[:, None] ** 2 + offset[None] ** 2
        alpha = 0.5 * torch.exp(-0.5 * squares / 1.3)
        alpha[alpha < 1 / 255] = 0
        assert torch.allclose(rendering.alpha, alpha, atol=1e-6)
        expected = alpha[..., None] * torch.tensor([0.2, 0.4, 0.8])
        expected[..., 0] += 1 - alpha
        assert torch.allclose(rendering.colors, expected, atol=1e-6)
        assert torch.allclose(rendering.depth, torch.where(alpha > 0, 4.0, 0.0), atol=1e-5)
