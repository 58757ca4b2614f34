"""Spherical harmonics in a world that was turned."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.spherical_harmonics import sh_basis

_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}


def sh_degree(sh: Float[Tensor, "N K 3"]) -> int:
    """The degree of coefficients.

    Raises:
        ValueError: Their number is not 1, 4, 9 or 16.
    """
    if sh.shape[1] not in _DEGREES:
        raise ValueError(f"sh has {sh.shape[1]} coefficients per channel, not 1, 4, 9 or 16")
    return _DEGREES[sh.shape[1]]


def rotate_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """The same colours after the world has been turned.

    The rotated coefficients give in direction ``rotation @ d`` what the old ones give in ``d``. Each degree is
    closed under rotation, so its matrix follows exactly from enough directions; no tables are needed.

    Args:
        sh: Coefficients in the order of 3D Gaussian Splatting.
        rotation: From the old axes to the new.

    Raises:
        ValueError: The number of coefficients belongs to no degree.
    """
    degree = sh_degree(sh)
    rotation = rotation.to(torch.float64).cpu()
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=1, keepdim=True)
    old, new = sh_basis(degree, directions), sh_basis(degree, directions @ rotation.T)
    matrix = torch.zeros(old.shape[1], old.shape[1], dtype=torch.float64)
    for order in range(degree + 1):
        band = slice(order**2, (order + 1) ** 2)
        matrix[band, band] = torch.linalg.lstsq(new[:, band], old[:, band]).solution
    return torch.einsum("ij,njc->nic", matrix.to(sh), sh)
