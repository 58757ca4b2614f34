"""A few Gaussians of every kind."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from wildgs.exporters.splats import Splats

CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-background-networking",
    "--ignore-gpu-blocklist",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A headless Chromium from the PATH with software WebGL; tests that use it carry the marker `chromium`."""
    sync_api = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=CHROMIUM_FLAGS)
        yield browser
        browser.close()
