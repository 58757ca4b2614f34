"""Scenes in COLMAP's real layout, made small by pycolmap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

WIDTH, HEIGHT = 48, 32


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World-to-camera 3x4 with OpenCV axes."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -(rotation @ position)[:, None]], axis=1)


def ring_poses(count: int, *, lift: float = 1.0) -> list[np.ndarray]:
    """Cameras on the south side of the origin, z up, at different distances, looking slightly upwards."""
    poses = []
    for index in range(count):
        angle = np.radians(-90 + (index - (count - 1) / 2) * 100 / max(count, 2))
        radius = 5 + 0.3 * (index % 3)
        position = radius * np.array([np.cos(angle), np.sin(angle), 0]) + [0, 0, lift]
        poses.append(look_at(position, np.array([0.0, 0.0, 1.5 * lift]), np.array([0.0, 0.0, 1.0])))
    return poses


def ground_points(count: int = 60) -> np.ndarray:
    """A cloud that is longest along x, then y."""
    return np.random.default_rng(1).normal(size=(count, 3)) * [1.5, 0.5, 0.3] + [0, 0, 0.5]


def photo(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A smooth picture with a different gradient in each channel."""
    y, x = np.mgrid[0:height, 0:width]
    red, green = 20 + 200 * x / max(width - 1, 1), 20 + 200 * y / max(height - 1, 1)
    return np.stack([red, green, 255 - red], axis=-1).round().astype(np.uint8)


def write_model(
    folder: Path,
    names: Sequence[str],
    poses: Sequence[np.ndarray],
    points: np.ndarray,
    *,
    camera: dict | None = None,
    binary: bool = True,
    keypoints: Sequence[np.ndarray] | None = None,
) -> None:
    """A sparse model in which every photo observes every point, at `keypoints` of each photo if given."""
    camera = camera or {"model": "PINHOLE", "width": WIDTH, "height": HEIGHT, "params": [40, 41, 24, 16]}
    model = pycolmap.Reconstruction()
    for index, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=index, **camera))
        seen = np.zeros((len(points), 2)) if keypoints is None else keypoints[index - 1]
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(pose)))
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for image_id in range(1, len(names) + 1):
            track.add_element(image_id, row)
        model.add_point3D(point, track, np.array([row % 256, 100, 200], dtype=np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    if binary:
        model.write_binary(folder)
    else:
        model.write_text(folder)


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a scene and returns its folder."""

    def make(
        count: int = 9,
        *,
        layout: str = "sparse/0",
        images: str = "images",
        names: Sequence[str] | None = None,
        points: np.ndarray | None = None,
        poses: Sequence[np.ndarray] | None = None,
        **model: object,
    ) -> Path:
        root = tmp_path / "scene"
        names = names or [f"p{index:02d}.png" for index in range(count)]
        points = ground_points() if points is None else points
        write_model(root / layout, names, poses or ring_poses(len(names)), points, **model)
        for name in names:
            path = root / images / name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(photo()).save(path)
        return root

    return make


def render_corner(
    count: int, width: int = 320, height: int = 240
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Photos of a textured floor and wall, and the cameras' positions: enough for structure from motion."""
    rng = np.random.default_rng(7)
    # Blots of many sizes, so that features are found at many scales.
    texture = sum(
        np.kron(rng.uniform(size=(512 // size, 512 // size, 3)), np.ones((size, size, 1))) * size**0.5
        for size in (2, 4, 8, 16, 32)
    )
    texture = 255 * (texture - texture.min()) / np.ptp(texture)
    focal, photos, positions = 1.2 * width, [], []
    y, x = np.mgrid[0:height, 0:width]
    rays = np.stack(
        [(x + 0.5 - width / 2) / focal, (y + 0.5 - height / 2) / focal, np.ones(x.shape)], axis=-1
    )
    for index in range(count):
        position = np.array([-1.5 + 3 * index / max(count - 1, 1), -5.0 + 0.5 * (index % 2), 1.5])
        pose = look_at(position, np.array([0.0, 0.5, 0.5]), np.array([0.0, 0.0, 1.0]))
        directions = rays @ pose[:, :3]
        with np.errstate(divide="ignore"):
            floor = np.where(directions[..., 2] < 0, -position[2] / directions[..., 2], np.inf)
            wall = np.where(directions[..., 1] > 0, (2 - position[1]) / directions[..., 1], np.inf)
        points = position + np.minimum(floor, wall)[..., None] * directions
        u, v = points[..., 0], np.where(floor < wall, points[..., 1], 5 + points[..., 2])
        rows, columns = (v * 80).astype(int) % 512, (u * 80).astype(int) % 512
        photos.append(texture[rows, columns].astype(np.uint8))
        positions.append(position)
    return photos, positions


@pytest.fixture(scope="session")
def corner() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Six photos of a textured corner, and where they were taken."""
    return render_corner(6)
