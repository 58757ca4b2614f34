"""The ray caster against point membership, and light that falls where it should."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from demo_generator.camera_response import CameraResponse, develop, metered_gain
from demo_generator.cameras import Viewpoint, looking_at
from demo_generator.lighting import Light, draw_light
from demo_generator.material_kernels import PLAIN
from demo_generator.render import is_free, render, visible_share
from demo_generator.solids import Solids, World, rotation_about
from demo_generator.tracer_kernels import FAR, STACK, hit_distance, is_blocked, nearest_hit

LOOK = {"material": PLAIN, "color": (0.5, 0.5, 0.5)}
NO_LAMPS = np.zeros((0, 4))

SHAPES: dict[str, tuple[Callable[[Solids], None], Callable[[np.ndarray], np.ndarray]]] = {
    "box": (
        lambda s: s.box((0.0, 0.0, 0.0), (0.8, 0.5), 1.2, **LOOK),
        lambda p: (abs(p[:, 0]) < 0.8) & (abs(p[:, 1]) < 0.5) & (p[:, 2] > 0) & (p[:, 2] < 1.2),
    ),
    "cone": (
        lambda s: s.frustum((0.0, 0.0, 0.0), (0.9, 0.2), 1.3, **LOOK),
        lambda p: (np.hypot(p[:, 0], p[:, 1]) < 0.9 - 0.7 * p[:, 2] / 1.3) & (p[:, 2] > 0) & (p[:, 2] < 1.3),
    ),
    "bowl": (
        lambda s: s.frustum((0.0, 0.0, 0.0), (0.1, 0.9), 0.5, **LOOK),
        lambda p: (np.hypot(p[:, 0], p[:, 1]) < 0.1 + 1.6 * p[:, 2]) & (p[:, 2] > 0) & (p[:, 2] < 0.5),
    ),
    "dome": (
        lambda s: s.ellipsoid((0.0, 0.0, 0.0), (0.9, 0.7, 1.1), cut=0.0, **LOOK),
        lambda p: (((p / [0.9, 0.7, 1.1]) ** 2).sum(axis=1) < 1) & (p[:, 2] > 0),
    ),
    "gable": (
        lambda s: s.gable((0.0, 0.0, 0.0), (0.9, 0.7), 0.8, **LOOK),
        lambda p: (abs(p[:, 1]) < 0.7) & (p[:, 2] > 0) & (p[:, 2] < 0.8 * (1 - abs(p[:, 0]) / 0.9)),
    ),
    "pyramid": (
        lambda s: s.pyramid((0.0, 0.0, 0.0), (0.9, 0.7), 1.2, **LOOK),
        lambda p: (
            (p[:, 2] > 0) & (np.maximum(abs(p[:, 0]) / 0.9, abs(p[:, 1]) / 0.7) < 1 - p[:, 2] / 1.2)
        ),
    ),
    "arch": (
        lambda s: s.arch((0.0, 0.0, 0.0), (0.8, 0.4), 1.3, 0.6, **LOOK),
        lambda p: (
            (abs(p[:, 0]) < 0.8) & (abs(p[:, 1]) < 0.4) & (p[:, 2] > 0) & (p[:, 2] < 1.3)
            & ~((abs(p[:, 0]) < 0.6) & (p[:, 2] < 0.5))
            & ~(np.hypot(p[:, 0], p[:, 2] - 0.5) < 0.6)
        ),
    ),
}  # fmt: skip


def _rays(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    origins = rng.normal(size=(count, 3))
    origins *= 3.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.9, 0.9, (count, 3)) + [0, 0, 0.5] - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_ray_enters_a_solid_where_points_start_to_belong_to_it(shape: str) -> None:
    add, inside = SHAPES[shape]
    solids = Solids()
    add(solids)
    world = solids.build()
    steps = np.arange(0.0, 6.0, 0.002)
    met = 0
    for origin, direction in zip(*_rays(150, np.random.default_rng(7)), strict=True):
        belongs = inside(origin + steps[:, None] * direction)
        t = hit_distance(world.kind[0], world.pose[0], world.size[0], *origin, *direction, 1e-4)
        if belongs.any():
            assert t == pytest.approx(steps[np.argmax(belongs)], abs=0.0025) or belongs.sum() < 3
            met += 1
        else:
            # A solid thinner than a step along the ray may be missed by the points.
            assert t >= FAR or not inside((origin + (t + 0.004) * direction)[None])[0]
    assert met > 30


def test_the_hierarchy_finds_what_a_search_of_all_solids_finds() -> None:
    rng = np.random.default_rng(3)
    solids = Solids()
    for _ in range(60):
        frame = solids.frame(rng.uniform(-1.5, 1.5, 3), yaw=float(rng.uniform(0, 360)))
        turn = rotation_about(int(rng.integers(3)), float(rng.uniform(0, 360)))
        frame.box((0.0, 0.0, 0.0), tuple(rng.uniform(0.05, 0.3, 2).tolist()), 0.3, rotation=turn, **LOOK)
        frame.ellipsoid((0.3, 0.0, 0.0), rng.uniform(0.05, 0.3, 3), **LOOK)
    world = solids.build()
    stack = np.empty(STACK, dtype=np.int64)
    hits = 0
    for origin, direction in zip(*_rays(200, rng), strict=True):
        distances = [
            hit_distance(world.kind[i], world.pose[i], world.size[i], *origin, *direction, 1e-4)
            for i in range(len(solids))
        ]
        t, index = nearest_hit(world.arrays, *origin, *direction, 1e-4, FAR, stack)
        assert t == min(distances)
        assert (index >= 0) == (t < FAR)
        assert is_blocked(world.arrays, *origin, *direction, FAR, stack) == (t < FAR)
        hits += index >= 0
    assert hits > 50


def _post_on_a_plane() -> World:
    solids = Solids()
    solids.box((0.0, 0.0, -1.0), (50.0, 50.0), 1.0, **LOOK)
    solids.box((0.0, 0.0, 0.0), (0.3, 0.3), 2.0, **LOOK)
    return solids.build()


def _from_above() -> Viewpoint:
    position = np.array([0.0, -0.01, 12.0])
    return Viewpoint(position, looking_at(position, np.zeros(3)), 60.0, 60, 60)


def test_shadows_fall_away_from_the_sun() -> None:
    place, nobody, view = _post_on_a_plane(), Solids().build(), _from_above()
    sides = []
    for azimuth in (-90.0, 90.0):  # the sun stands at -x, then at +x
        light = Light(elevation=40.0, azimuth=azimuth)
        shot = render(place, nobody, NO_LAMPS, light, view, per_pixel=2, seed=0)
        brightness = shot.radiance.sum(axis=2)
        right, left = brightness[28:32, 36:42].mean(), brightness[28:32, 18:24].mean()
        sides.append(right / left)
    assert sides[0] < 0.8
    assert sides[1] > 1.25


def test_depth_is_along_the_cameras_axis_and_visitors_are_told_apart() -> None:
    visitors = Solids()
    visitors.box((2.0, 0.0, 0.0), (0.5, 0.5), 1.0, **LOOK)
    shot = render(
        _post_on_a_plane(), visitors.build(), NO_LAMPS, Light(60.0, 0.0), _from_above(), per_pixel=2, seed=0
    )
    assert shot.depth[5, 5] == pytest.approx(12.0, rel=1e-3)
    assert shot.depth[30, 30] == pytest.approx(10.0, rel=1e-3)
    assert shot.visitor[30, 40]
    assert not shot.visitor[30, 30]
    assert shot.visitor.mean() < 0.03


def test_a_low_sun_is_redder_and_dusk_has_no_sun() -> None:
    low, high = Light(6.0, 0.0).sun_color, Light(60.0, 0.0).sun_color
    assert low[0] / low[2] > 2.0 * high[0] / high[2]
    dusk = draw_light("dusk", np.random.default_rng(0))
    assert not dusk.sun_color.any()
    assert dusk.lamps > 0.0
    with pytest.raises(ValueError, match="midnight"):
        draw_light("midnight", np.random.default_rng(0))


def test_projection_and_unprojection_are_inverse() -> None:
    position = np.array([3.0, -9.0, 2.0])
    view = Viewpoint(position, looking_at(position, np.array([0.0, 0.0, 1.0]), roll=7.0), 80.0, 64, 48)
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (20, 3))
    pixels, depth = view.project(points)
    assert (depth > 0).all()
    np.testing.assert_allclose(view.unproject(pixels, depth), points, atol=1e-12)
    assert np.linalg.det(view.camera_to_world) == pytest.approx(1.0)
    above, _ = view.project(np.array([[0.0, 0.0, 5.0]]))
    below, _ = view.project(np.array([[0.0, 0.0, 0.0]]))
    assert above[0, 1] < below[0, 1]


def test_free_ground_and_what_hides_the_landmark() -> None:
    place = _post_on_a_plane()
    assert is_free(place, 2.0, 0.0, 0.5)
    assert not is_free(place, 0.5, 0.0, 0.5)
    tower, wall = Solids(), Solids()
    tower.box((0.0, 20.0, 0.0), (6.0, 1.0), 12.0, **LOOK)
    wall.box((3.0, 10.0, 0.0), (3.0, 0.2), 12.0, **LOOK)
    position = np.array([0.0, 0.0, 1.7])
    view = Viewpoint(position, looking_at(position, np.array([0.0, 20.0, 6.0])), 160.0, 160, 160)
    assert visible_share(tower.build(), Solids().build(), view) == 1.0
    assert 0.35 < visible_share(tower.build(), wall.build(), view) < 0.65


def test_development_brightens_with_exposure_and_darkens_corners() -> None:
    grey = np.full((40, 60, 3), 0.3)
    plain = CameraResponse(0.0, (1.0, 1.0, 1.0), 1.0, 1.0, 0.0, 0.0)
    dim = CameraResponse(-1.0, (1.0, 1.0, 1.0), 1.0, 1.0, 0.4, 0.0)
    gain = metered_gain(grey)
    assert metered_gain(2.0 * grey) == pytest.approx(gain / 2.0, rel=0.02)
    assert 90 < develop(grey, gain, plain, 0).mean() < 170
    darker = develop(grey, gain, dim, 0)
    assert darker[20, 30, 0] < develop(grey, gain, plain, 0)[20, 30, 0]
    assert darker[0, 0, 0] < darker[20, 30, 0]
