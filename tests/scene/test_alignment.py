import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.memory_views import make_view
from wildgs.geometry.camera import Camera
from wildgs.scene import Alignment, Scene, View, scene_extent
from wildgs.scene.alignment import align_world


def camera(pose: np.ndarray) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(pose)
    K = torch.tensor([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, 40, 30)


def poses(count: int = 9, tilt: float = 0.0, spread: float = 100.0) -> list[np.ndarray]:
    """Level cameras south of the origin (z up), pitched up by `tilt` degrees."""
    result = []
    for angle in np.radians(-90 + np.linspace(-spread / 2, spread / 2, count)):
        position = 5 * np.array([np.cos(angle), np.sin(angle), 0.2])
        ahead = -np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = np.cos(np.radians(tilt)) * ahead + np.sin(np.radians(tilt)) * np.array([0, 0, 1.0])
        right = np.cross(ahead, [0, 0, 1.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        result.append(np.concatenate([rotation, -(rotation @ position)[:, None]], axis=1))
    return result


def cloud(count: int = 400) -> torch.Tensor:
    values = np.random.default_rng(3).normal(size=(count, 3)) * [2.0, 0.6, 0.3] + [0.0, 0.5, 1.0]
    return torch.from_numpy(values)


def similarity(seed: int, scale: float) -> Alignment:
    rotation = Rotation.random(random_state=seed).as_matrix()
    translation = np.random.default_rng(seed).normal(size=3) * 20
    return Alignment(torch.from_numpy(rotation), torch.from_numpy(translation), scale)


def depths(cameras: list[Camera], points: torch.Tensor) -> list[float]:
    return [float((points @ c.viewmat[2, :3] + c.viewmat[2, 3]).median()) for c in cameras]


seeds, scales = st.integers(0, 2**31 - 1), st.floats(1e-3, 1e3)


@settings(max_examples=25, deadline=None)
@given(seeds, scales)
def test_inverse_takes_points_back(seed: int, scale: float) -> None:
    alignment = similarity(seed, scale)
    points = cloud(20)
    back = alignment.inverse().apply_points(alignment.apply_points(points))
    torch.testing.assert_close(back, points, rtol=1e-8, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(seeds, scales)
def test_an_aligned_camera_sees_aligned_points_at_the_same_pixels(seed: int, scale: float) -> None:
    alignment = similarity(seed, scale)
    before, points = camera(poses()[2]), cloud(20)
    after, moved = alignment.apply_camera(before), alignment.apply_points(points)

    def project(camera: Camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        return (local @ camera.K.T)[:, :2] / local[:, 2:], local[:, 2]

    pixels_before, depth_before = project(before, points)
    pixels_after, depth_after = project(after, moved)
    torch.testing.assert_close(pixels_after, pixels_before, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(depth_after, scale * depth_before, rtol=1e-7, atol=1e-9)
    rotation = after.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    restored = alignment.inverse().apply_camera(after)
    torch.testing.assert_close(restored.viewmat, before.viewmat, rtol=1e-7, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(seeds, scales)
def test_json_keeps_the_alignment_exactly(seed: int, scale: float) -> None:
    alignment = similarity(seed, scale)
    again = Alignment.from_dict(json.loads(json.dumps(alignment.to_dict())))
    assert torch.equal(again.rotation, alignment.rotation)
    assert torch.equal(again.translation, alignment.translation)
    assert again.scale == alignment.scale


@settings(max_examples=25, deadline=None)
@given(seeds, scales)
def test_the_aligned_scene_does_not_depend_on_the_input_frame(seed: int, scale: float) -> None:
    cameras, points = [camera(pose) for pose in poses(tilt=15)], cloud()
    moved_frame = similarity(seed, scale)
    moved_cameras = [moved_frame.apply_camera(c) for c in cameras]
    moved_points = moved_frame.apply_points(points)

    direct = align_world(cameras, points, depths(cameras, points))
    detour = align_world(moved_cameras, moved_points, depths(moved_cameras, moved_points))
    # The centre from which the principal axes are taken is a median per axis, so it shifts a little with them.
    torch.testing.assert_close(
        detour.apply_points(moved_points), direct.apply_points(points), rtol=0, atol=0.02
    )


def test_axes_are_right_handed_with_up_ground_and_unit_depth() -> None:
    cameras, points = [camera(pose) for pose in poses()], cloud()
    hidden = similarity(5, 7.0)
    cameras, points = [hidden.apply_camera(c) for c in cameras], hidden.apply_points(points)
    alignment = align_world(cameras, points, depths(cameras, points))
    aligned = alignment.apply_points(points)
    aligned_cameras = [alignment.apply_camera(c) for c in cameras]

    assert torch.linalg.det(alignment.rotation).item() == pytest.approx(1.0)
    torch.testing.assert_close(alignment.rotation @ alignment.rotation.T, torch.eye(3).double())
    for c in aligned_cameras:
        assert c.up[2].item() == pytest.approx(1.0, abs=1e-4)
    spread = aligned.std(dim=0)
    assert spread[0] > spread[1] > spread[2]
    assert torch.stack([c.position for c in aligned_cameras]).mean(dim=0)[1] < 0
    assert np.median(depths(aligned_cameras, aligned)) == pytest.approx(1.0)
    torch.testing.assert_close(aligned.median(dim=0).values, torch.zeros(3).double(), rtol=0, atol=1e-9)


def test_cameras_that_all_look_up_do_not_tilt_the_world() -> None:
    cameras = [camera(pose) for pose in poses(tilt=30)]
    up = align_world(cameras, cloud(), [5.0]).rotation[2]
    assert np.degrees(np.arccos(min(1.0, up[2].item()))) < 3


def test_photos_held_sideways_do_not_tilt_the_world() -> None:
    level = poses(12)
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    cameras = [camera(quarter @ pose if index % 4 == 0 else pose) for index, pose in enumerate(level)]
    up = align_world(cameras, cloud(), [5.0]).rotation[2]
    assert np.degrees(np.arccos(min(1.0, up[2].item()))) < 5


def test_far_points_do_not_turn_the_axes() -> None:
    cameras, points = [camera(pose) for pose in poses()], cloud()
    far = torch.tensor([[40.0, 5000.0, 30.0], [-10.0, 8000.0, 0.0]]).double()
    plain = align_world(cameras, points, [5.0])
    disturbed = align_world(cameras, torch.cat([points, far]), [5.0])
    torch.testing.assert_close(disturbed.rotation, plain.rotation, rtol=0, atol=0.05)


def test_one_camera_and_one_point_suffice() -> None:
    alignment = align_world([camera(poses(1)[0])], torch.tensor([[0.0, 0.0, 1.0]]).double(), [])
    assert torch.isfinite(alignment.rotation).all()
    assert torch.linalg.det(alignment.rotation).item() == pytest.approx(1.0)
    assert alignment.scale == pytest.approx(1 / float(np.sqrt(25.0)), rel=0.1)


def view(position: list[float], split: str = "train") -> View:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor(position)
    one = Camera(viewmat, torch.eye(3), 4, 4)
    return make_view(f"{position}", one, split)


def scene(*views: View, tmp: str = ".") -> Scene:
    from pathlib import Path

    points = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 4.0], [0.0, 0.0, 5.0]])
    colors = torch.zeros(3, 3, dtype=torch.uint8)
    return Scene(Path(tmp), views, points, colors, Alignment.identity())


def test_extent_is_that_of_the_cameras_that_train() -> None:
    views = [view([-1.0, 0, 0]), view([1.0, 0, 0]), view([50.0, 0, 0], "test")]
    assert scene_extent(scene(*views)) == pytest.approx(1.1)


def test_extent_of_one_place_is_the_distance_of_the_points() -> None:
    assert scene_extent(scene(view([0.0, 0, 0]))) == pytest.approx(1.1 * 4.0)
    with pytest.raises(ValueError, match="training"):
        scene_extent(scene(view([0.0, 0, 0], "test")))
