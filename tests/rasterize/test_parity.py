"""Every backend against the dense reference in float64: values and gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize import Projection, Rendering, blend, project

BACKENDS = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


@dataclass
class Case:
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    camera: Camera

    def inputs(self) -> list[Tensor]:
        return [self.means, self.quats, self.scales, self.opacities, self.colors]


def pinhole(width: int, height: int, focal: float | None = None) -> Camera:
    focal = focal or 0.9 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal * 1.1, height / 2 - 1], [0, 0, 1]])
    angle = torch.tensor(0.2)
    viewmat = torch.eye(4)
    viewmat[:2, :2] = torch.stack(
        [torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])]
    )
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    return Camera(viewmat, K, width, height)


def random_case(
    count: int, width: int, height: int, size: float = 0.05, channels: int = 3, seed: int = 0
) -> Case:
    g = torch.Generator().manual_seed(seed)
    camera = pinhole(width, height)
    z = 2 + 4 * torch.rand(count, generator=g)
    xy = (torch.rand(count, 2, generator=g) - 0.5) * z[:, None] * torch.tensor([1.2, 1.2 * height / width])
    return Case(
        means=torch.cat([xy, z[:, None]], 1),
        quats=torch.randn(count, 4, generator=g),
        scales=torch.exp(math.log(size) + 0.5 * torch.randn(count, 3, generator=g)),
        opacities=torch.rand(count, generator=g),
        colors=torch.rand(count, channels, generator=g),
        camera=camera,
    )


def render(case: Case, backend: str, dtype: torch.dtype) -> tuple[Projection, Rendering, dict[str, Tensor]]:
    """Renders, and pulls fixed random gradients back to every input."""
    device = "cuda" if backend == "cuda" else "cpu"
    inputs = [t.detach().clone().to(device, dtype).requires_grad_() for t in case.inputs()]
    channels = case.colors.shape[1]
    background = torch.linspace(0.2, 0.8, channels).to(device, dtype).detach().requires_grad_()
    projection = project(*inputs[:4], case.camera.to(device), backend=backend, absgrad=True)
    projection.means2d.retain_grad()
    rendering = blend(projection, inputs[4], background=background)
    g = torch.Generator().manual_seed(9)
    pictures = [rendering.colors, rendering.depth, rendering.alpha]
    pulls = [torch.rand(p.shape, generator=g, dtype=torch.float64).to(p) for p in pictures]
    if any(p.requires_grad for p in pictures):
        torch.autograd.backward(pictures, pulls)
    names = ["means", "quats", "scales", "opacities", "colors"]
    grads = {name: t.grad for name, t in zip(names, inputs, strict=True)}
    grads |= {
        "background": background.grad,
        "means2d": projection.means2d.grad,
        "absgrad": projection.absgrad,
    }
    return projection, rendering, {k: torch.zeros(()) if v is None else v.cpu() for k, v in grads.items()}


def assert_same(case: Case, backend: str, tolerance: float = 1e-4) -> None:
    """Values to `tolerance` of each picture's largest, gradients to `tolerance` of each tensor's largest.

    Where float32 puts a pixel on the other side of a threshold (alpha 1/255, the cap, the stop) single numbers
    differ by more; they may be one in a thousand.
    """
    projection, rendering, grads = render(case, backend, torch.float32)
    expected_projection, expected, expected_grads = render(case, "reference", torch.float64)
    assert torch.equal(projection.visible.cpu(), expected_projection.visible)
    assert ((projection.radii.cpu() - expected_projection.radii).abs() <= 1).all()
    pairs = {k: (getattr(rendering, k), getattr(expected, k)) for k in ("colors", "depth", "alpha")}
    pairs |= {
        k: (getattr(projection, k), getattr(expected_projection, k)) for k in ("means2d", "depths", "conics")
    }
    pairs |= {f"gradient of {k}": (grads[k], expected_grads[k]) for k in grads}
    for name, (value, truth) in pairs.items():
        difference = (value.detach().cpu().double() - truth.detach()).abs()
        scale = truth.detach().abs().max().clamp(min=1e-2) if truth.numel() else torch.ones(())
        assert value.isfinite().all(), name
        outliers = (difference > tolerance * scale).double().mean() if truth.numel() else torch.zeros(())
        assert outliers <= 1e-3, f"{name}: {outliers:.2%} differ, by up to {difference.max() / scale:.2e}"


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (37, 53), (16, 16), (1, 1), (100, 3)])
def test_pictures_of_any_shape(backend: str, width: int, height: int):
    assert_same(random_case(200, width, height), backend)
