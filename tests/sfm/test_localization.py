"""New photos of a known place: found where they were taken; photos of anything else are refused."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.spatial import KDTree

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.geometry.lens import Lens
from wildgs.scene import Alignment, DataConfig, Scene, load_scene
from wildgs.scene.carried import carry_scene, read_carried_scene
from wildgs.sfm import feature_index as feature_index_module
from wildgs.sfm.feature_index import FeatureIndex, load_feature_index, match_features
from wildgs.sfm.localization import LocalizationError, LocalizedPhoto, guess_camera, localize

FOCAL = 1.2
LEFT_OUT = 3
AIM = np.array([0.0, 0.5, 0.5])


def corner_camera(position: np.ndarray, width: int = 320, height: int = 240) -> Camera:
    return Lens(FOCAL, width, height).camera(position, AIM - position)


def on_the_corner(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Where the rays through pixels meet the floor z = 0 or the wall y = 2."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    rays = rays @ np.linalg.inv(camera.K.double().numpy()).T @ camera.viewmat[:3, :3].double().numpy()
    place = camera.position.double().numpy()
    with np.errstate(divide="ignore"):
        floor = np.where(rays[:, 2] < 0, -place[2] / rays[:, 2], np.inf)
        wall = np.where(rays[:, 1] > 0, (2 - place[1]) / rays[:, 1], np.inf)
    return place + np.minimum(floor, wall)[:, None] * rays


@pytest.fixture(scope="session")
def corner_scene(corner, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five of six photos with true cameras; each photo's features are points of their own."""
    root = tmp_path_factory.mktemp("corner")
    (root / "images").mkdir()
    extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
    model = pycolmap.Reconstruction()
    for number, (pixels, position) in enumerate(zip(*corner, strict=True), start=1):
        name = f"{number}.png"
        if number - 1 == LEFT_OUT:
            continue
        Image.fromarray(pixels).save(root / "images" / name)
        camera = corner_camera(position)
        keypoints, _ = extractor.extract_from_uint8_array(np.asarray(Image.fromarray(pixels).convert("L")))
        places = np.array([(point.x, point.y) for point in keypoints])
        params = [FOCAL * 320, FOCAL * 320, 160, 120]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=320, height=240, params=params)
        )
        image = pycolmap.Image(name=name, keypoints=places, camera_id=number, image_id=number)
        pose = np.ascontiguousarray(camera.viewmat[:3].double().numpy())
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for row, point in enumerate(on_the_corner(camera, places)):
            track = pycolmap.Track()
            track.add_element(number, row)
            model.add_point3D(point, track, np.zeros(3, dtype=np.uint8))
    (root / "sparse" / "0").mkdir(parents=True)
    model.write_binary(root / "sparse" / "0")
    return root


@pytest.fixture(scope="session")
def known_corner(corner_scene: Path) -> Scene:
    return load_scene(corner_scene, DataConfig(holdout=0), alignment=Alignment.identity())


@pytest.fixture(scope="session")
def corner_landmarks(known_corner: Scene) -> FeatureIndex:
    return load_feature_index(known_corner)


@pytest.fixture
def save_query(corner, tmp_path: Path) -> Callable[..., Path]:
    """Writes the photo that the scene does not know, as another size or file."""

    def save(name: str = "query.png", scale: float = 1.0, **options) -> Path:
        image = Image.fromarray(corner[0][LEFT_OUT])
        size = (round(image.width * scale), round(image.height * scale))
        image.resize(size, Image.Resampling.BICUBIC).save(tmp_path / name, **options)
        return tmp_path / name

    return save


def assert_found(found: LocalizedPhoto, corner) -> None:
    true = corner_camera(corner[1][LEFT_OUT])
    assert float((found.camera.position - true.position).norm()) < 0.1  # of a distance of 5
    assert float(found.camera.forward @ true.forward) > 0.9995
    assert found.focal == pytest.approx(FOCAL, rel=0.03)
    assert found.inliers >= 40


def test_every_point_has_its_descriptor(corner_landmarks: FeatureIndex) -> None:
    """Or a point within one pixel of it has: those are one place to a camera, and may stand for one another."""
    described = np.unique(corner_landmarks.points[corner_landmarks.owners], axis=0)
    assert len(described) > 500
    distance, _ = KDTree(described).query(corner_landmarks.points)
    assert (distance < 5 / FOCAL).mean() > 0.95


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_a_new_photo_is_found(corner, corner_landmarks, save_query, scale) -> None:
    found = localize(save_query(scale=scale), corner_landmarks, 320)
    assert_found(found, corner)
    assert not found.focal_from_exif
    assert max(found.photo.shape[:2]) == pytest.approx(320, abs=4)
    assert found.photo.shape[:2] == (found.camera.height, found.camera.width)
    assert f"{found.inliers} inliers" in found.describe()


def test_what_the_camera_sees_is_what_the_photo_shows(corner, corner_landmarks, save_query) -> None:
    """Undistorted and shrunk, the photo still lies on the corner: its pixels are the texture's there."""
    found = localize(save_query(), corner_landmarks, 160)
    true = corner_camera(corner[1][LEFT_OUT])
    y, x = np.mgrid[20:100:8, 20:140:8]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    points = on_the_corner(found.camera, pixels)
    back = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ true.viewmat.double().numpy().T
    back = back[:, :3] / back[:, 2:3] @ true.K.double().numpy().T
    assert np.abs(back[:, :2] / 2 - pixels).max() < 1.5


def test_focal_length_from_exif(corner, corner_landmarks, save_query) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = round(FOCAL * 36)  # FocalLengthIn35mmFilm
    file = save_query("query.jpg", quality=97, exif=exif)
    camera, known = guess_camera(file, 320, 240)
    assert known
    assert camera.params[0] / 320 == pytest.approx(FOCAL, rel=0.1)
    found = localize(file, corner_landmarks, 320)
    assert found.focal_from_exif
    assert_found(found, corner)


def test_colmap_sees_no_byte_of_a_strangers_file(save_query, monkeypatch: pytest.MonkeyPatch) -> None:
    file = save_query("query.jpg", comment=b"hostile", exif=Image.Exif())
    handed: list[bytes] = []
    infer = pycolmap.infer_camera_from_image

    def record(path: Path):
        handed.append(Path(path).read_bytes())
        return infer(path)

    monkeypatch.setattr(pycolmap, "infer_camera_from_image", record)
    guess_camera(file, 320, 240)
    assert b"hostile" in file.read_bytes()
    (content,) = handed
    assert b"hostile" not in content


def test_the_camera_stands_in_the_aligned_frame(corner, corner_scene, save_query) -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    alignment = Alignment(turn, torch.tensor([3.0, 0, 1], dtype=torch.float64), 0.5)
    scene = load_scene(corner_scene, DataConfig(holdout=0), alignment=alignment)
    found = localize(save_query(), load_feature_index(scene), 320)
    expected = alignment.apply_points(torch.from_numpy(corner[1][LEFT_OUT]))
    assert float((found.camera.position.double() - expected).norm()) < 0.05


def other_pictures() -> dict[str, np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    return {
        "noise": np.asarray(Image.fromarray(noise).resize((320, 240), Image.Resampling.BICUBIC)),
        "blank": np.full((64, 64, 3), 128, dtype=np.uint8),
    }


@pytest.mark.parametrize("kind", ["noise", "blank"])
def test_other_pictures_are_refused_with_the_count(corner_landmarks, tmp_path, kind) -> None:
    Image.fromarray(other_pictures()[kind]).save(tmp_path / "x.png")
    with pytest.raises(
        LocalizationError, match=r"x\.png: could not be localised \(\d+ inliers of \d+ matches"
    ):
        localize(tmp_path / "x.png", corner_landmarks, 320)


def test_a_file_that_is_no_picture(corner_landmarks, tmp_path) -> None:
    (tmp_path / "x.jpg").write_text("no")
    with pytest.raises(UserError, match=r"x\.jpg"):
        localize(tmp_path / "x.jpg", corner_landmarks, 320)


def test_what_a_run_carries_is_enough(corner, known_corner, save_query, tmp_path) -> None:
    carry_scene(tmp_path / "run", known_corner)
    carried = read_carried_scene(tmp_path / "run")
    assert carried is not None
    assert_found(localize(save_query(), load_feature_index(carried), 320), corner)


def test_landmarks_are_kept_and_made_anew_for_another_model(known_corner, tmp_path, monkeypatch) -> None:
    cache = tmp_path / "feature_index.safetensors"
    first = load_feature_index(known_corner, cache)
    with monkeypatch.context() as patch:
        patch.setattr(feature_index_module, "_index_features", lambda *_: pytest.fail("detected again"))
        second = load_feature_index(known_corner, cache)
    assert np.array_equal(first.descriptors, second.descriptors)
    assert np.array_equal(first.points, second.points)
    monkeypatch.setattr(
        feature_index_module,
        "_index_features",
        lambda *_: FeatureIndex(*(x[:5] for x in vars(first).values())),
    )
    other = replace(known_corner, points=known_corner.points + 1)
    assert len(load_feature_index(other, cache).points) == 5


def test_a_folder_that_cannot_be_written_to_is_no_fault(known_corner, monkeypatch, corner_landmarks) -> None:
    monkeypatch.setattr(feature_index_module, "_index_features", lambda *_: corner_landmarks)
    assert len(load_feature_index(known_corner, Path("/proc/none/feature_index.safetensors")).points)


def test_a_model_without_observations_is_said(make_scene) -> None:
    scene = load_scene(make_scene(3))  # its photos show nothing that could be found again
    with pytest.raises(UserError, match=r"cannot be localised"):
        load_feature_index(scene)
    with pytest.raises(UserError, match=r"cannot be localised"):
        load_feature_index(replace(scene, observations=scene.observations[:0]))


def test_the_ratio_test_looks_at_other_points_only() -> None:
    """Two equal descriptors of one point do not contradict each other; those of two points do."""
    descriptors = np.zeros((4, 128), dtype=np.uint8)
    descriptors[0, :2], descriptors[1, :2] = (100, 10), (100, 12)
    descriptors[2, 5:7], descriptors[3, 5:7] = (100, 10), (100, 12)
    known = FeatureIndex(descriptors, np.array([0, 0, 1, 2]), np.zeros((3, 3)))
    features = np.zeros((2, 128), dtype=np.uint8)
    features[0, :2], features[1, 5:7] = (100, 11), (100, 11)
    matched, seen = match_features(features, known, 0.8)
    assert list(matched) == [0]
    assert list(seen) == [0]


def test_models_and_photos_are_read_in_python(
    corner_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP's own reader believes what files declare, and reads rigs and frames as well."""
    shutil.copytree(corner_scene, tmp_path / "scene")
    model = tmp_path / "scene/sparse/0"
    for name in ("rigs.bin", "frames.bin"):
        assert (model / name).is_file()
        (model / name).write_bytes(struct.pack("<Q", 2**60))
    monkeypatch.setattr(pycolmap, "Reconstruction", lambda *_: pytest.fail("read by COLMAP"))
    monkeypatch.setattr(pycolmap, "extract_features", lambda *_: pytest.fail("photos read by COLMAP"))
    index = load_feature_index(load_scene(tmp_path / "scene", DataConfig(holdout=0)))
    assert len(index.descriptors) > 500
