"""Transients of one photo: people, a bus or a van, pigeons."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from demo_generator.cameras import Viewpoint
from demo_generator.material_kernels import BUS, CLOTH, METAL, PLAIN
from demo_generator.solids import Solids, World, rotation_about

_SKIN = ((0.72, 0.46, 0.34), (0.60, 0.36, 0.24), (0.36, 0.20, 0.12), (0.80, 0.56, 0.44))
_HAIR = ((0.05, 0.035, 0.03), (0.16, 0.09, 0.05), (0.42, 0.30, 0.14), (0.35, 0.34, 0.33))
_TYRE = (0.03, 0.03, 0.03)

IsFree = Callable[[float, float, float], bool]


def draw_visitors(view: Viewpoint, is_free: IsFree, rng: np.random.Generator) -> World:
    """The visitors of one photo, between the camera and the landmark.

    Args:
        view: The photo's camera.
        is_free: Whether a disc on the ground (x, y, radius) is clear of the landmark and its surroundings.
        rng: Randomness of this photo.
    """
    solids = Solids()
    taken: list[tuple[float, float, float]] = []

    def place(radius: float, nearest: float, farthest: float) -> tuple[float, float] | None:
        for _ in range(40):
            x, y = _in_view(view, rng.uniform(nearest, farthest), rng)
            apart = all(np.hypot(x - a, y - b) > radius + r for a, b, r in taken)
            if apart and is_free(x, y, radius):
                taken.append((x, y, radius))
                return x, y
        return None

    reach = float(np.hypot(*(view.position[:2] - np.array([0.0, -6.0]))))
    if rng.uniform() < 0.3 and (spot := place(2.8, 10.0, max(11.0, 0.8 * reach))):
        _vehicle(solids.frame((*spot, 0.0), yaw=rng.uniform(-25, 25) + 90.0 * (rng.uniform() < 0.25)), rng)
    for _ in range(rng.integers(3, 10)):
        near = rng.uniform() < 0.25
        spot = place(0.45, *((3.0, 5.5) if near else (5.5, max(9.0, reach))))
        if spot:
            _person(solids.frame((*spot, 0.0), yaw=rng.uniform(0, 360)), rng)
            if rng.uniform() < 0.4:
                turn = rng.uniform(0, 2 * np.pi)
                x, y = spot[0] + 0.75 * np.cos(turn), spot[1] + 0.75 * np.sin(turn)
                if is_free(x, y, 0.4):
                    _person(solids.frame((x, y, 0.0), yaw=rng.uniform(0, 360)), rng)
    if rng.uniform() < 0.5 and (spot := place(1.0, 4.0, 10.0)):
        _pigeons(solids, spot, rng)
    return solids.build()


def _in_view(view: Viewpoint, distance: float, rng: np.random.Generator) -> tuple[float, float]:
    """A point of the ground at a distance from the camera, inside the picture's width."""
    half = np.arctan(0.5 * view.width / view.focal) * 0.92
    forward = view.camera_to_world[:, 2]
    angle = np.arctan2(forward[1], forward[0]) + rng.uniform(-half, half)
    return view.position[0] + distance * np.cos(angle), view.position[1] + distance * np.sin(angle)


def _cloth(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A random colour of clothes: mostly muted, sometimes bright."""
    if rng.uniform() < 0.35:
        return np.array([1.0, 1.0, 1.1]) * rng.choice([0.04, 0.1, 0.3, 0.7])
    saturation = rng.uniform(0.45, 0.9)
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), saturation, rng.uniform(0.25, 0.75))) ** 1.3


def _person(solids: Solids, rng: np.random.Generator) -> None:
    """A standing or walking person who looks along -y of the frame."""
    tall = rng.uniform(0.88, 1.06) if rng.uniform() < 0.85 else rng.uniform(0.6, 0.75)
    skin = _SKIN[rng.integers(len(_SKIN))]
    hair = _HAIR[rng.integers(len(_HAIR))]
    top, bottom = _cloth(rng), _cloth(rng) * 0.6
    stride = rng.uniform(0.0, 22.0)
    hip, shoulder = 0.86 * tall, 1.42 * tall
    skirt = rng.uniform() < 0.25
    for side in (-1, 1):
        swing = side * stride
        leg = rotation_about(0, 180.0 + swing)
        solids.frustum(
            (0.095 * side, 0.0, hip),
            (0.1, 0.062),
            hip / np.cos(np.deg2rad(swing)) - 0.05,
            material=PLAIN,
            color=skin if skirt else bottom,
            rotation=leg,
        )
        foot = (0.095 * side, hip * np.tan(np.deg2rad(swing)) - 0.05, 0.06)
        solids.ellipsoid(foot, (0.06, 0.13, 0.06), material=PLAIN, color=(0.06, 0.05, 0.05))
        arm = rotation_about(1, -side * 9.0) @ rotation_about(0, 180.0 - 1.2 * swing)
        at = (0.215 * side * tall, 0.0, shoulder - 0.05)
        solids.frustum(at, (0.062, 0.05), 0.36 * tall, material=CLOTH, color=top, rotation=arm)
        elbow = np.asarray(at) + arm @ np.array([0.0, 0.0, 0.36 * tall])
        fore = rotation_about(0, -rng.uniform(5.0, 60.0)) @ arm
        solids.frustum(elbow, (0.05, 0.035), 0.26 * tall, material=PLAIN, color=skin, rotation=fore)
        hand = elbow + fore @ np.array([0.0, 0.0, 0.29 * tall])
        solids.ellipsoid(hand, (0.045, 0.045, 0.06), material=PLAIN, color=skin)
        solids.ellipsoid(at, (0.075, 0.075, 0.075), material=CLOTH, color=top)
    if skirt:
        solids.frustum((0.0, 0.0, 0.42 * tall), (0.27, 0.15), 0.55 * tall, material=CLOTH, color=bottom)
    solids.frustum((0.0, 0.0, hip - 0.08), (0.165, 0.2 * tall), shoulder - hip, material=CLOTH, color=top)
    solids.ellipsoid((0.0, 0.0, shoulder - 0.08), (0.215 * tall, 0.15, 0.11), material=CLOTH, color=top)
    solids.frustum((0.0, 0.0, shoulder - 0.05), (0.06, 0.05), 0.14, material=PLAIN, color=skin)
    head = shoulder + 0.19 * tall
    solids.ellipsoid((0.0, 0.0, head), (0.095, 0.11, 0.135), material=PLAIN, color=skin)
    solids.ellipsoid((0.0, 0.025, head + 0.03), (0.105, 0.115, 0.128), cut=-0.07, material=PLAIN, color=hair)
    extra = rng.uniform()
    if extra < 0.2:
        solids.box((0.0, 0.21, hip + 0.08), (0.15, 0.09), 0.44 * tall, material=PLAIN, color=_cloth(rng))
    elif extra < 0.35:
        solids.frustum((0.0, 0.0, head + 0.06), (0.24, 0.22), 0.02, material=PLAIN, color=(0.66, 0.54, 0.34))
        solids.frustum((0.0, 0.0, head + 0.07), (0.12, 0.10), 0.1, material=PLAIN, color=(0.66, 0.54, 0.34))
    elif extra < 0.43:
        solids.frustum((0.2, -0.1, shoulder - 0.3), (0.012, 0.012), 0.95, material=PLAIN, color=_TYRE)
        solids.frustum((0.2, -0.1, shoulder + 0.42), (0.58, 0.03), 0.26, material=CLOTH, color=_cloth(rng))


def _vehicle(solids: Solids, rng: np.random.Generator) -> None:
    """A coach or a van, its length along x."""
    coach = rng.uniform() < 0.5
    length, height = (4.6, 2.75) if coach else (2.5, 1.9)
    color = _cloth(rng) * 0.8 + 0.1
    solids.box((0.0, 0.0, 0.38), (length, 1.15), height - 0.3, material=BUS, color=color)
    solids.box((0.0, 0.0, height), (length - 0.25, 1.0), 0.22, material=PLAIN, color=color * 0.8)
    disc = rotation_about(0, 90.0)
    for x in (-0.66 * length, 0.66 * length):
        solids.frustum((x, 1.2, 0.42), (0.42, 0.42), 2.4, material=PLAIN, color=_TYRE, rotation=disc)
        solids.frustum(
            (x, 1.22, 0.42), (0.2, 0.2), 2.44, material=METAL, color=(0.4, 0.4, 0.42), rotation=disc
        )


def _pigeons(solids: Solids, spot: tuple[float, float], rng: np.random.Generator) -> None:
    for _ in range(rng.integers(4, 11)):
        bird = solids.frame((*(spot + rng.normal(0.0, 0.9, 2)), 0.0), yaw=rng.uniform(0, 360))
        grey = np.array([0.30, 0.31, 0.36]) * rng.uniform(0.5, 1.6)
        bird.ellipsoid((0.0, 0.0, 0.13), (0.15, 0.075, 0.08), material=PLAIN, color=grey)
        bird.ellipsoid((0.12, 0.0, 0.25), (0.045, 0.04, 0.05), material=PLAIN, color=grey * 0.6)
        bird.frustum((0.1, 0.0, 0.13), (0.05, 0.03), 0.11, material=PLAIN, color=(0.15, 0.26, 0.22))
