"""Features of points on a textured plane, which photos from several sides show in different exposure."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from wildgs.scene.images import UnreadableImageError
from wildgs.sfm.keypoint_refinement import refine_keypoints
from wildgs.sfm.tracks import Tracks, rows_by_photo
from wildgs.sfm.workplace import Workplace

SIZE, FOCAL, NOISE = (320, 240), 300.0, 0.6
SIFT_SCALE = 1.8


@dataclass(frozen=True)
class Made:
    """Photos of a plane.

    Attributes:
        work: The workplace.
        model: Cameras as they are, and points whose features are noisy.
        places: Positions of its points, on the plane z = 0.
    """

    work: Workplace
    model: Any
    places: np.ndarray


def colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Texture of the plane, grey values of about 128 ± 20."""
    random = np.random.default_rng(4)
    waves, phases = random.normal(0, 75.0, (24, 2)), random.uniform(0, 6.28, 24)
    return 128 + 6 * sum(np.sin(a * x + b * y + p) for (a, b), p in zip(waves, phases, strict=True))


def pose(number: int, distance: float) -> Any:
    """World to camera: the plane from another side each time, with the camera turned about its axis."""
    random = np.random.default_rng(number)
    turn = pycolmap.Rotation3d(np.array([*random.uniform(-0.35, 0.35, 2), random.uniform(-1, 1)]))
    return pycolmap.Rigid3d(turn, np.array([0.0, 0.0, distance]))


def on_plane(image: Any, pixels: np.ndarray) -> np.ndarray:
    """Where rays of pixels meet the plane."""
    rays = np.concatenate([image.camera.cam_from_img(pixels), np.ones((len(pixels), 1))], 1)
    rays = rays @ image.cam_from_world().rotation.matrix()
    center = image.projection_center()
    return center - rays * (center[2] / rays[:, 2])[:, None]


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Six photos, one from half the distance, and one that shows something else."""
    work, random = Workplace(tmp_path), np.random.default_rng(0)
    work.images.mkdir()
    places = np.concatenate([random.uniform(-0.22, 0.22, (60, 2)), np.zeros((60, 1))], 1)
    model, tracks = pycolmap.Reconstruction(), [pycolmap.Track() for _ in places]
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    with closing(pycolmap.Database.open(work.database)) as database:
        for number in range(7):
            camera = pycolmap.Camera.create_from_model_name(number + 1, "SIMPLE_RADIAL", FOCAL, *SIZE)
            database.write_camera(camera, use_camera_id=True)
            model.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(name=f"{number}.png", camera_id=number + 1, image_id=number + 1)
            cam_from_world = pose(number, 0.5 if number == 1 else 1.0)
            pixels = camera.img_from_cam(cam_from_world * places) + random.normal(0, NOISE, (len(places), 2))
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
            model.add_image_with_trivial_frame(image, cam_from_world)
            shapes = np.tile([SIFT_SCALE, 0, 0, SIFT_SCALE], (len(places), 1))
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number + 1, np.concatenate([pixels, shapes], 1).astype(np.float32))
            seen = on_plane(model.image(number + 1), np.stack([columns, rows], -1).reshape(-1, 2))
            grey = colour(seen[:, 0] + (5.0 if number == 6 else 0.0), seen[:, 1])
            grey = (0.6 + 0.1 * number) * (grey - 128) + 100 + 5 * number
            Image.fromarray(grey.reshape(rows.shape).astype(np.uint8)).save(work.images / image.name)
            inside = ((pixels > 0) & (pixels < SIZE)).all(axis=1)
            for point in np.flatnonzero(inside):
                tracks[point].add_element(number + 1, int(point))
        for place, track in zip(places, tracks, strict=True):
            model.add_point3D(place + [0, 0, random.normal(0, 0.003)], track)
    return Made(work, model, places)


def nothing(done: int, total: int) -> None:
    """Shows no progress."""


def inconsistency(model: Any, tracks: Tracks, observations: set[tuple[int, int]]) -> np.ndarray:
    """Pixels between aligned features and where their photos show what the reference's feature shows."""
    owners = np.repeat(tracks.references, np.diff(tracks.starts))
    errors = []
    for row, reference in enumerate(owners):
        mine, other = ((int(tracks.photos[r]), int(tracks.features[r])) for r in (row, reference))
        if mine in observations and other in observations and row != reference:
            image, first = model.image(mine[0]), model.image(other[0])
            place = on_plane(first, first.point2D(other[1]).xy[None])
            shown = image.camera.img_from_cam(image.cam_from_world() * place)[0]
            errors.append(np.linalg.norm(image.point2D(mine[1]).xy - shown))
    return np.array(errors)


def test_features_move_to_what_the_reference_shows(made: Made) -> None:
    tracks = Tracks.of(made.work, made.model)
    moved, aligned = refine_keypoints(made.work, made.model, nothing)
    before, after = (inconsistency(model, tracks, aligned) for model in (made.model, moved))
    assert len(after) > 120
    assert np.median(before) > 0.8
    assert np.median(after) < 0.15
    assert np.quantile(after, 0.9) < 0.3


def test_what_a_photo_shows_of_something_else_is_not_aligned(made: Made) -> None:
    _, aligned = refine_keypoints(made.work, made.model, nothing)
    counts = [sum(photo == number for photo, _ in aligned) for number in range(1, 8)]
    assert counts[6] <= 2
    assert min(counts[:6]) > 10


def test_the_model_is_not_modified_and_keeps_its_points(made: Made) -> None:
    before = {i: [point.xy.copy() for point in image.points2D] for i, image in made.model.images.items()}
    moved, aligned = refine_keypoints(made.work, made.model, nothing)
    for number, image in made.model.images.items():
        assert np.array_equal(before[number], [point.xy for point in image.points2D])
        for feature, point in enumerate(moved.image(number).points2D):
            distance = np.linalg.norm(point.xy - image.point2D(feature).xy)
            assert distance < 8
            assert distance == 0 or (number, feature) in aligned
    assert moved.num_points3D() == made.model.num_points3D()


def test_a_photo_from_nearby_is_sampled_more_coarsely(made: Made) -> None:
    tracks = Tracks.of(made.work, made.model)
    sizes = np.sqrt(np.abs(np.linalg.det(tracks.warps)))
    by_photo = {photo: float(np.median(sizes[rows])) for photo, rows in rows_by_photo(tracks.photos)}
    assert by_photo[2] == pytest.approx(2.0, rel=0.15)
    assert by_photo[4] == pytest.approx(1.0, rel=0.15)


def test_a_camera_next_to_a_point_is_no_error(made: Made) -> None:
    """It shows a patch millions of times as large as the others."""
    image = made.model.image(3)
    place = made.model.point3D(made.model.point3D_ids().pop()).xyz
    rotation = image.cam_from_world().rotation
    image.frame.set_cam_from_world(3, pycolmap.Rigid3d(rotation, [0, 0, 2e-6] - rotation * place))
    _, aligned = refine_keypoints(made.work, made.model, nothing)
    assert len(aligned) > 50


def test_photos_that_are_too_large_are_refused_as_at_first(made: Made) -> None:
    with pytest.raises(UnreadableImageError, match="pixels"):
        refine_keypoints(made.work, made.model, nothing, SIZE[0] * SIZE[1] - 1)
    assert refine_keypoints(made.work, made.model, nothing, SIZE[0] * SIZE[1])[1]


def test_points_behind_a_camera_and_models_without_points_are_left_alone(made: Made) -> None:
    image = made.model.image(3)
    away = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([np.pi, 0, 0])), np.zeros(3))
    image.frame.set_cam_from_world(3, away * image.cam_from_world())
    _, aligned = refine_keypoints(made.work, made.model, nothing)
    assert not any(photo == 3 for photo, _ in aligned)
    assert len(aligned) > 50
    for point in list(made.model.point3D_ids()):
        made.model.delete_point3D(point)
    assert refine_keypoints(made.work, made.model, nothing)[1] == set()
