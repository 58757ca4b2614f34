"""Other programs' libraries read back what was written."""

from __future__ import annotations

import gzip
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from wildgs.errors import UserError
from wildgs.exporters.formats import ply_bytes, write_splats
from wildgs.exporters.splats import Splats

gaussforge = pytest.importorskip("gaussforge")
gsply = pytest.importorskip("gsply")


def _close(found: np.ndarray, expected: torch.Tensor, tolerance: float) -> None:
    np.testing.assert_allclose(found, expected.numpy(), atol=tolerance, rtol=0)


def _logits(splats: Splats) -> torch.Tensor:
    return splats.opacities.logit()


def _same_turn(found: np.ndarray, quats: torch.Tensor) -> None:
    unit = torch.nn.functional.normalize(quats, dim=1).numpy()
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    assert np.abs((found * unit).sum(axis=1)).min() > 1 - 1e-4


def _same_ellipsoid(found: np.ndarray, quats: torch.Tensor) -> None:
    """The same orientation, but for half turns about a Gaussian's own axes, which change nothing."""
    turns = (Rotation.from_quat(q, scalar_first=True).as_matrix() for q in (found, quats.numpy()))
    one, other = turns
    assert np.abs(np.einsum("nij,nij->nj", one, other)).min() > 1 - 1e-3


def test_gsply_reads_the_ply_without_loss(splats: Splats, tmp_path: Path) -> None:
    file = tmp_path / "folder" / "scene.ply"
    write_splats(file, splats, "ply")
    read = gsply.plyread(file)
    _close(read.means, splats.means, 0)
    _close(read.scales, splats.scales.log(), 1e-6)
    _close(read.opacities, _logits(splats), 1e-5)
    _close(read.sh0, splats.sh[:, 0], 0)
    _close(read.shN, splats.sh[:, 1:], 0)
    _same_turn(read.quats, splats.quats)
    assert [path.name for path in file.parent.iterdir()] == ["scene.ply"]


def test_the_plys_columns_are_named_as_3dgs_names_them(splats: Splats) -> None:
    header = ply_bytes(splats).split(b"end_header\n")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property float")]
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"]
    assert names[6:9] == ["f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{index}" for index in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


@pytest.mark.parametrize(("full_sh", "coefficients"), [(True, 45), (False, 9)])
def test_a_ply_of_degree_1_has_zeros_above_unless_it_shall_be_small(
    splats: Splats, tmp_path: Path, full_sh: bool, coefficients: int
) -> None:
    file = tmp_path / "scene.ply"
    write_splats(file, splats.with_sh(splats.sh[:, :4]), "ply", full_sh=full_sh)
    assert file.read_bytes().count(b"property float f_rest_") == coefficients
    read = gsply.plyread(file).shN
    _close(read[:, :3], splats.sh[:, 1:4], 0)
    assert not read[:, 3:].any()


def test_opaque_and_invisible_gaussians_stay_finite(splats: Splats, tmp_path: Path) -> None:
    extreme = Splats(
        splats.means[:2], splats.quats[:2], splats.scales[:2], torch.tensor([0.0, 1.0]), splats.sh[:2, :1]
    )
    file = tmp_path / "extreme.ply"
    write_splats(file, extreme, "ply")
    read = gsply.plyread(file)
    assert np.isfinite(read.opacities).all()
    assert read.opacities[0] < -10 < 10 < read.opacities[1]


@pytest.mark.timeout(900)  # gsply compiles on first use
def test_gsply_reads_the_compressed_ply(splats: Splats, tmp_path: Path) -> None:
    file = tmp_path / "scene.compressed.ply"
    write_splats(file, splats, "compressed.ply")
    read = gaussforge.GaussForge().read(file.read_bytes(), "compressed.ply")["data"]
    places = np.frombuffer(read["positions"], "<f4").reshape(-1, 3)
    # PlayCanvas's format keeps no order within its chunks: match by place.
    order = np.linalg.norm(places[:, None] - splats.means.numpy()[None], axis=2).argmin(axis=1)
    assert sorted(order) == list(range(len(splats)))
    _close(places, splats.means[order], 0.02)
    _close(gsply.plyread(file).shN, splats.sh[order, 1:], 0.02)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_has_the_version_that_was_asked_for(splats: Splats, tmp_path: Path, version) -> None:
    file = tmp_path / "scene.spz"
    write_splats(file, splats, "spz", spz_version=version)
    content = file.read_bytes()
    header = content if version == 4 else gzip.decompress(content)
    assert struct.unpack("<4sI", header[:8]) == (b"NGSP", version)
    read = gsply.read_spz(file)
    turned = splats.rotated(torch.diag(torch.tensor([1.0, -1.0, -1.0])))
    _close(read.means, turned.means, 1e-4)
    _same_turn(read.quats, turned.quats)


def test_gaussforge_reads_the_spz_in_the_formats_own_axes(splats: Splats, tmp_path: Path) -> None:
    file = tmp_path / "scene.spz"
    write_splats(file, splats, "spz", spz_version=3)
    read = gaussforge.GaussForge().read(file.read_bytes(), "spz")["data"]
    places = np.frombuffer(read["positions"], "<f4").reshape(-1, 3)
    assert places.shape == (len(splats), 3)
    flip = torch.tensor([1.0, -1.0, -1.0])
    _close(places, splats.means * flip, 1e-4)
    turned = splats.rotated(torch.diag(flip))
    _same_turn(np.frombuffer(read["rotations"], "<f4").reshape(-1, 4), turned.quats)
    _close(np.frombuffer(read["sh"], "<f4").reshape(-1, 15, 3), turned.sh[:, 1:], 0.13)


def test_spz_holds_coordinates_far_from_the_origin(splats: Splats, tmp_path: Path) -> None:
    far = replace(splats, means=splats.means + 5000)
    file = tmp_path / "far.spz"
    write_splats(file, far, "spz", spz_version=3)
    read = gaussforge.GaussForge().read(file.read_bytes(), "spz")["data"]
    places = np.frombuffer(read["positions"], "<f4").reshape(-1, 3)
    _close(places[:, 0], far.means[:, 0], 2e-3)
    with pytest.raises(UserError, match=r"too large for \.spz"):
        write_splats(file, replace(splats, means=far.means * 1e4), "spz")


def test_splat_holds_places_sizes_and_flat_colours(splats: Splats, tmp_path: Path) -> None:
    file = tmp_path / "scene.splat"
    write_splats(file, splats, "splat")
    rows = np.frombuffer(
        file.read_bytes(), [("place", "<f4", 3), ("size", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)]
    )
    order = np.linalg.norm(rows["place"][:, None] - splats.means.numpy()[None], axis=2).argmin(axis=1)
    assert sorted(order) == list(range(len(splats)))
    _close(rows["size"], splats.scales[order], 1e-5)
    colors = (0.5 + 0.28209479 * splats.sh[order, 0]).clamp(0, 1)
    _close(rows["rgba"][:, :3] / 255, colors, 3 / 255)
    _close(rows["rgba"][:, 3] / 255, splats.opacities[order], 3 / 255)


def test_sog_is_an_archive_of_pictures(splats: Splats, tmp_path: Path) -> None:
    file = tmp_path / "scene.sog"
    write_splats(file, splats, "sog")
    read = gaussforge.GaussForge().read(file.read_bytes(), "sog")["data"]
    places = np.frombuffer(read["positions"], "<f4").reshape(-1, 3)
    distance = np.linalg.norm(places[:, None] - splats.means.numpy()[None], axis=2).min(axis=1)
    assert distance.max() < 2e-3


@pytest.mark.parametrize("kind", ["compressed.ply", "splat", "spz", "sog"])
def test_playcanvas_reads_what_we_write(splats: Splats, tmp_path: Path, kind) -> None:
    tool = shutil.which("splat-transform")
    if tool is None:
        pytest.skip("no splat-transform on the PATH (npm i -g @playcanvas/splat-transform)")
    file, back = tmp_path / f"scene.{kind}", tmp_path / "back.ply"
    write_splats(file, splats, kind)
    subprocess.run([tool, "-w", str(file), str(back)], check=True, capture_output=True, timeout=120)
    read = gsply.plyread(back)
    order = np.linalg.norm(read.means[:, None] - splats.means.numpy()[None], axis=2).argmin(axis=1)
    assert sorted(order) == list(range(len(splats)))
    _close(read.scales, splats.scales[order].log(), 0.07)
    _same_ellipsoid(read.quats, splats.quats[order])
    if kind != "splat":
        _close(read.shN, splats.sh[order, 1:], 0.13)


def test_a_missing_package_is_one_line_that_says_how_to_get_it(
    splats: Splats, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(UserError, match=r"pip install 'wildgs\[export\]'"):
        write_splats(tmp_path / "scene.spz", splats, "spz")
    assert not list(tmp_path.iterdir())
