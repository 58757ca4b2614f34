"""Files that other programs read, each holding the scene under one light."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch

from wildgs.errors import UserError
from wildgs.export.splats import Splats
from wildgs.files import written_aside

SplatFormat = Literal["ply", "compressed.ply", "splat", "spz", "sog"]
"""By their endings: 3DGS's own, PlayCanvas's compressed one, antimatter15's, Niantic's, and PlayCanvas's SOG."""

_LEAST_OPACITY = 1e-6
"""Opacities closer to 0 or 1 have no finite logit in single precision."""

_SPZ_HALF_RANGE = 2**23
"""Coordinates in .spz are fixed-point numbers of 24 bits with a sign."""


def write_splats(file: Path, splats: Splats, kind: SplatFormat) -> None:
    """Writes Gaussians in a format.

    `ply` loses nothing. The others quantise, and `splat` drops all harmonics but degree 0. Axes are those of the
    Gaussians, which COLMAP and 3DGS programs take for x right, y down, z forward; only `spz`, which fixes x right,
    y up, z back, is turned by half a turn about x, so that its readers see the same.

    Args:
        file: Where to; its folder is made where it is missing.
        splats: In the frame in which they shall be read.
        kind: The format.

    Raises:
        UserError: The format needs a package that is not installed, or the package refuses.
    """
    if kind in ("compressed.ply", "spz"):
        content = _by_gsply(splats, kind)
    else:
        content = ply_bytes(splats) if kind == "ply" else _by_gaussforge(splats, kind)
    with written_aside(file) as aside:
        aside.write_bytes(content)


def ply_bytes(splats: Splats) -> bytes:
    """The file's content.

    Per Gaussian, as 32-bit floats: x y z, an unused normal, f_dc (degree 0, r g b), f_rest (the other harmonics,
    all of red, then green, then blue), opacity (logit), scale (logarithm), rot (unit quaternion w x y z).
    """
    count = len(splats)
    rest = splats.sh[:, 1:].transpose(1, 2).reshape(count, -1)
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


def _by_gsply(splats: Splats, kind: SplatFormat) -> bytes:
    """The package takes harmonics coefficient by coefficient, and writes to files only."""
    gsply = _package("gsply", kind)
    spz = kind == "spz"
    placed = splats.turned(torch.diag(torch.tensor([1.0, -1.0, -1.0]))) if spz else splats
    write: Callable[..., Any] = gsply.write_spz if spz else gsply.plywrite
    options: dict[str, Any] = {"fractional_bits": _spz_bits(placed)} if spz else {"compressed": True}
    with TemporaryDirectory() as folder:
        plain, target = Path(folder, "plain.ply"), Path(folder, f"target.{kind}")
        plain.write_bytes(ply_bytes(placed))
        write(target, gsply.plyread(plain), **options)
        return target.read_bytes()


def _spz_bits(splats: Splats) -> int:
    """How many of the 24 bits can stand behind the point without the furthest Gaussian overflowing."""
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
        raise UserError(f".{kind} files need {name}; get it with `pip install 'wildgs[export]'`") from error
