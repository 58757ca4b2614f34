"""A scene held in memory: a coloured wall photographed from a few places, under two lights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.memory_views import make_view
from wildgs.geometry.camera import Camera
from wildgs.model.parsing import ParsingConfig
from wildgs.model.sky import SkyConfig
from wildgs.model.wildgs import WildGSConfig
from wildgs.model.wrapping import WrappingConfig
from wildgs.scene import Alignment, Scene, View

SIDE = 32


@pytest.fixture
def tiny_model() -> WildGSConfig:
    return build_tiny_model()


def build_tiny_model() -> WildGSConfig:
    return WildGSConfig(
        local_embeddings=True,
        embedding_noise=0.0,
        sky=SkyConfig(points=0),
        parsing=ParsingConfig(max_side=32),
        wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8)),
    )


@pytest.fixture
def wall_scene() -> Scene:
    return build_wall_scene()


def build_wall_scene() -> Scene:
    """Stripes on the plane z = 1, eight photos, every second one dark, one held out; disparity known."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 24), indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    stripes = ((points[:, 0] * 4).floor() % 2 == 0)[:, None]
    colors = torch.where(stripes, torch.tensor([220, 60, 60]), torch.tensor([60, 60, 220])).to(torch.uint8)
    views = []
    for index in range(8):
        viewmat = torch.eye(4)
        viewmat[0, 3] = 0.15 * (index % 4 - 1.5)
        viewmat[1, 3] = 0.2 * (index // 4 - 0.5)
        K = torch.tensor([[30.0, 0, SIDE / 2], [0, 30.0, SIDE / 2], [0, 0, 1]])
        camera = Camera(viewmat, K, SIDE, SIDE)
        photo = _photograph(camera, 1.0 if index % 2 else 0.4)
        disparity = torch.linspace(0.5, 1.0, SIDE).expand(SIDE, SIDE).clone()
        views.append(_view(f"{index}.jpg", camera, "test" if index == 7 else "train", photo, disparity))
    return Scene(Path("wall"), tuple(views), points, colors, Alignment.identity())


def _photograph(camera: Camera, light: float) -> torch.Tensor:
    wall = camera.unproject(torch.ones(SIDE, SIDE))
    stripes = ((wall[..., 0] * 4).floor() % 2 == 0)[..., None]
    colors = torch.where(stripes, torch.tensor([220, 60, 60]), torch.tensor([60, 60, 220]))
    return (colors * light).round().to(torch.uint8)


def _view(name: str, camera: Camera, split, photo: torch.Tensor, disparity: torch.Tensor) -> View:
    return make_view(name, camera, split, photo, disparity=disparity)
