"""Colours from spherical harmonics: the fused kernel against the polynomials in torch."""

from __future__ import annotations

import pytest
import torch

from wildgs.geometry.camera import Camera
from wildgs.rasterize import sh_to_colors


def camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.3, -0.2, 1.0])
    return Camera(viewmat, torch.eye(3), 8, 8)


def inputs(dtype: torch.dtype, count: int = 700) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    means, sh = torch.randn(count, 3, generator=g), 0.5 * torch.randn(count, 16, 3, generator=g)
    return means.to(dtype).detach().requires_grad_(), sh.to(dtype).detach().requires_grad_()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("partly", "clamped"), [(False, True), (True, True), (True, False)])
def test_values_and_gradients_match_torch_in_float64(degree: int, partly: bool, clamped: bool):
    visible = torch.arange(700) % 3 > 0 if partly else None
    results = []
    for dtype in (torch.float32, torch.float64):
        means, sh = inputs(dtype)
        colors = sh_to_colors(means, sh, camera(), degree=degree, visible=visible, clamped=clamped)
        assert bool((colors < 0).any()) == (degree > 0 and not clamped)
        colors.backward(torch.linspace(-1, 1, colors.numel(), dtype=dtype).reshape(colors.shape))
        results.append((colors.detach(), torch.zeros(()) if means.grad is None else means.grad, sh.grad))
    for value, truth in zip(*results, strict=True):
        assert torch.allclose(value.double(), truth.double(), atol=2e-5, rtol=1e-4)
    if partly:
        assert not results[0][0][~visible].any()
        assert not results[0][2][~visible].any()


def test_colours_are_clamped_at_zero_without_gradient():
    means, sh = torch.tensor([[0.0, 0.0, 5.0]]), torch.full((1, 1, 3), -9.0, requires_grad=True)
    colors = sh_to_colors(means, sh, camera(), degree=0)
    colors.sum().backward()
    assert not colors.any()
    assert not sh.grad.any()


def test_a_gaussian_at_the_camera_gives_finite_numbers():
    means = camera().position[None].clone().requires_grad_()
    sh = torch.randn(1, 16, 3, requires_grad=True)
    colors = sh_to_colors(means, sh, camera(), degree=3)
    colors.sum().backward()
    assert colors.isfinite().all()
    assert means.grad.isfinite().all()
    assert sh.grad.isfinite().all()


def test_too_few_coefficients():
    with pytest.raises(ValueError, match="needs 9"):
        sh_to_colors(torch.zeros(2, 3), torch.zeros(2, 4, 3), camera(), degree=2)
