"""Discs that continue the ground: flat, opaque, overlapping, and part of a model where there are some."""

from __future__ import annotations

import torch

from wildgs.geometry.camera import Camera
from wildgs.model.encoder import load_encoder
from wildgs.model.gaussians import Gaussians
from wildgs.model.initial import ground_rows, initial_from_points
from wildgs.model.parsing import ParsingConfig
from wildgs.model.sky import SkyConfig
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.rasterize import blend


def grid(spacing: float) -> torch.Tensor:
    x, y = torch.meshgrid(torch.arange(-1, 1, spacing), torch.arange(-1, 1, spacing), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)


def test_who_stands_on_it_sees_no_hole() -> None:
    """A camera 0.2 above the ground that looks down at it: all is covered, at the right depth."""
    gaussians = Gaussians(ground_rows(grid(0.04), 0.04))
    tilt = torch.tensor(0.6)
    forward = torch.stack([torch.zeros(()), tilt.cos(), -tilt.sin()])
    right = torch.tensor([1.0, 0.0, 0.0])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([0.0, -0.5, 0.2])
    K = torch.tensor([[60.0, 0, 32], [0, 60.0, 32], [0, 0, 1]])
    camera = Camera(viewmat, K, 64, 64)
    with torch.no_grad():
        seen = blend(gaussians.project(camera), None)
    lower = slice(34, 62)
    assert float(seen.alpha[lower].min()) > 0.8
    places = camera.unproject(seen.depth)[lower]
    assert float(places[..., 2].abs().mean()) < 0.02


def test_models_have_it_where_it_is_given() -> None:
    torch.manual_seed(0)
    points, colors = torch.rand(30, 3), torch.randint(0, 256, (30, 3), dtype=torch.uint8)
    config = WildGSConfig(parsing=ParsingConfig(max_side=32), sky=SkyConfig(points=0))
    ground = grid(0.5), torch.full((16, 3), 200, dtype=torch.uint8)
    initial = initial_from_points(WildGS.initial(config), points, colors, ground=ground)
    model = WildGS.create(config, initial, load_encoder(None))
    assert len(model.gaussians) == 30 + 16
    assert torch.equal(model.gaussians.means[30:].detach(), ground[0])
    sh0 = model.fusion.initial_intrinsic(torch.full((1, 3), 200 / 255))[0, :3]
    torch.testing.assert_close(model.gaussians.rows["intrinsic"][30:, :3].detach(), sh0.expand(16, 3))
