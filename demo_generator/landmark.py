"""The demo's landmark: a domed church with a portico, arcaded wings and a bell tower.

Its front looks along -y; the middle of the crossing stands over (0, 1.5). Units are metres.
"""

from __future__ import annotations

from demo_generator.material_kernels import (
    ASHLAR,
    BRICK,
    CLOCK,
    COLUMN,
    DOME,
    FRIEZE,
    GLASS,
    MARBLE,
    METAL,
    PLAIN,
    TILES,
    WOOD,
)
from demo_generator.solids import Solids, rotation_about

LIMESTONE = (0.74, 0.64, 0.47)
PALE = (0.80, 0.75, 0.65)
TERRACOTTA = (0.56, 0.20, 0.10)
BRICK_RED = (0.52, 0.23, 0.15)
PATINA = (0.25, 0.52, 0.44)
GOLD = (0.85, 0.58, 0.16)
BLUE = (0.07, 0.16, 0.38)
PANE = (0.10, 0.12, 0.16)
OAK = (0.24, 0.12, 0.06)

FLOOR = 1.25  # top of the steps


def add_landmark(solids: Solids) -> None:
    """The whole building."""
    _steps(solids)
    _nave(solids)
    _portico(solids)
    _dome(solids.frame((0.0, 1.8, 9.0)))
    for side in (-1, 1):
        _wing(solids, side)
    _bell_tower(solids.frame((13.1, 2.9, 0.0)))


def _steps(solids: Solids) -> None:
    for i in range(5):
        grow = 0.42 * (4 - i)
        solids.box(
            (0.0, -0.6, 0.25 * i), (6.9 + grow, 7.3 + grow), 0.25, material=MARBLE, color=(0.70, 0.66, 0.58)
        )


def _window(solids: Solids, width: float, height: float) -> None:
    """An arched window in the plane y = 0 of the frame, facing -y."""
    solids.arch((0.0, 0.0, 0.0), (width + 0.22, 0.16), height + 0.22, width, material=PLAIN, color=PALE)
    solids.box((0.0, 0.03, 0.0), (width, 0.05), height, material=GLASS, color=PANE)
    solids.box((0.0, -0.04, -0.16), (width + 0.34, 0.26), 0.16, material=PLAIN, color=PALE)


def _nave(solids: Solids) -> None:
    solids.box((0.0, 1.5, FLOOR), (6.0, 4.6), 6.9, material=ASHLAR, color=LIMESTONE)
    solids.box((0.0, 1.5, FLOOR), (6.12, 4.72), 0.7, material=MARBLE, color=PALE)
    solids.box((0.0, 1.5, 7.75), (6.2, 4.8), 0.2, material=PLAIN, color=PALE)
    solids.box((0.0, 1.5, 7.95), (6.42, 5.02), 0.22, material=PLAIN, color=PALE)
    solids.box((0.0, 1.5, 8.17), (6.05, 4.65), 0.85, material=ASHLAR, color=LIMESTONE)
    solids.box((0.0, 1.5, 8.92), (6.2, 4.8), 0.14, material=PLAIN, color=PALE)
    for x, y in ((-6.0, -3.1), (6.0, -3.1), (-6.0, 6.1), (6.0, 6.1)):
        solids.box((x, y, FLOOR), (0.34, 0.34), 6.5, material=MARBLE, color=PALE)
        solids.frustum((x * 0.97, y * 0.97 + 0.05, 9.06), (0.14, 0.3), 0.35, material=PLAIN, color=PALE)
        solids.ellipsoid((x * 0.97, y * 0.97 + 0.05, 9.75), (0.36, 0.36, 0.42), material=PLAIN, color=PALE)
    for side in (-1, 1):
        wall = solids.frame((side * 6.0, 1.5, 0.0), yaw=90.0 * side)
        for y in (-2.6, 0.0, 2.6):
            _window(wall.frame((y, 0.0, 5.15)), 0.55, 1.9)


def _column(solids: Solids, height: float, radius: float) -> None:
    """A column on its base with a flared capital."""
    solids.box((0.0, 0.0, 0.0), (1.5 * radius, 1.5 * radius), 0.18, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 0.18), (1.4 * radius, 1.15 * radius), 0.18, material=PLAIN, color=PALE)
    shaft = height - 0.36 - 1.6 * radius
    solids.frustum(
        (0.0, 0.0, 0.36), (radius, 0.84 * radius), shaft, material=COLUMN, color=(0.80, 0.72, 0.58)
    )
    top = 0.36 + shaft
    solids.frustum((0.0, 0.0, top), (1.0 * radius, 1.0 * radius), 0.15 * radius, material=METAL, color=GOLD)
    solids.frustum((0.0, 0.0, top), (0.84 * radius, 1.4 * radius), 1.15 * radius, material=PLAIN, color=PALE)
    solids.box(
        (0.0, 0.0, top + 1.15 * radius),
        (1.5 * radius, 1.5 * radius),
        0.45 * radius,
        material=PLAIN,
        color=PALE,
    )


def _portico(solids: Solids) -> None:
    for i in range(6):
        _column(solids.frame((-4.75 + 1.9 * i, -6.35, FLOOR)), 5.5, 0.37)
    for x in (-4.75, 4.75):
        _column(solids.frame((x, -4.5, FLOOR)), 5.5, 0.37)
    top = FLOOR + 5.5
    solids.box((0.0, -4.9, top), (5.3, 2.0), 0.3, material=MARBLE, color=PALE)
    solids.box((0.0, -4.9, top + 0.3), (5.22, 1.94), 0.72, material=FRIEZE, color=BLUE)
    solids.box((0.0, -4.9, top + 1.02), (5.55, 2.25), 0.16, material=PLAIN, color=PALE)
    solids.box((0.0, -4.9, top + 1.18), (5.75, 2.45), 0.16, material=PLAIN, color=PALE)
    _pediment(solids, top + 1.34)
    _portal(solids)


def _pediment(solids: Solids, base: float) -> None:
    solids.gable((0.0, -4.5, base), (5.5, 2.35), 2.05, material=ASHLAR, color=(0.62, 0.30, 0.22))
    for side in (-1, 1):
        slope = rotation_about(1, side * 20.44)
        rake = solids.frame()
        rake.box(
            (side * 2.84, -4.6, base + 0.98),
            (3.1, 2.62),
            0.2,
            material=TILES,
            color=TERRACOTTA,
            rotation=slope,
        )
        rake.box(
            (side * 2.84, -7.0, base + 0.86), (3.05, 0.16), 0.22, material=PLAIN, color=PALE, rotation=slope
        )
    facing = rotation_about(0, 90.0)
    solids.frustum((0.0, -6.8, base + 0.9), (0.78, 0.78), 0.16, material=METAL, color=GOLD, rotation=facing)
    solids.frustum((0.0, -6.9, base + 0.9), (0.66, 0.66), 0.14, material=CLOCK, color=PALE, rotation=facing)
    for side in (-1, 1):
        for x, r in ((1.35, 0.34), (2.15, 0.27), (2.85, 0.2)):
            solids.ellipsoid((side * x, -6.85, base + 0.42), (r, 0.16, r * 1.1), material=PLAIN, color=PALE)
    for x, z in ((0.0, base + 2.1), (-5.5, base), (5.5, base)):
        solids.box((x, -6.7, z), (0.26, 0.26), 0.4, material=PLAIN, color=PALE)
        solids.frustum((x, -6.7, z + 0.4), (0.24, 0.12), 0.75, material=METAL, color=(0.22, 0.42, 0.36))
        solids.ellipsoid((x, -6.7, z + 1.28), (0.15, 0.15, 0.18), material=METAL, color=GOLD)


def _portal(solids: Solids) -> None:
    front = solids.frame((0.0, -3.1, FLOOR))
    front.arch((0.0, -0.05, 0.0), (1.35, 0.24), 4.1, 1.02, material=MARBLE, color=PALE)
    front.box((0.0, 0.0, 0.0), (1.02, 0.06), 3.8, material=WOOD, color=OAK)
    for x in (-3.2, 3.2):
        _window(front.frame((x, 0.0, 1.2)), 0.55, 2.3)


def _dome(solids: Solids) -> None:
    solids.frustum((0.0, 0.0, 0.0), (4.25, 4.25), 0.5, material=MARBLE, color=PALE)
    solids.frustum((0.0, 0.0, 0.5), (3.75, 3.75), 3.2, material=ASHLAR, color=LIMESTONE)
    for i in range(12):
        turn = 30.0 * i
        _window(solids.frame(yaw=turn).frame((0.0, -3.78, 1.05)), 0.42, 1.85)
        pillar = solids.frame(yaw=turn + 15.0).frame((0.0, -3.88, 0.5))
        pillar.frustum((0.0, 0.0, 0.0), (0.21, 0.19), 2.9, material=COLUMN, color=PALE)
        pillar.frustum((0.0, 0.0, 2.9), (0.19, 0.3), 0.3, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 3.7), (4.15, 4.3), 0.3, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 4.0), (4.0, 3.9), 0.35, material=PLAIN, color=LIMESTONE)
    solids.ellipsoid((0.0, 0.0, 4.3), (3.75, 3.75, 4.0), cut=0.0, material=DOME, color=PATINA)
    lantern = solids.frame((0.0, 0.0, 8.1))
    lantern.frustum((0.0, 0.0, 0.0), (1.05, 0.95), 0.3, material=PLAIN, color=PALE)
    lantern.frustum((0.0, 0.0, 0.3), (0.55, 0.55), 1.3, material=GLASS, color=PANE)
    for i in range(8):
        lantern.frame(yaw=45.0 * i).frustum((0.0, -0.72, 0.3), (0.1, 0.1), 1.3, material=PLAIN, color=PALE)
    lantern.frustum((0.0, 0.0, 1.6), (0.9, 0.98), 0.18, material=PLAIN, color=PALE)
    lantern.ellipsoid((0.0, 0.0, 1.78), (0.82, 0.82, 0.85), cut=0.0, material=METAL, color=GOLD)
    lantern.ellipsoid((0.0, 0.0, 2.8), (0.22, 0.22, 0.22), material=METAL, color=GOLD)
    lantern.box((0.0, 0.0, 2.9), (0.07, 0.07), 1.05, material=METAL, color=GOLD)
    lantern.box((0.0, 0.0, 3.45), (0.32, 0.07), 0.14, material=METAL, color=GOLD)


def _wing(solids: Solids, side: int) -> None:
    """A low wing behind an arcade of three bays."""
    wing = solids.frame((side * 8.75, 2.6, 0.0))
    wing.box((0.0, 1.0, 0.0), (2.75, 2.0), 4.6, material=ASHLAR, color=(0.72, 0.58, 0.42))
    for i in (-1, 0, 1):
        bay = wing.frame((i * 1.83, -2.6, 0.3))
        bay.arch((0.0, 0.0, 0.0), (0.915, 0.3), 4.0, 0.66, material=MARBLE, color=PALE)
        bay.frustum((0.0, -0.32, 3.45), (0.14, 0.22), 0.4, material=PLAIN, color=PALE)
        bay.box((0.0, 1.58, 0.0), (0.42, 0.06), 2.2, material=WOOD, color=OAK)
    wing.box((0.0, -1.8, 0.0), (2.9, 1.25), 0.3, material=MARBLE, color=PALE)
    wing.box((0.0, -0.2, 4.3), (2.85, 3.0), 0.35, material=PLAIN, color=PALE)
    roof = wing.frame((0.0, -0.2, 4.65), yaw=90.0)
    roof.gable((0.0, 0.0, 0.0), (3.35, 2.9), 1.35, material=TILES, color=TERRACOTTA)


def _bell_tower(solids: Solids) -> None:
    solids.box((0.0, 0.0, 0.0), (1.75, 1.75), 1.2, material=MARBLE, color=PALE)
    solids.box((0.0, 0.0, 1.2), (1.6, 1.6), 10.6, material=BRICK, color=BRICK_RED)
    for x in (-1.5, 1.5):
        for y in (-1.5, 1.5):
            solids.box((x, y, 1.2), (0.2, 0.2), 14.1, material=MARBLE, color=PALE)
    for z in (5.0, 8.6, 11.8):
        solids.box((0.0, 0.0, z), (1.8, 1.8), 0.24, material=PLAIN, color=PALE)
    for quarter in range(4):
        face = solids.frame(yaw=90.0 * quarter)
        _window(face.frame((0.0, -1.6, 5.9)), 0.36, 1.7)
        disc = rotation_about(0, 90.0)
        face.frustum((0.0, -1.55, 10.3), (0.98, 0.98), 0.16, material=PLAIN, color=PALE, rotation=disc)
        face.frustum(
            (0.0, -1.62, 10.3), (0.88, 0.88), 0.16, material=CLOCK, color=(0.86, 0.82, 0.7), rotation=disc
        )
        face.arch((0.0, -1.45, 12.04), (1.35, 0.14), 3.0, 0.95, material=MARBLE, color=PALE)
        face.box((0.0, -1.4, 12.04), (1.2, 0.1), 0.55, material=PLAIN, color=PALE)
    solids.frustum((0.0, 0.0, 12.9), (0.62, 0.3), 0.85, material=METAL, color=(0.50, 0.33, 0.12))
    solids.box((0.0, 0.0, 13.9), (1.4, 0.08), 0.12, material=WOOD, color=OAK)
    solids.box((0.0, 0.0, 15.0), (1.85, 1.85), 0.4, material=PLAIN, color=PALE)
    solids.pyramid((0.0, 0.0, 15.4), (2.0, 2.0), 3.6, material=TILES, color=TERRACOTTA)
    solids.ellipsoid((0.0, 0.0, 19.05), (0.2, 0.2, 0.26), material=METAL, color=GOLD)
