"""The .ply that every 3D Gaussian Splatting program reads: the layout of the original 3DGS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from wildgs.export.splats import Splats
from wildgs.files import written_aside

_LEAST = 1e-6
"""Opacities nearer to 0 or 1 than this have no finite logit in single precision."""


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
        "opacity": splats.opacities.clamp(_LEAST, 1 - _LEAST).logit()[:, None],
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


def write_bytes(file: Path, content: bytes) -> None:
    """Writes a file aside first and then renames it, so that no half file is ever left."""
    with written_aside(file) as aside:
        aside.write_bytes(content)
