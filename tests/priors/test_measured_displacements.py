"""Of residuals, the smooth part is a displacement of the photo, and the rest is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float

from tests.memory_views import make_view
from wildgs.geometry.camera import Camera
from wildgs.priors.config import LEAST_SHARE
from wildgs.priors.measured_displacements import (
    MeasuredDisplacements,
    measured_displacements,
    scene_covariance,
)
from wildgs.scene import DataConfig, View, load_scene
from wildgs.scene.residuals import Residuals

WIDTH, HEIGHT, CELLS, PHOTOS = 96, 64, 12, 6
SIDE = 320
"""Displacements are given in pixels of photos whose longer side has this many."""


def views(count: int = PHOTOS) -> list[View]:
    camera = Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
    black = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return [make_view(f"{index}.jpg", camera, "train", black) for index in range(count)]


def bend(photo: int, places: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
    """A smooth field of half a pixel, another one in each photo."""
    x, y = places.T
    return 0.5 / SIDE * np.stack([np.sin(9 * x + photo), np.cos(9 * y + 2 * photo)], axis=1)


def measured(noise: float, smooth: float, points: int = 300) -> MeasuredDisplacements:
    rng = np.random.default_rng(0)
    residuals = {}
    for photo, view in enumerate(views()):
        places = rng.uniform(size=(points, 2)) * [1, HEIGHT / WIDTH]
        offsets = smooth * bend(photo, places) + noise / SIDE * rng.normal(size=(points, 2))
        residuals[view.name] = Residuals(torch.from_numpy(places).float(), torch.from_numpy(offsets).float())
    return measured_displacements(views(), residuals, CELLS, 0.08)


def truth() -> Float[np.ndarray, "V 2 G G"]:
    steps = (np.arange(CELLS) + 0.5) / CELLS
    x, y = np.meshgrid(steps, steps * HEIGHT / WIDTH)
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    return np.stack([bend(photo, places).T.reshape(2, CELLS, CELLS) for photo in range(PHOTOS)])


@pytest.mark.parametrize(("noise", "error"), [(0.05, 0.05), (0.4, 0.2)])
def test_a_smooth_displacement_is_found_below_noise(noise: float, error: float) -> None:
    found = measured(noise, 1.0)
    assert found.share == pytest.approx(0.125 / (0.125 + noise**2), rel=0.35)
    assert SIDE * np.sqrt(((found.grids.numpy() - truth()) ** 2).mean()) < error


def test_noise_displaces_nothing() -> None:
    found = measured(0.5, 0.0)
    assert found.share < 0.03
    assert not found.grids.any()


def test_a_photo_without_features_stays_as_it_is() -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(size=(300, 2)) * [1, HEIGHT / WIDTH]
    shown = Residuals(torch.from_numpy(places).float(), torch.from_numpy(bend(0, places)).float())
    found = measured_displacements(views(2), {"1.jpg": shown}, CELLS, 0.08)
    assert not found.grids[0].any()
    assert found.grids[1].abs().max() * SIDE == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("points", [0, 1, 10])
def test_too_few_residuals_say_nothing(points: int) -> None:
    places = torch.rand(points, 2)
    found = measured_displacements(views(3), {"0.jpg": Residuals(places, places / SIDE)}, CELLS, 0.08)
    assert found.share == 0
    assert not found.grids.any()


def test_features_without_any_residual_displace_nothing() -> None:
    places = torch.rand(300, 2)
    exact = Residuals(places, torch.zeros(300, 2))
    found = measured_displacements(views(1), {"0.jpg": exact}, CELLS, 0.0)
    assert not found.grids.any()


def test_features_at_one_place_are_no_obstacle() -> None:
    places = torch.full((300, 2), 0.3)
    found = measured_displacements(views(1), {"0.jpg": Residuals(places, places / SIDE)}, CELLS, 0.08)
    assert torch.isfinite(found.grids).all()


@pytest.mark.shared
@pytest.mark.parametrize(("name", "displaced"), [("longchamp", True), ("gate", False)])
def test_real_photos_are_displaced_and_rendered_ones_are_not(
    shared: Path, name: str, displaced: bool
) -> None:
    scene = load_scene(shared / "data" / name, DataConfig(max_side=64))
    found = scene_covariance(scene.train_views, scene.residuals)
    assert found is not None
    assert (found.share > LEAST_SHARE) == displaced
