"""Camera files: our JSON comes back as it went, nerfstudio's lands where nerfstudio means, mistakes are named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.geometry.camera_file import read_camera_path, write_camera_path
from wildgs.geometry.lens import Lens

OWN = {"cameras": [{"viewmat": np.eye(4).tolist(), "fov": 90, "width": 40, "height": 20}]}


@pytest.fixture
def cameras() -> list[Camera]:
    lens = Lens(0.9, 64, 48)
    return [lens.camera(np.array([0.1 * i, -1, 0.3]), np.array([0.0, 1, 0.1 * i])) for i in range(3)]


def write(file: Path, content) -> Path:
    file.write_text(json.dumps(content))
    return file


def test_round_trip(tmp_path: Path, cameras) -> None:
    file = tmp_path / "deep" / "path.json"
    write_camera_path(file, cameras, fps=24.0, frame="colmap")
    path = read_camera_path(file)
    assert (path.fps, path.frame, len(path.cameras)) == (24, "colmap", 3)
    for before, after in zip(cameras, path.cameras, strict=True):
        torch.testing.assert_close(after.viewmat.float(), before.viewmat)
        torch.testing.assert_close(after.K.float(), before.K)
        assert (after.width, after.height) == (64, 48)


def test_field_of_view_and_common_size(tmp_path: Path) -> None:
    content = {"width": 40, "height": 20, "cameras": [{"viewmat": np.eye(4).ravel().tolist(), "fov": 90}]}
    path = read_camera_path(write(tmp_path / "a.json", content))
    assert float(path.cameras[0].K[0, 0]) == pytest.approx(10)
    assert float(path.cameras[0].K[0, 2]) == pytest.approx(20)
    assert (path.fps, path.frame) == (30, "scene")


def nerfstudio(pose: np.ndarray) -> dict:
    return {
        "camera_type": "perspective",
        "render_height": 20,
        "render_width": 40,
        "fps": 24,
        "seconds": 1,
        "camera_path": [{"camera_to_world": pose.ravel().tolist(), "fov": 90, "aspect": 2}],
    }


def test_nerfstudio_axes(tmp_path: Path) -> None:
    """OpenGL looks along -z with y up; at the origin that is our camera turned about x by 180 degrees."""
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    camera = read_camera_path(write(tmp_path / "path.json", nerfstudio(pose))).cameras[0]
    torch.testing.assert_close(camera.position, torch.tensor([1.0, 2, 3]).double())
    torch.testing.assert_close(camera.forward, torch.tensor([0.0, 0, -1]).double())
    torch.testing.assert_close(camera.up, torch.tensor([0.0, 1, 0]).double())
    assert float(camera.K[1, 1]) == pytest.approx(10)


def test_nerfstudio_goes_back_to_the_model_with_its_parsers_transform(tmp_path: Path) -> None:
    """nerfstudio's position is scale * (R x + t); the file beside the path undoes it."""
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    offset, scale = np.array([0.5, 0, -1]), 0.25
    place = np.array([4.0, -2, 1])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, scale * (rotation @ place + offset)
    transform = np.concatenate([rotation, offset[:, None]], axis=1)
    write(tmp_path / "dataparser_transforms.json", {"transform": transform.tolist(), "scale": scale})
    path = read_camera_path(write(tmp_path / "path.json", nerfstudio(pose)))
    assert path.frame == "colmap"
    torch.testing.assert_close(path.cameras[0].position, torch.from_numpy(place))
    torch.testing.assert_close(path.cameras[0].forward, torch.tensor([0.0, 0, -1]).double())


def entry(**changes) -> dict:
    return {"cameras": [{**OWN["cameras"][0], **changes}]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([], "neither 'cameras'"),
        ({"cameras": []}, "no cameras"),
        ({**OWN, "frame": "moon"}, "moon"),
        ({**OWN, "fps": 0}, "fps"),
        (entry(viewmat=[1, 2, 3]), r"cameras\[0\]: expected 4 x 4"),
        (entry(viewmat=(2 * np.eye(4)).tolist()), "rigid"),
        (entry(viewmat=np.diag([1, 1, -1, 1]).tolist()), "rigid"),
        (entry(fov=180), "180 degrees"),
        (entry(K=np.zeros((3, 3)).tolist()), "focal lengths above 0"),
        (entry(K=[[20, 3, 20], [0, 20, 10], [0, 0, 1]]), "K must be"),
        (entry(viewmat=np.diag([1, 1, 1, 0]).tolist()), "rigid"),
        (entry(width=0), "integers from 1"),
        (entry(width=None), "integers from 1"),
        (entry(width=float("inf")), "integers from 1"),
        (entry(width=10**9), "integers from 1"),
        ({"cameras": [{"viewmat": np.eye(4).tolist(), "width": 4, "height": 4}]}, "missing entry 'fov'"),
        ({**nerfstudio(np.eye(4)), "camera_type": "equirectangular"}, "equirectangular"),
        (nerfstudio(np.eye(3)), "4 x 4"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, content, words) -> None:
    with pytest.raises(UserError, match=words) as caught:
        read_camera_path(write(tmp_path / "a.json", content))
    assert "a.json" in str(caught.value)


def test_files_that_are_not_there_or_no_json(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_camera_path(tmp_path / "a.json")
    (tmp_path / "b.json").write_text("{")
    with pytest.raises(UserError, match="JSON"):
        read_camera_path(tmp_path / "b.json")
