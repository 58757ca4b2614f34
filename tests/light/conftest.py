"""A tiny untrained Wild-GS among eight photos of a striped wall, every second one dark."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.memory_views import make_view
from wildgs.geometry.camera import Camera
from wildgs.model.encoder import load_encoder
from wildgs.model.parsing import ParsingConfig
from wildgs.model.vanilla import VanillaConfig, VanillaGS
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.model.wrapping import WrappingConfig
from wildgs.scene import Alignment, Scene

SIDE = 32


def photograph(camera: Camera, light: float) -> torch.Tensor:
    wall = camera.unproject(torch.ones(SIDE, SIDE))
    stripes = ((wall[..., 0] * 4).floor() % 2 == 0)[..., None]
    colors = torch.where(stripes, torch.tensor([220, 60, 60]), torch.tensor([60, 60, 220]))
    return (colors * light).round().to(torch.uint8)


@pytest.fixture(scope="session")
def wall() -> Scene:
    x, y = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 24), indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    views = []
    for index in range(8):
        viewmat = torch.eye(4)
        viewmat[0, 3] = 0.15 * (index % 4 - 1.5)
        K = torch.tensor([[30.0, 0, SIDE / 2], [0, 30.0, SIDE / 2], [0, 0, 1]])
        camera = Camera(viewmat, K, SIDE, SIDE)
        photo = photograph(camera, 1.0 if index % 2 else 0.3)
        views.append(make_view(f"{index}.jpg", camera, "test" if index == 7 else "train", photo))
    colors = torch.full((len(points), 3), 128, dtype=torch.uint8)
    return Scene(Path("wall"), tuple(views), points, colors, Alignment.identity())


def _make(scene: Scene, seed: int) -> WildGS:
    torch.manual_seed(seed)
    config = WildGSConfig(
        local_embeddings=True,
        parsing=ParsingConfig(max_side=32),
        wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)),
    )
    model = WildGS.from_points(config, scene.points, scene.point_colors, encoder=load_encoder(None))
    with torch.no_grad():
        model.gaussians.rows["opacity_logits"].fill_(4.0)
    return model.eval()


@pytest.fixture(scope="session")
def method(wall: Scene) -> WildGS:
    return _make(wall, 0)


@pytest.fixture(scope="session")
def other_method(wall: Scene) -> WildGS:
    return _make(wall, 1)


@pytest.fixture
def vanilla(wall: Scene) -> VanillaGS:
    return VanillaGS.from_points(VanillaConfig(), wall.points, wall.point_colors)
