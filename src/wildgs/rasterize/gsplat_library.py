"""Loads gsplat for the CUDA backend, with instructions in errors if it is missing or incompatible."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import inspect
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import filelock
import torch

from wildgs.errors import UserError

ANNOUNCE_AFTER = 10.0
"""Seconds after which a line says that the extension is being built; loading it takes a few."""
REQUIREMENT = "gsplat>=1.5.3,<1.6"
_FIRST, _BEFORE = (1, 5, 3), (1, 6)
_CALLS = {
    "fully_fused_projection": (
        ("means", "covars", "quats", "scales", "viewmats", "Ks", "width", "height"),
        ("eps2d", "near_plane", "packed", "opacities", "calc_compensations"),
    ),
    "isect_tiles": (
        ("means2d", "radii", "depths", "tile_size", "tile_width", "tile_height"),
        ("packed", "n_images"),
    ),
    "isect_offset_encode": (("isect_ids", "n_images", "tile_width", "tile_height"), ()),
    "rasterize_to_pixels": (
        ("means2d", "conics", "colors", "opacities", "image_width", "image_height", "tile_size")
        + ("isect_offsets", "flatten_ids"),
        ("masks", "packed", "absgrad"),
    ),
    "spherical_harmonics": (("degrees_to_use", "dirs", "coeffs"), ("masks",)),
}
"""Functions of gsplat that the backend calls: their leading positional parameters, and keywords."""


@cache
def load_gsplat() -> Any:
    """Returns the module gsplat with its CUDA extension built and loaded.

    The first call on a machine builds the extension, which takes minutes (docs/nvidia.md).

    Raises:
        UserError: gsplat is missing, has another version, or its CUDA extension cannot be built.
    """
    module = import_gsplat()
    require_extension()
    return module


def import_gsplat() -> ModuleType:
    """Imports the Python part of gsplat, which needs neither a GPU nor nvcc.

    Raises:
        UserError: gsplat is missing, or its version or signatures are incompatible with the backend.
    """
    try:
        import gsplat
    except ImportError as error:
        raise UserError(
            f"the CUDA rasteriser needs gsplat: pip install '{REQUIREMENT}', or set CUDA_VISIBLE_DEVICES= to run "
            "on the CPU"
        ) from error
    check_interface(gsplat, _installed_version())
    return gsplat


def _installed_version() -> str | None:
    try:
        return importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        return None  # gsplat from a source tree on the path; its signatures are checked nevertheless


def check_interface(module: Any, version: str | None) -> None:
    """Compares gsplat's version and signatures with those that the CUDA backend calls.

    Args:
        module: gsplat.
        version: The installed version; None if unknown.

    Raises:
        UserError: They are incompatible.
    """
    numbers = tuple(int(part) for part in re.findall(r"\d+", version or "")[:3])
    supported = not numbers or _FIRST <= numbers < _BEFORE
    changed = [name for name in _CALLS if not _fits(getattr(module, name, None), *_CALLS[name])]
    if supported and not changed:
        return
    reason = f"the signature of {changed[0]} differs" if changed else "it is not supported"
    raise UserError(
        f"gsplat {version or '(unknown version)'} does not work with wildgs ({reason}): pip install '{REQUIREMENT}'"
    )


def _fits(function: Any, positional: tuple[str, ...], keywords: tuple[str, ...]) -> bool:
    if function is None:
        return False
    names = list(inspect.signature(function).parameters)
    return tuple(names[: len(positional)]) == positional and set(keywords) <= set(names)


def require_extension() -> None:
    """Loads gsplat's CUDA extension; builds it if necessary.

    Raises:
        UserError: nvcc is missing, or the build failed.
    """
    try:
        with _one_builder(), _announced_build(), _interrupted_builds_continue():
            extension = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # torch's build raises many kinds of errors
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(f"gsplat's CUDA extension could not be built ({reason}): {build_help()}") from error
    if extension is None:
        raise UserError(
            f"gsplat could not build its CUDA extension, because it found no nvcc: {build_help()}"
        )


@contextmanager
def _one_builder() -> Iterator[None]:
    """Makes processes that start together wait for the one that builds.

    gsplat removes torch's lock of the build folder when it starts, so that each of them would build everything. An
    installed extension is loaded without a lock, and so is any on a file system without locks.
    """
    if importlib.util.find_spec("gsplat.csrc") is not None:
        yield
        return
    root = build_root()
    lock = filelock.FileLock(root / "wildgs_gsplat_build.lock")
    try:
        root.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except (OSError, NotImplementedError):
        pass
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _announced_build() -> Iterator[None]:
    """Says why nothing happens while the extension is built; gsplat does not where options have changed."""
    timer = threading.Timer(ANNOUNCE_AFTER, _announce)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _announce() -> None:
    print(
        "wildgs: building gsplat's CUDA extension (2 to 15 minutes; kept on disk for later runs)",
        file=sys.stderr,
        flush=True,
    )


@contextmanager
def _interrupted_builds_continue() -> Iterator[None]:
    """Prevents gsplat from deleting the object files of an interrupted build."""
    remove = shutil.rmtree

    def keep(path: Any, *arguments: Any, **keywords: Any) -> None:
        if Path(path).name != "gsplat_cuda":
            remove(path, *arguments, **keywords)

    shutil.rmtree = keep
    try:
        yield
    finally:
        shutil.rmtree = remove


def build_help() -> str:
    """Requirements of building gsplat's extension, for error messages and `wildgs doctor`."""
    wanted = torch.version.cuda or "the CUDA version of your torch"
    return (
        f"install nvcc {wanted} (the version of your torch), a C++ compiler and ninja, and set CUDA_HOME "
        "to the toolkit if it is not found; the build takes 2 to 15 minutes once (TORCH_CUDA_ARCH_LIST=9.0 is the "
        "GPU's architecture, MAX_JOBS limits parallel compilers); `wildgs doctor --build-gsplat` builds it ahead; "
        "CUDA_VISIBLE_DEVICES= runs on the CPU instead"
    )


def is_built() -> bool:
    """Whether gsplat's CUDA extension is installed, or already built with the installed torch."""
    if importlib.util.find_spec("gsplat.csrc") is not None:
        return True
    root = build_root()
    names = ("gsplat_cuda/gsplat_cuda.*", "*/gsplat_cuda/gsplat_cuda.*")
    built = [path for name in names for path in root.glob(name)]
    return any(path.suffix in (".so", ".pyd") for path in built)


def build_root() -> Path:
    """The folder in which torch builds extensions."""
    from torch.utils.cpp_extension import get_default_build_root

    return Path(os.environ.get("TORCH_EXTENSIONS_DIR") or get_default_build_root())


def toolkit_problem() -> str | None:
    """Why gsplat's CUDA extension cannot be built; None if the compiler is compatible with torch."""
    wanted, found = torch.version.cuda, find_nvcc()
    if wanted is None:
        return "this build of torch does not support CUDA"
    if found is None:
        return f"nvcc is not installed; torch was built with CUDA {wanted}"
    if found[1].split(".")[0] != wanted.split(".")[0]:
        return f"{found[0]} belongs to CUDA {found[1]}, but torch was built with CUDA {wanted}"
    return None


def find_nvcc() -> tuple[Path, str] | None:
    """The CUDA compiler that torch's builds call, and its version ("13.0"); None if there is none."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    candidates = [Path(home) / "bin" / "nvcc"] if home else []
    on_path = shutil.which("nvcc")
    candidates += [Path(on_path)] if on_path else []
    candidates += [Path("/usr/local/cuda/bin/nvcc")]
    for nvcc in candidates:
        try:
            printed = subprocess.run(
                [nvcc, "--version"], capture_output=True, text=True, check=True, timeout=20
            )
        except (OSError, subprocess.SubprocessError):
            continue
        found = re.search(r"release (\d+\.\d+)", printed.stdout)
        if found:
            return nvcc, found[1]
    return None
