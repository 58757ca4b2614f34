"""A small Wild-GS that runs in milliseconds, and a wall that it looks at."""

from __future__ import annotations

import pytest
import torch

from wildgs.geometry.camera import Camera
from wildgs.model.encoder import load_encoder
from wildgs.model.fusion import FusionConfig
from wildgs.model.parsing import ParsingConfig
from wildgs.model.sky import SkyConfig
from wildgs.model.wildgs import Ablation, WildGS, WildGSConfig
from wildgs.model.wrapping import WrappingConfig

WIDTH, HEIGHT, WALL_DEPTH = 40, 32, 2.0


@pytest.fixture
def camera() -> Camera:
    K = torch.tensor([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), K, WIDTH, HEIGHT)


@pytest.fixture
def wall() -> torch.Tensor:
    """Points on the plane z = 2, denser than pixels, wider than the picture."""
    x, y = torch.meshgrid(torch.linspace(-1.4, 1.4, 60), torch.linspace(-1.2, 1.2, 50), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, WALL_DEPTH)], dim=-1).reshape(-1, 3)


@pytest.fixture
def make_wall_model(wall: torch.Tensor):
    """Builds an opaque grey wall as Wild-GS, with parts left out on demand."""

    def make(*without: Ablation, embedding_noise: float = 0.0, **config: object) -> WildGS:
        torch.manual_seed(0)
        settings = WildGSConfig(
            local_embeddings=True,
            sky=SkyConfig(points=0),
            fusion=FusionConfig(sh_degree=3),
            without=without,
            embedding_noise=embedding_noise,
            parsing=ParsingConfig(max_side=32),
            wrapping=WrappingConfig(resolution=16, features=8, widths=(8, 8), **config),  # type: ignore[arg-type]
        )
        colors = torch.full((len(wall), 3), 128, dtype=torch.uint8)
        model = WildGS.from_points(settings, wall, colors, encoder=load_encoder(None))
        with torch.no_grad():
            model.gaussians.rows["opacity_logits"].fill_(6.0)
        return model

    return make
