"""The Python API: the documented example runs as it stands; scenes are read only as far as needed."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import wildgs
from wildgs.errors import UserError, WildGSWarning
from wildgs.scene.carried import CarriedPhotos

DOCS = Path(__file__).parents[1] / "docs" / "python.md"


@pytest.fixture(scope="module")
def scene(trained: Path) -> wildgs.LoadedScene:
    return wildgs.load(trained)


def test_the_documented_examples_run_in_order(
    trained: Path, landmark: Path, tmp_path: Path, monkeypatch
) -> None:
    examples = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 5
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WILDGS_LPIPS", "off")
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "gate").symlink_to(landmark)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "gate").symlink_to(trained)
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, str(DOCS), "exec"), names)
    assert len(names["losses"]) == 20  # pyright: ignore
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {*(f"frame_{number:03d}.png" for number in range(5)), "relit.png", "still.png"}
    assert {"first.ply", "bench"} <= {path.name for path in tmp_path.iterdir()}


def test_the_documentation_names_every_function() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for name in wildgs._MODULES:
        assert name in text, name


def test_importing_the_package_loads_no_torch() -> None:
    code = "import sys, wildgs; wildgs.__version__; assert 'torch' not in sys.modules; assert 'load' in dir(wildgs)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = wildgs.nothing


def test_render_is_the_methods_render(scene) -> None:
    view = scene.views[0]
    look = scene.appearance(view.name)
    with torch.no_grad():
        expected = scene.run.method.render(view.camera, look.sh).colors.clamp(0, 1) * 255
    picture = scene.render(view.camera, look)
    assert picture.shape == view.read_photo().shape
    assert float((picture.float() - expected).abs().max()) <= 0.51


def test_light_moves_colours_and_no_geometry(scene) -> None:
    camera = scene.views[0].camera
    first, second = (scene.appearance(view.name) for view in scene.views[:2])
    assert not torch.equal(scene.render(camera, first), scene.render(camera, second))
    renderings = [scene.run.method.render(camera, look.sh) for look in (first, second)]
    assert torch.equal(renderings[0].depth, renderings[1].depth)
    assert torch.equal(renderings[0].depth, scene.depth(camera))


def test_photos_are_decoded_as_they_are_needed(trained: Path, monkeypatch) -> None:
    decoded = []
    decode = CarriedPhotos._decode
    monkeypatch.setattr(
        CarriedPhotos, "_decode", lambda photos, name: decoded.append(name) or decode(photos, name)
    )
    scene = wildgs.load(trained)
    names = [view.name for view in scene.views]
    assert decoded == []
    scene.appearance(names[3])
    scene.views[3].read_photo()
    assert decoded == [names[3]]


def test_frames_follow_cameras_and_lights(scene) -> None:
    looks = [scene.appearance(view.name) for view in scene.views[:2]]
    cameras = scene.path("orbit", frames=3, size=(24, 16))
    frames = list(scene.frames(cameras, looks))
    assert [frame.shape for frame in frames] == [(16, 24, 3)] * 3
    assert torch.equal(frames[0], scene.render(cameras[0], looks[0]))
    assert torch.equal(frames[2], scene.render(cameras[2], looks[1]))
    middle = wildgs.mix(looks, [0.5, 0.5])
    assert torch.equal(frames[1], scene.render(cameras[1], middle))


def test_paths_are_of_the_photos_usual_size_unless_told(scene) -> None:
    sizes = np.array([sorted((view.camera.width, view.camera.height)) for view in scene.views])
    camera = scene.path("spiral", frames=2)[0]
    assert (camera.height, camera.width) == tuple(np.median(sizes, axis=0) // 2 * 2)
    with pytest.raises(UserError, match="at least one"):
        scene.path("orbit", frames=0)


def test_a_look_given_is_given_back(scene) -> None:
    look = scene.appearance(scene.views[0].name)
    assert scene.appearance(look) is look


def test_names_are_not_looks(scene) -> None:
    # Without the shape checks of these tests, which refuse other types themselves.
    name, look = scene.views[0].name, scene.appearance("neutral")
    render, mix = (inspect.unwrap(function) for function in (wildgs.LoadedScene.render, wildgs.mix))
    with pytest.raises(UserError, match=rf"'{name}' is not an appearance; .* scene\.appearance\(name\)"):
        render(scene, scene.views[0].camera, name)
    with pytest.raises(UserError, match="'neutral' is not an appearance"):
        mix([look, "neutral"], [0.5, 0.5])
    with pytest.raises(UserError, match="an appearance without a name"):
        scene.appearance("")


def test_plain_3dgs_has_its_own_light(landmark: Path, tmp_path: Path) -> None:
    from wildgs.cli import main

    main(["train", str(landmark), "--output", str(tmp_path / "run"), "--method", "3dgs", "--steps", "5"])
    scene = wildgs.load(tmp_path / "run")
    assert not scene.relightable
    with pytest.warns(WildGSWarning, match="cannot be relit"):
        look = scene.appearance(scene.views[0].name)
    other = scene.appearance("neutral")
    camera = scene.views[0].camera
    mixed = wildgs.mix([look, other], [0.5, 0.5])
    assert torch.equal(scene.render(camera, mixed), scene.render(camera, look))
