"""Surroundings of the landmark: the square, a fountain, lamps, trees, houses and hills."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from demo_generator.landmark import BRICK_RED, PALE, TERRACOTTA
from demo_generator.material_kernels import (
    ASHLAR,
    GRASS,
    HILL,
    HOUSE,
    LAMP,
    LEAVES,
    MARBLE,
    METAL,
    PAVING,
    PLAIN,
    TILES,
    WATER,
    WOOD,
)
from demo_generator.solids import Solids

IRON = (0.05, 0.06, 0.06)
BRONZE = (0.20, 0.27, 0.21)
FOUNTAIN = (-0.0, -14.5)
SQUARE_RADIUS = 36.0
_LAMPS = ((-8.5, -9.0), (8.5, -9.0), (-13.5, -4.0), (16.5, -3.5), (-7.5, -20.0), (7.5, -20.0))
_HOUSE_COLORS = (
    (0.74, 0.52, 0.28),
    (0.70, 0.38, 0.26),
    (0.78, 0.66, 0.46),
    (0.62, 0.60, 0.54),
    (0.72, 0.47, 0.38),
    (0.56, 0.58, 0.46),
)


def add_surroundings(solids: Solids, rng: np.random.Generator) -> None:
    """Ground, furniture and background."""
    solids.box((0.0, 0.0, -1.2), (900.0, 900.0), 1.1, material=GRASS, color=(0.20, 0.28, 0.09))
    square = solids.frame((*FOUNTAIN, -0.5))
    square.frustum(
        (0.0, 0.0, 0.0), (SQUARE_RADIUS, SQUARE_RADIUS), 0.5, material=PAVING, color=(0.50, 0.46, 0.41)
    )
    _fountain(solids.frame((*FOUNTAIN, 0.0)))
    for x, y in _LAMPS:
        _lamp(solids.frame((x, y, 0.0)))
    for x, y in ((-7.6, -6.4), (7.6, -6.4)):
        _planter(solids.frame((x, y, 0.0)), rng)
    _trees(solids, rng)
    _houses(solids, rng)
    _hills(solids, rng)


def lamp_positions() -> Float[np.ndarray, "P 4"]:
    """Evening lamps: position and strength. The first ones are floodlights at the landmark's foot."""
    lamps = [(x, y, 3.75, 5.0) for x, y in _LAMPS]
    floods = [(-7.0, -12.5, 0.5, 34.0), (7.0, -12.5, 0.5, 34.0), (0.0, -5.0, 5.6, 3.0)]
    floods += [
        (-4.6, -1.6, 9.4, 5.0),
        (4.6, -1.6, 9.4, 5.0),
        (17.0, -3.0, 0.5, 18.0),
        (-15.0, -2.0, 0.5, 14.0),
    ]
    return np.array(floods + lamps)


def _fountain(solids: Solids) -> None:
    solids.frustum((0.0, 0.0, 0.0), (3.0, 3.0), 0.14, material=MARBLE, color=PALE)
    solids.frustum((0.0, 0.0, 0.14), (2.3, 2.45), 0.5, material=WATER, color=(0.10, 0.26, 0.28))
    solids.frustum((0.0, 0.0, 0.6), (0.5, 0.3), 1.0, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 1.6), (0.3, 1.15), 0.34, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 1.94), (0.26, 0.2), 0.4, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 2.34), (0.3, 0.14), 0.85, material=METAL, color=BRONZE)
    solids.ellipsoid((0.0, 0.0, 3.35), (0.2, 0.17, 0.34), material=METAL, color=BRONZE)
    solids.ellipsoid((0.0, -0.02, 3.83), (0.13, 0.13, 0.17), material=METAL, color=BRONZE)
    tilt = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    solids.frustum((0.12, 0.0, 3.5), (0.07, 0.05), 0.7, material=METAL, color=BRONZE, rotation=tilt)


def _lamp(solids: Solids) -> None:
    solids.frustum((0.0, 0.0, 0.0), (0.2, 0.13), 0.5, material=PLAIN, color=IRON)
    solids.frustum((0.0, 0.0, 0.5), (0.07, 0.05), 2.9, material=PLAIN, color=IRON)
    solids.frustum((0.0, 0.0, 3.4), (0.12, 0.2), 0.08, material=PLAIN, color=IRON)
    solids.ellipsoid((0.0, 0.0, 3.75), (0.24, 0.24, 0.3), material=LAMP, color=(0.85, 0.82, 0.74))
    solids.frustum((0.0, 0.0, 4.0), (0.17, 0.02), 0.2, material=PLAIN, color=IRON)


def _planter(solids: Solids, rng: np.random.Generator) -> None:
    solids.frustum((0.0, 0.0, 0.0), (0.5, 0.72), 0.8, material=PLAIN, color=(0.55, 0.26, 0.16))
    _crown(solids, (0.0, 0.0, 1.3), (0.62, 0.62, 0.6), 14, (0.12, 0.26, 0.07), rng)


def _crown(
    solids: Solids,
    center: tuple[float, float, float],
    radii: tuple[float, float, float],
    count: int,
    color: tuple[float, float, float],
    rng: np.random.Generator,
) -> None:
    """A crown of leaves: one body with small clumps on its surface."""
    solids.ellipsoid(center, np.asarray(radii) * 0.86, material=LEAVES, color=color)
    for i in range(count):
        z = 1.0 - 2.0 * (i + 0.5) / count
        angle = 2.39996 * i
        flat = np.sqrt(1.0 - z * z)
        offset = np.array([flat * np.cos(angle), flat * np.sin(angle), z]) * rng.uniform(0.72, 0.9)
        clump = min(radii) * rng.uniform(0.26, 0.42) * np.array([1.0, 1.0, 0.85])
        tint = np.asarray(color) * rng.uniform(0.75, 1.3)
        solids.ellipsoid(np.asarray(center) + offset * radii, clump, material=LEAVES, color=tint)


def _trees(solids: Solids, rng: np.random.Generator) -> None:
    round_trees = (
        (-17.5, 4.5, 1.15),
        (-22.0, 8.0, 1.3),
        (22.5, 8.5, 1.25),
        (-26.5, -1.5, 1.0),
        (28.0, 0.5, 1.05),
    )
    for x, y, scale in round_trees:
        solids.frustum(
            (x, y, 0.0), (0.32 * scale, 0.2 * scale), 2.6 * scale, material=WOOD, color=(0.17, 0.11, 0.07)
        )
        color = (0.13 + 0.05 * rng.uniform(), 0.25, 0.06)
        crown = (1.9 * scale, 1.9 * scale, 1.75 * scale)
        _crown(solids, (x, y, 3.9 * scale), crown, 42, color, rng)
    cypresses = (
        (-12.6, 9.0),
        (-9.0, 11.0),
        (9.4, 11.0),
        (17.4, 9.5),
        (-17.0, 12.5),
        (22.0, 13.0),
        (-27.0, 3.0),
    )
    for x, y in cypresses:
        height = rng.uniform(4.2, 5.4)
        solids.frustum((x, y, 0.0), (0.2, 0.2), 1.0, material=WOOD, color=(0.17, 0.11, 0.07))
        _crown(solids, (x, y, 0.6 + height), (1.05, 1.05, height), 34, (0.06, 0.14, 0.045), rng)
    for x in (-5.6, 5.6):
        for y in (0.5, 2.5, 4.5):
            solids.ellipsoid(
                (x * 1.28 + np.sign(x) * 6.2, y - 4.4, 0.3),
                (0.7, 0.7, 0.6),
                material=LEAVES,
                color=(0.12, 0.24, 0.07),
            )


def _houses(solids: Solids, rng: np.random.Generator) -> None:
    """A ring of houses about the square, open towards the valley in the middle of the back."""
    angle = 0.0
    while angle < 352.0:
        width, depth = rng.uniform(3.6, 5.6), rng.uniform(4.0, 5.0)
        distance = SQUARE_RADIUS + rng.uniform(5.5, 7.5) + depth
        step = np.rad2deg(2.0 * width / (distance - depth))
        middle = angle + step / 2
        angle += step + (rng.uniform(2.0, 7.0) if rng.uniform() < 0.4 else 0.4)
        if 72.0 < middle < 108.0:
            continue
        house = solids.frame((*FOUNTAIN, -0.2), yaw=middle - 90.0).frame((0.0, distance, 0.0))
        color = np.asarray(_HOUSE_COLORS[rng.integers(len(_HOUSE_COLORS))]) * rng.uniform(0.85, 1.1)
        height = 3.0 * rng.integers(2, 4) + 1.2
        house.box((0.0, 0.0, 0.0), (width, depth), height, material=HOUSE, color=color)
        house.box((0.0, 0.0, 0.0), (width + 0.08, depth + 0.08), 0.7, material=ASHLAR, color=(0.5, 0.46, 0.4))
        house.box((0.0, 0.0, height), (width + 0.25, depth + 0.3), 0.22, material=PLAIN, color=PALE)
        roof = house.frame((0.0, 0.0, height + 0.22), yaw=90.0)
        roof.gable((0.0, 0.0, 0.0), (depth + 0.4, width + 0.2), 2.0, material=TILES, color=TERRACOTTA)
        chimney = rng.uniform(-0.6, 0.6) * width
        house.box((chimney, -0.9, height + 0.9), (0.32, 0.32), 1.9, material=PLAIN, color=BRICK_RED)


def _hills(solids: Solids, rng: np.random.Generator) -> None:
    for i in range(15):
        angle = 2.0 * np.pi * (i + rng.uniform(0.0, 0.7)) / 15.0
        distance = rng.uniform(210.0, 420.0)
        radii = (rng.uniform(90.0, 150.0), rng.uniform(80.0, 120.0), rng.uniform(26.0, 52.0))
        color = np.array([0.15, 0.22, 0.09]) * rng.uniform(0.8, 1.25)
        at = (distance * np.cos(angle), distance * np.sin(angle), -4.0)
        solids.ellipsoid(at, radii, material=HILL, color=color)
