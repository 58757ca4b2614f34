"""Unit quaternions (w, x, y, z) and rotation matrices."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def quats_to_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions, which need not be normalised.

    Args:
        quats: Quaternions (w, x, y, z), as in gsplat and COLMAP.
    """
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def rotations_to_quats(rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices; the inverse of `quats_to_rotations`.

    Of the four equivalent formulas, the one that divides by the largest component is used, for precision.
    """
    m = rotations
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    yz, zx, xy = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    syz, szx, sxy = m[:, 2, 1] + m[:, 1, 2], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 0] + m[:, 0, 1]
    # Row k is 4 q_k (q_w, q_x, q_y, q_z).
    products = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, yz, zx, xy], dim=1),
            torch.stack([yz, 1 + xx - yy - zz, sxy, szx], dim=1),
            torch.stack([zx, sxy, 1 - xx + yy - zz, syz], dim=1),
            torch.stack([xy, szx, syz, 1 - xx - yy + zz], dim=1),
        ],
        dim=1,
    )
    largest = products.diagonal(dim1=1, dim2=2).argmax(dim=1)
    quats = torch.nn.functional.normalize(products[torch.arange(len(m)), largest], dim=1)
    return torch.where(quats[:, :1] < 0, -quats, quats)
