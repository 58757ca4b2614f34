"""A few Gaussians of every kind."""

from __future__ import annotations

import pytest
import torch

from wildgs.export.splats import Splats


@pytest.fixture
def splats() -> Splats:
    generator = torch.Generator().manual_seed(7)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Splats(
        means=2 * normal(60, 3),
        quats=3 * normal(60, 4),
        scales=(normal(60, 3) - 3).exp(),
        opacities=normal(60).sigmoid(),
        sh=torch.cat([normal(60, 1, 3), 0.2 * normal(60, 15, 3)], dim=1),
    )
