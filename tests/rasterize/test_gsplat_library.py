"""The CUDA backend against the installed gsplat: versions, signatures, and what users read where it cannot work."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import filelock
import pytest
import torch
from torch import Tensor

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.rasterize import blend, blend_sample, cuda, gsplat_library, project, sh_to_colors
from wildgs.rasterize.gsplat_library import check_interface, load_gsplat

gsplat = pytest.importorskip("gsplat")
CAMERA = Camera(torch.eye(4), torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48)
N = 7


def test_missing_gsplat_is_a_users_mistake(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(UserError, match=r"pip install 'gsplat>=1.5.3,<1.6'"):
        gsplat_library.import_gsplat()


def test_the_installed_version_fits_and_others_are_named():
    check_interface(gsplat, "1.5.3")
    check_interface(gsplat, "1.5.4.post1")
    for version in ("1.5.2", "1.4.0", "1.6.0", "2.0"):
        with pytest.raises(UserError, match=rf"gsplat {version} .*not supported.*gsplat>=1.5.3,<1.6"):
            check_interface(gsplat, version)


def test_a_changed_signature_is_found():
    def isect_tiles(
        means2d, radii, depths, tile_size, tile_width, tile_height, sort=True, packed=False, n_cameras=None
    ):
        """As in gsplat 1.5.0 to 1.5.2."""

    changed = SimpleNamespace(**{name: getattr(gsplat, name) for name in gsplat_library._CALLS})
    changed.isect_tiles = isect_tiles
    with pytest.raises(UserError, match="signature of isect_tiles differs"):
        check_interface(changed, None)


def backend_module(monkeypatch: pytest.MonkeyPatch, extension: Any) -> None:
    """Stands for gsplat's module that builds the extension when it is imported."""
    load_gsplat.cache_clear()
    module = ModuleType("gsplat.cuda._backend")
    if isinstance(extension, Exception):

        def fails(name: str) -> Any:
            raise extension

        module.__getattr__ = fails  # type: ignore[method-assign]
    else:
        module._C = extension  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", module)


def test_without_nvcc_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    backend_module(monkeypatch, None)
    rows = torch.zeros(1, 3)
    with pytest.raises(UserError) as caught:
        project(rows, torch.ones(1, 4), rows, torch.ones(1), CAMERA, backend="cuda")
    message = str(caught.value)
    assert "\n" not in message
    for word in (
        "nvcc",
        "ninja",
        "CUDA_HOME",
        "TORCH_CUDA_ARCH_LIST",
        "MAX_JOBS",
        "CUDA_VISIBLE_DEVICES=",
        "minutes",
    ):
        assert word in message


def test_a_failed_build_is_one_line(monkeypatch: pytest.MonkeyPatch):
    backend_module(monkeypatch, RuntimeError("Ninja is required to load C++ extensions\nand much more"))
    with pytest.raises(
        UserError, match=r"could not be built \(Ninja is required to load C\+\+ extensions\): install"
    ):
        load_gsplat()


class Extension:
    """Stands for gsplat's compiled extension: results of the right shapes, for the Python part's own checks."""

    CameraModelType = SimpleNamespace()
    PINHOLE = 0  # gsplat looks a value up beside its enumeration, where pybind11 exports it

    def projection_ewa_3dgs_fused_fwd(self, means: Tensor, covars: None, quats: Tensor, *_: Any) -> Any:
        count = len(means)
        shapes = ((1, count, 2), (1, count), (1, count, 3))
        return (
            torch.full((1, count, 2), 9, dtype=torch.int32),
            *(torch.ones(shape) for shape in shapes),
            None,
        )

    def intersect_tile(self, means2d: Tensor, *_: Any) -> Any:
        return None, torch.zeros(5, dtype=torch.int64), torch.zeros(5, dtype=torch.int32)

    def intersect_offset(self, ids: Tensor, images: int, columns: int, rows: int) -> Tensor:
        assert ids.dtype == torch.int64
        return torch.zeros(images, rows, columns, dtype=torch.int32)

    def rasterize_to_pixels_3dgs_fwd(
        self, means2d: Tensor, conics: Tensor, colors: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        width, height = (value for value in rest if isinstance(value, int) and value > 16)
        shape = (1, height, width)
        alpha = torch.full((*shape, 1), 0.25)
        return torch.full((*shape, colors.shape[-1]), 0.5), alpha, torch.zeros(shape, dtype=torch.int32)

    def spherical_harmonics_fwd(
        self, degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None
    ) -> Tensor:
        return torch.ones_like(dirs)


@pytest.mark.parametrize("background", [None, torch.tensor([1.0, 0.0, 0.5])])
def test_calls_pass_the_checks_of_the_installed_gsplat(
    monkeypatch: pytest.MonkeyPatch, background: Tensor | None
):
    """gsplat's Python functions check shapes; only what they call of the compiled extension is replaced."""
    backend_module(monkeypatch, Extension())
    means = torch.rand(N, 3)
    projection = project(means, torch.rand(N, 4), torch.rand(N, 3), torch.rand(N), CAMERA, backend="cuda")
    assert projection.radii.tolist() == [9] * N
    colors = cuda.sh_to_colors(means, torch.rand(N, 4, 3), CAMERA, 1, projection.visible, clamped=True)
    assert colors.tolist() == [[1.5] * 3] * N
    rendering = blend(projection, colors, background=background)
    assert rendering.colors.shape == (48, 64, 3)
    wanted = torch.full((3,), 0.5) + (0 if background is None else 0.75 * background)
    torch.testing.assert_close(rendering.colors[5, 6], wanted)
    assert float(rendering.depth[0, 0]) == pytest.approx(0.5 / 0.25)
    sample, (rows, _) = blend_sample(projection, colors, tiles=4, every=3)
    assert sample.colors.shape == (len(rows), 3)
    load_gsplat.cache_clear()


def test_no_gaussian_needs_no_kernel(monkeypatch: pytest.MonkeyPatch):
    backend_module(monkeypatch, Extension())
    none = torch.zeros(0, 3)
    projection = project(none, torch.zeros(0, 4), none, torch.zeros(0), CAMERA, backend="cuda")
    rendering = blend(projection, none, background=torch.tensor([0.0, 1.0, 0.0]))
    assert rendering.colors[3, 4].tolist() == [0, 1, 0]
    assert sh_to_colors(none, torch.zeros(0, 1, 3), CAMERA, degree=0).shape == (0, 3)
    load_gsplat.cache_clear()


@pytest.mark.parametrize(
    ("nvcc", "wanted", "words"),
    [
        (None, "13.0", "nvcc is not installed; torch was built with CUDA 13.0"),
        ("12.4", "13.0", "belongs to CUDA 12.4, but torch was built with CUDA 13.0"),
        ("13.1", "13.0", None),
        ("13.0", None, "this build of torch does not support CUDA"),
    ],
)
def test_the_compiler_is_compared_with_torch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, nvcc: str | None, wanted: str | None, words: str | None
):
    found = None
    if nvcc is not None:
        compiler = tmp_path / "bin" / "nvcc"
        compiler.parent.mkdir()
        compiler.write_text(f"#!/bin/sh\necho 'Cuda compilation tools, release {nvcc}, V{nvcc}.99'\n")
        compiler.chmod(0o755)
        monkeypatch.setenv("CUDA_HOME", str(tmp_path))
        found = gsplat_library.find_nvcc()
        assert found == (compiler, nvcc)
    monkeypatch.setattr(gsplat_library, "find_nvcc", lambda: found)
    monkeypatch.setattr(torch.version, "cuda", wanted)
    problem = gsplat_library.toolkit_problem()
    assert problem is None if words is None else words in (problem or "")


def test_a_build_is_found_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    assert not gsplat_library.is_built()
    (tmp_path / "gsplat_cuda").mkdir()
    (tmp_path / "gsplat_cuda" / "gsplat_cuda.so").write_bytes(b"")
    assert gsplat_library.is_built()


def extension_that(monkeypatch: pytest.MonkeyPatch, folder: Path, does: Callable[[], None]) -> None:
    """Stands for gsplat's extension, which does something while it is loaded."""
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(folder))
    module = ModuleType("gsplat.cuda._backend")

    def load(name: str) -> Any:
        does()
        return Extension()

    module.__getattr__ = load  # type: ignore[method-assign]
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", module)


def test_one_process_builds_while_others_wait(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Six trainings that started together built the extension six times side by side."""
    root, locked = tmp_path / "new", []

    def is_locked() -> bool:
        other = filelock.FileLock(root / "wildgs_gsplat_build.lock")
        try:
            with other.acquire(timeout=0):
                return False
        except filelock.Timeout:
            return True

    extension_that(monkeypatch, root, lambda: locked.append(is_locked()))
    gsplat_library.require_extension()
    assert locked == [True]
    assert not is_locked()


def test_a_folder_that_cannot_be_locked_is_no_obstacle(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "file").touch()
    loaded = []
    extension_that(monkeypatch, tmp_path / "file" / "folder", lambda: loaded.append(True))
    gsplat_library.require_extension()
    assert loaded == [True]


@pytest.mark.parametrize(("after", "lines"), [(0.0, 1), (30.0, 0)])
def test_a_long_build_is_announced(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    after: float,
    lines: int,
):
    monkeypatch.setattr(gsplat_library, "ANNOUNCE_AFTER", after)
    extension_that(monkeypatch, tmp_path, lambda: time.sleep(0.3))
    gsplat_library.require_extension()
    assert capsys.readouterr().err.count("building gsplat's CUDA extension") == lines


def test_an_interrupted_build_is_not_deleted(tmp_path: Path):
    build, other = tmp_path / "gsplat_cuda", tmp_path / "other"
    for folder in (build, other):
        folder.mkdir()
    with gsplat_library._interrupted_builds_continue():
        shutil.rmtree(build)
        shutil.rmtree(other)
    assert build.is_dir()
    assert not other.exists()
    shutil.rmtree(build)
    assert not build.exists()
