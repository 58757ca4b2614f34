"""Files with several lights: read back without our own code."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from wildgs.errors import UserError
from wildgs.exporters import usd
from wildgs.exporters.glb import EXTENSION, glb_bytes
from wildgs.exporters.lights import (
    ExportLight,
    RelightableScene,
    SharedHarmonics,
    share_harmonics,
    upright,
)
from wildgs.exporters.splats import Splats
from wildgs.exporters.usd import write_usd
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import sh_values
from wildgs.scene.scene import Alignment

COUNTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
TYPES = {5126: np.float32, 5121: np.uint8, 5125: np.uint32}


def _camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 5.0
    return Camera(viewmat, torch.tensor([[50.0, 0, 24], [0, 50, 16], [0, 0, 1]]), 48, 32)


def _scene(splats: Splats, lights: int) -> RelightableScene:
    picture = np.full((20, 30, 3), 128, np.uint8)
    return RelightableScene(
        title="a <gate>",
        splats=splats,
        lights=[
            ExportLight(f"photo {n}.jpg", splats.sh * (1 + n), picture, "2019-07-01T12:30:00" if n else None)
            for n in range(lights)
        ],
        start=_camera(),
        near=0.1,
        placement=Alignment.identity(),
    )


def _shared(scene: RelightableScene, own_share: float) -> SharedHarmonics:
    viewpoints = torch.tensor([[0.0, -9.0, 0.0], [6.0, -8.0, 1.0], [-5.0, -9.0, 2.0]])
    return share_harmonics(scene.splats, [light.sh for light in scene.lights], viewpoints, own_share)


class Glb:
    """A GLB file by its specification."""

    def __init__(self, content: bytes) -> None:
        magic, version, total, length, kind = struct.unpack("<4sIII4s", content[:20])
        assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
        self.json: dict[str, Any] = json.loads(content[20 : 20 + length])
        size, kind = struct.unpack("<I4s", content[20 + length : 28 + length])
        assert kind == b"BIN\0"
        self.data = content[28 + length :]
        assert len(self.data) == size == self.json["buffers"][0]["byteLength"]

    def _view(self, index: int, kind: int, columns: int) -> np.ndarray:
        view = self.json["bufferViews"][index]
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(self.data, TYPES[kind], view["byteLength"] // TYPES[kind]().itemsize,
                               view["byteOffset"])  # fmt: skip
        return values.reshape(-1, columns).copy()

    def read(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        kind, columns = accessor["componentType"], COUNTS[accessor["type"]]
        values = self._view(accessor["bufferView"], kind, columns)
        assert len(values) == accessor["count"]
        if sparse := accessor.get("sparse"):
            rows = self._view(sparse["indices"]["bufferView"], sparse["indices"]["componentType"], 1)[:, 0]
            assert (np.diff(rows.astype(int)) > 0).all()
            values[rows] = self._view(sparse["values"]["bufferView"], kind, columns)
        return values

    def attributes(self, scene: int) -> dict[str, int]:
        node = self.json["nodes"][self.json["scenes"][scene]["nodes"][0]]
        (primitive,) = self.json["meshes"][node["mesh"]]["primitives"]
        assert primitive["mode"] == 0
        assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
        return primitive["attributes"]

    def harmonics(self, scene: int) -> np.ndarray:
        found = self.attributes(scene)
        names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{c}" for d in range(4) for c in range(2 * d + 1)]
        return np.stack([self.read(found[name]) for name in names if name in found], axis=1)


def test_each_light_is_a_scene_and_the_geometry_is_stored_once(splats: Splats) -> None:
    scene = _scene(splats, 3)
    glb = Glb(glb_bytes(scene, _shared(scene, 0.1)))
    assert glb.json["extensionsUsed"] == [EXTENSION]
    assert [each["name"] for each in glb.json["scenes"]] == ["photo 0.jpg", "photo 1.jpg", "photo 2.jpg"]
    assert "captured" not in glb.json["scenes"][0]["extras"]
    assert glb.json["scenes"][1]["extras"]["captured"] == "2019-07-01T12:30:00"
    assert glb.json["scenes"][1]["extras"]["thumbnail"].startswith("data:image/jpeg;base64,")
    shared = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
    for name in shared:
        assert len({glb.attributes(number)[name] for number in range(3)}) == 1
    place, turn, scale, opacity = (glb.read(glb.attributes(0)[name]) for name in shared)
    np.testing.assert_array_equal(place, splats.means)
    np.testing.assert_array_equal(scale, splats.scales)
    np.testing.assert_array_equal(opacity[:, 0], splats.opacities)
    unit = torch.nn.functional.normalize(splats.quats, dim=1)
    np.testing.assert_allclose(turn[:, [3, 0, 1, 2]], unit, atol=1e-6)
    ends = glb.json["accessors"][glb.attributes(0)["POSITION"]]
    np.testing.assert_array_equal(ends["max"], place.max(axis=0))


@pytest.mark.parametrize("own_share", [0.0, 0.2, 1.0])
def test_harmonics_are_those_that_were_shared(splats: Splats, own_share: float) -> None:
    scene = _scene(splats, 3)
    harmonics = _shared(scene, own_share)
    glb = Glb(glb_bytes(scene, harmonics))
    for number, light in enumerate(scene.lights):
        np.testing.assert_array_equal(glb.harmonics(number), harmonics.whole(number))
        if own_share == 1:
            np.testing.assert_array_equal(glb.harmonics(number), light.sh)


def test_one_light_is_exact(splats: Splats) -> None:
    scene = _scene(splats, 1)
    np.testing.assert_array_equal(Glb(glb_bytes(scene, _shared(scene, 0.0))).harmonics(0), splats.sh)


def test_shared_harmonics_keep_the_mean_colour_towards_the_cameras(splats: Splats) -> None:
    scene = _scene(splats, 3)
    harmonics = _shared(scene, 0.0)
    viewpoints = torch.tensor([[0.0, -9.0, 0.0], [6.0, -8.0, 1.0], [-5.0, -9.0, 2.0]])

    def mean_color(sh: torch.Tensor) -> torch.Tensor:
        towards = [torch.nn.functional.normalize(splats.means - eye, dim=1) for eye in viewpoints]
        return torch.stack([sh_values(sh, each) for each in towards]).mean(dim=0)

    for number, light in enumerate(scene.lights):
        torch.testing.assert_close(
            mean_color(harmonics.whole(number)), mean_color(light.sh), atol=1e-4, rtol=1e-4
        )


def test_eight_lights_take_at_most_two_and_a_half_times_the_space_of_one(splats: Splats) -> None:
    rows = torch.arange(30_000) % len(splats)
    many = Splats(splats.means[rows], splats.quats[rows], splats.scales[rows], splats.opacities[rows],
                  splats.sh[rows, :4])  # fmt: skip
    one, eight = (len(glb_bytes(scene, _shared(scene, 0.09))) for scene in (_scene(many, 1), _scene(many, 8)))
    assert eight < 2.5 * one


def test_the_camera_of_the_file_sees_what_ours_sees(splats: Splats) -> None:
    glb = Glb(glb_bytes(_scene(splats, 1), _shared(_scene(splats, 1), 0.0)))
    node = glb.json["nodes"][1]
    lens = glb.json["cameras"][node["camera"]]["perspective"]
    x, y, z, w = node["rotation"]
    forward = -np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(forward, _camera().forward, atol=1e-6)
    np.testing.assert_allclose(node["translation"], [0, 0, -5], atol=1e-6)
    assert lens["yfov"] == pytest.approx(2 * np.arctan(16 / 50))
    assert lens["aspectRatio"] == pytest.approx(1.5)


@pytest.mark.parametrize("aligned", [True, False])
def test_files_stand_upright_and_lead_back_to_the_input(splats: Splats, aligned: bool) -> None:
    turn = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    alignment = Alignment(turn, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 0.5)
    motion = upright(alignment, aligned=aligned)
    moved = splats.moved(motion)
    up = motion.apply_points(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    torch.testing.assert_close(up[0] - up[1], torch.tensor([0.0, 1.0, 0.0]) * motion.scale)
    origin = motion.apply_points(alignment.apply_points(torch.zeros(1, 3)))
    if not aligned:
        torch.testing.assert_close(origin, torch.zeros(1, 3))
        torch.testing.assert_close(moved.scales, splats.to_input_frame(alignment).scales)


def test_variants_of_photos_with_like_names_are_kept_apart() -> None:
    """Of two variants of one name, the first light would be lost."""
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed")
    names = usd.variant_names(usd._modules(), ["a_2.jpg", "a.jpg", "a.png", "a 2.jpg", "caf\udce9.jpg"])
    assert len(set(names)) == 5
    assert names[:3] == ["a_2", "a", "a_3"]


def test_names_that_are_not_utf8_are_valid_json(splats: Splats) -> None:
    scene = _scene(splats, 1)
    scene = replace(scene, lights=[replace(scene.lights[0], name="caf\udce9\n.jpg")])
    glb = Glb(glb_bytes(scene, _shared(scene, 1.0)))
    assert glb.json["scenes"][0]["name"] == "caf\\xe9\\n.jpg"


def test_usd_core_reads_every_light_of_the_variant_set(splats: Splats, tmp_path: Path) -> None:
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed")
    from pxr import Usd, UsdValidation, UsdVol

    scene, file = _scene(splats, 3), tmp_path / "new folder" / "scene.usd"
    write_usd(file, scene)
    assert [path.name for path in file.parent.iterdir()] == ["scene.usd"]
    stage = Usd.Stage.Open(str(file))
    root = stage.GetDefaultPrim()
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(usd.PRIM))
    variants = root.GetVariantSet(usd.VARIANT_SET)
    assert variants.GetVariantNames() == ["photo_0", "photo_1", "photo_2"]
    assert variants.GetVariantSelection() == "photo_0"
    for name, light in zip(variants.GetVariantNames(), scene.lights, strict=True):
        variants.SetVariantSelection(name)
        values = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
        np.testing.assert_array_equal(values.reshape(-1, 16, 3), light.sh)
        assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3
        assert root.GetCustomDataByKey("photo") == light.name
    first = field.GetOrientationsAttr().Get()[0]
    unit = torch.nn.functional.normalize(splats.quats, dim=1)[0]
    np.testing.assert_allclose([first.GetReal(), *first.GetImaginary()], unit, atol=1e-6)
    np.testing.assert_array_equal(np.array(field.GetPositionsAttr().Get()), splats.means)
    np.testing.assert_array_equal(np.array(field.GetScalesAttr().Get()), splats.scales)
    np.testing.assert_array_equal(np.array(field.GetOpacitiesAttr().Get()), splats.opacities)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    # As `usdchecker` does, which usd-core does not bring: under every light, and with none selected.
    for name in (*variants.GetVariantNames(), ""):
        variants.SetVariantSelection(name)
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
        assert [error.GetMessage() for error in errors] == [], name


def test_usd_variants_of_photos_with_one_stem_are_told_apart(splats: Splats, tmp_path: Path) -> None:
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed")
    from pxr import Usd

    lights = [ExportLight(name, splats.sh, np.zeros((4, 4, 3), np.uint8)) for name in ("1.jpg", "1.png")]
    write_usd(tmp_path / "a.usd", replace(_scene(splats, 1), lights=lights))
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    assert len(stage.GetDefaultPrim().GetVariantSet(usd.VARIANT_SET).GetVariantNames()) == 2


def test_without_usd_core_one_line_says_how_to_get_it(
    splats: Splats, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(usd.importlib, "import_module", missing)
    with pytest.raises(UserError, match=r"pip install 'wildgs\[usd\]'"):
        write_usd(tmp_path / "scene.usd", _scene(splats, 1))
    assert not list(tmp_path.iterdir())
