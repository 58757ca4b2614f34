"""File formats of other programs; each file holds the scene under one appearance."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch

from wildgs.errors import UserError
from wildgs.exporters.splats import Splats
from wildgs.files import written_aside
from wildgs.geometry.spherical_harmonics import MAX_DEGREE, num_sh_bases

SplatFormat = Literal["ply", "compressed.ply", "splat", "spz", "sog"]
"""File extensions: 3DGS, PlayCanvas compressed PLY, antimatter15, Niantic SPZ, and PlayCanvas SOG."""

SpzVersion = Literal[3, 4]
"""Versions of .spz: 4 is compressed by Zstandard, 3 by gzip."""
SPZ_VERSION: SpzVersion = 4
"""Version that is written by default."""

_LEAST_OPACITY = 1e-6
"""Opacities are kept this far from 0 and 1, so that their logits are finite in single precision."""

_SPZ_HALF_RANGE = 2**23
"""Coordinates in .spz are signed fixed-point numbers of 24 bits."""


def write_splats(
    file: Path,
    splats: Splats,
    kind: SplatFormat,
    *,
    full_sh: bool = True,
    spz_version: SpzVersion = SPZ_VERSION,
) -> None:
    """Writes Gaussians to a file; missing folders are created.

    `ply` is lossless. The others quantise, and `splat` has harmonics of degree 0 only. Axes are not changed (x
    right, y down, z forward in COLMAP and 3DGS programs), except for `spz`, which specifies x right, y up, z
    backward, and is rotated by 180 degrees about x.

    Args:
        file: The file.
        splats: The Gaussians, in the frame of the file.
        kind: The file format.
        full_sh: For `ply`: pad harmonics to degree 3 with zeros, since many programs read no other layout.
        spz_version: For `spz`: 4 (Zstandard, read by PlayCanvas) or 3 (gzip, read by older programs).

    Raises:
        UserError: The format needs a package that is not installed, or the package fails.
    """
    if kind in ("compressed.ply", "spz"):
        content = _by_gsply(splats, kind, spz_version)
    else:
        content = ply_bytes(splats, full_sh=full_sh) if kind == "ply" else _by_gaussforge(splats, kind)
    with written_aside(file) as aside:
        aside.write_bytes(content)


def ply_bytes(splats: Splats, *, full_sh: bool = False) -> bytes:
    """Content of a .ply file in the layout of the original 3DGS.

    Per Gaussian, as 32-bit floats: x y z, an unused normal, f_dc (degree 0, r g b), f_rest (higher degrees: all of
    red, then green, then blue), opacity (logit), scale (logarithm), rot (unit quaternion w x y z). `full_sh` writes
    all 45 f_rest.
    """
    count = len(splats)
    missing = num_sh_bases(MAX_DEGREE) - splats.sh.shape[1] if full_sh else 0
    rest = torch.nn.functional.pad(splats.sh[:, 1:], (0, 0, 0, missing)).transpose(1, 2).reshape(count, -1)
    columns = {
        "xyz": splats.means,
        "normals": torch.zeros(count, 3),
        "f_dc": splats.sh[:, 0],
        "f_rest": rest,
        "opacity": splats.opacities.clamp(_LEAST_OPACITY, 1 - _LEAST_OPACITY).logit()[:, None],
        "scale": splats.scales.clamp_min(1e-12).log(),
        "rot": torch.nn.functional.normalize(splats.quats, dim=1),
    }
    names = ["x", "y", "z", "nx", "ny", "nz"]
    for prefix in ("f_dc", "f_rest"):
        names += [f"{prefix}_{index}" for index in range(columns[prefix].shape[1])]
    names += ["opacity", *(f"scale_{axis}" for axis in range(3)), *(f"rot_{part}" for part in range(4))]
    table = torch.cat([column.float() for column in columns.values()], dim=1).numpy().astype("<f4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment Wild-GS",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode("ascii") + np.ascontiguousarray(table).tobytes()


def _by_gaussforge(splats: Splats, kind: SplatFormat) -> bytes:
    result = _package("gaussforge", kind).GaussForge().convert(ply_bytes(splats), "ply", kind)
    if "error" in result:
        raise UserError(f"GaussForge could not write .{kind}: {result['error']}; choose --format ply")
    return result["data"]


def _by_gsply(splats: Splats, kind: SplatFormat, spz_version: SpzVersion) -> bytes:
    """Converts through files, because gsply has no other interface for both formats."""
    gsply = _package("gsply", kind)
    spz = kind == "spz"
    placed = splats.rotated(torch.diag(torch.tensor([1.0, -1.0, -1.0]))) if spz else splats
    write: Callable[..., Any] = gsply.write_spz if spz else gsply.plywrite
    options: dict[str, Any] = {"compressed": True}
    if spz:
        options = {"fractional_bits": _spz_bits(placed), "version": spz_version}
        if spz_version == 4:
            _package("zstandard", kind)
    with TemporaryDirectory() as folder:
        plain, target = Path(folder, "plain.ply"), Path(folder, f"target.{kind}")
        plain.write_bytes(ply_bytes(placed))
        write(target, gsply.plyread(plain), **options)
        return target.read_bytes()


def _spz_bits(splats: Splats) -> int:
    """Largest number of fractional bits, of 24, with which no coordinate overflows."""
    reach = max(float(splats.means.abs().max()), 1e-6)
    bits = math.floor(math.log2((_SPZ_HALF_RANGE - 1) / reach))
    if bits < 0:
        raise UserError("coordinates are too large for .spz; add --aligned, --crop 2 or choose --format ply")
    return min(bits, 20)


def _package(name: str, kind: SplatFormat) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            f".{kind} files need {name}; install it with `pip install 'wildgs[export]'`"
        ) from error
