"""Files that other programs read, each holding the scene under one light."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from wildgs.errors import UserError
from wildgs.export.ply import ply_bytes, write_bytes
from wildgs.export.splats import Splats

SplatFormat = Literal["ply", "compressed.ply", "splat", "spz", "sog"]
"""By their endings: 3DGS's own, PlayCanvas's compressed one, antimatter15's, Niantic's, and PlayCanvas's SOG."""


def write_splats(file: Path, splats: Splats, kind: SplatFormat) -> None:
    """Writes Gaussians in a format.

    `ply` loses nothing. The others quantise, and `splat` drops all harmonics but degree 0; GaussForge writes
    them from the `ply`, coordinates as they are.

    Args:
        file: Where to; its folder is made where it is missing.
        splats: In the frame in which they shall be read.
        kind: The format.

    Raises:
        UserError: The format needs a package that is not installed, or the package refuses.
    """
    content = ply_bytes(splats)
    write_bytes(file, content if kind == "ply" else _convert(content, kind))


def _convert(ply: bytes, kind: SplatFormat) -> bytes:
    try:
        import gaussforge
    except ImportError as error:
        raise UserError(
            f".{kind} files are written by GaussForge; get it with `pip install gaussforge`"
        ) from error
    result = gaussforge.GaussForge().convert(ply, "ply", kind)
    if "error" in result:
        raise UserError(f"GaussForge could not write .{kind}: {result['error']}; choose --format ply")
    return result["data"]
