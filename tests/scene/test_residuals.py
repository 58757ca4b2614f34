"""Residuals are those of COLMAP's own cameras, of either file format and after undistortion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from tests.scene_files import HEIGHT, WIDTH, ground_points, ring_poses
from wildgs.errors import UserError
from wildgs.scene import DataConfig, load_scene

CAMERAS = {
    "PINHOLE": [40.0, 41.0, 24.0, 16.0],
    "OPENCV": [40.0, 41.0, 24.0, 16.0, 0.05, -0.01, 0.001, -0.002],
}
SHIFT = np.array([0.12, -0.08])
"""Of all keypoints, pixels."""


def shifted_keypoints(camera: dict, poses: list[np.ndarray], points: np.ndarray) -> list[np.ndarray]:
    lens = pycolmap.Camera(**camera)
    return [
        np.stack([lens.img_from_cam(pose[:, :3] @ point + pose[:, 3]) + SHIFT for point in points])
        for pose in poses
    ]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", CAMERAS)
def test_residuals_are_keypoints_less_projections(
    make_scene: Callable[..., Path], model: str, binary: bool
) -> None:
    camera = {"model": model, "width": WIDTH, "height": HEIGHT, "params": CAMERAS[model]}
    poses, points = ring_poses(9), ground_points()
    keypoints = shifted_keypoints(camera, poses, points)
    root = make_scene(points=points, poses=poses, camera=camera, binary=binary, keypoints=keypoints)
    scene = load_scene(root)
    assert set(scene.residuals) == {view.name for view in scene.train_views}
    for view in scene.train_views:
        residuals = scene.residuals[view.name]
        side = max(view.camera.width, view.camera.height)
        assert len(residuals.places) > 40
        # Projections by the view's own camera, in the aligned frame.
        pixels, _ = view.camera.project(scene.points)
        distances = (residuals.places[:, None] * side - pixels).norm(dim=2)
        nearest = distances.min(dim=1).values
        torch.testing.assert_close(nearest, torch.zeros_like(nearest), atol=1e-3, rtol=0)
        # Undistortion changes the shift where the lens distorts.
        atol = 1e-4 if model == "PINHOLE" else 0.03
        expected = torch.from_numpy(SHIFT).float().expand_as(residuals.offsets)
        torch.testing.assert_close(residuals.offsets * side, expected, atol=atol, rtol=0)


def test_residuals_do_not_depend_on_the_size_of_views(make_scene: Callable[..., Path]) -> None:
    camera = {"model": "PINHOLE", "width": WIDTH, "height": HEIGHT, "params": CAMERAS["PINHOLE"]}
    keypoints = shifted_keypoints(camera, ring_poses(9), ground_points())
    root = make_scene(camera=camera, keypoints=keypoints)
    whole, half = load_scene(root), load_scene(root, DataConfig(downscale=2))
    for name, residuals in whole.residuals.items():
        torch.testing.assert_close(half.residuals[name].places, residuals.places)
        torch.testing.assert_close(half.residuals[name].offsets, residuals.offsets)


def test_wrong_matches_and_points_outside_the_photo_are_left_out(make_scene: Callable[..., Path]) -> None:
    """Keypoints in the corner of the photo are no residuals of points elsewhere."""
    scene = load_scene(make_scene())
    assert all(len(residuals.offsets) == 0 for residuals in scene.residuals.values())


def test_scenes_without_keypoints_have_no_residuals(make_scene: Callable[..., Path]) -> None:
    root = make_scene(binary=False)
    path = root / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text(
        "\n".join(line if ".png" in line or line.startswith("#") else "" for line in lines) + "\n"
    )
    scene = load_scene(root)
    assert all(len(residuals.places) == 0 for residuals in scene.residuals.values())


def test_image_points_that_are_no_numbers_are_refused(make_scene: Callable[..., Path]) -> None:
    root = make_scene(binary=False)
    path = root / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    lines[-1] = "1.0 2.0"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError, match="image points that are not triples of numbers"):
        load_scene(root)
