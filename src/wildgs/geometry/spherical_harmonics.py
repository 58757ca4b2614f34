"""Real spherical harmonics up to degree 3, with the order and signs of 3D Gaussian Splatting's files."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def num_sh_bases(degree: int) -> int:
    """How many coefficients a colour channel has at a degree.

    Raises:
        ValueError: The degree is not 0, 1, 2 or 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree} are not supported, only 0 to {MAX_DEGREE}")
    return (degree + 1) ** 2


def sh_basis(degree: int, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch K"]:
    """The basis functions' values.

    Args:
        degree: 0 to 3.
        directions: Unit vectors from the camera's centre to the Gaussians, world axes.

    Returns:
        (degree + 1)^2 values per direction; a channel's colour is their product with its coefficients.

    Raises:
        ValueError: The degree is out of range.
    """
    num_sh_bases(degree)
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
        if degree >= 3:
            values += [
                -C3[0] * y * (3 * xx - yy),
                C3[1] * x * y * z,
                -C3[2] * y * (4 * zz - xx - yy),
                C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                -C3[2] * x * (4 * zz - xx - yy),
                C3[4] * z * (xx - yy),
                -C3[0] * x * (xx - 3 * yy),
            ]
    return torch.stack(values, dim=-1)


def rgb_to_sh0(rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The degree 0 coefficients of a colour in [0, 1] that looks the same from everywhere."""
    return (rgb - 0.5) / C0


def sh0_to_rgb(sh0: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The colour of degree 0 coefficients, not clamped; undoes `rgb_to_sh0`."""
    return sh0 * C0 + 0.5
