"""Real spherical harmonics up to degree 3, with the order and signs of 3D Gaussian Splatting's files.

The basis, and coefficients that are rotated with the world or truncated to a lower degree.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

MAX_DEGREE = 3
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)

_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
_PRIOR = 5e-4
"""Weight of plain truncation against the viewing directions: decides where no camera looks."""


def num_sh_bases(degree: int) -> int:
    """Number of coefficients of a colour channel at a degree.

    Raises:
        ValueError: The degree is not 0, 1, 2 or 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree} are not supported, only 0 to {MAX_DEGREE}")
    return (degree + 1) ** 2


def sh_basis(degree: int, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch K"]:
    """Values of the basis functions.

    Args:
        degree: 0 to 3.
        directions: Unit vectors from the camera's centre to the Gaussians, world axes.

    Returns:
        (degree + 1)^2 values per direction. The colour of a channel is their dot product with its coefficients.

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


def sh_values(sh: Float[Tensor, "N K C"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
    """Evaluates harmonics in one direction each, without the offset and clamp of `wildgs.rasterize.sh_to_colors`.

    Args:
        sh: Coefficients of any number of channels; the number per channel determines the degree.
        directions: Directions from the camera's centre to the Gaussians; they need not be normalised.
    """
    bases = sh_basis(sh_degree(sh), functional.normalize(directions, dim=-1))
    return torch.einsum("nk, nkc -> nc", bases, sh)


def rgb_to_sh0(rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Coefficients of degree 0 for a view-independent colour in [0, 1]."""
    return (rgb - 0.5) / C0


def sh_degree(sh: Float[Tensor, "N K C"]) -> int:
    """Degree of spherical harmonics coefficients.

    Raises:
        ValueError: Their number is not 1, 4, 9 or 16.
    """
    if sh.shape[1] not in _DEGREES:
        raise ValueError(f"sh has {sh.shape[1]} coefficients per channel, not 1, 4, 9 or 16")
    return _DEGREES[sh.shape[1]]


def rotate_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Rotates coefficients with the world.

    The rotated coefficients have in direction ``rotation @ d`` the values of the given ones in ``d``. Each degree
    is closed under rotation, so least squares over enough directions gives its matrix exactly.

    Args:
        sh: Coefficients in the order of 3D Gaussian Splatting.
        rotation: From the old to the new axes.

    Raises:
        ValueError: The number of coefficients is not 1, 4, 9 or 16.
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


def truncate_sh(
    sh: Float[Tensor, "N K 3"], degree: int, fit: Float[Tensor, "N L M"] | None = None
) -> Float[Tensor, "N L 3"]:
    """Truncates coefficients to a degree; coefficients of this degree or lower are returned unchanged.

    A `fit` of `fit_truncation` for the same degrees preserves the colours in the directions of the cameras.
    Without it the higher degrees are dropped, which is best on average over all directions.

    Raises:
        ValueError: The degree is out of range, or the fit is for other degrees.
    """
    bases = num_sh_bases(degree)
    kept, rest = sh[:, :bases], sh[:, bases:]
    if not rest.shape[1] or fit is None:
        return kept
    if fit.shape != (len(sh), bases, rest.shape[1]):
        raise ValueError(f"the fit has shape {list(fit.shape)}, not {[len(sh), bases, rest.shape[1]]}")
    return kept + fit @ rest


def fit_truncation(
    means: Float[Tensor, "N 3"],
    viewpoints: Float[Tensor, "V 3"],
    full_degree: int,
    degree: int,
    *,
    chunk: int = 4096,
) -> Float[Tensor, "N L M"]:
    """Least-squares correction of the remaining degrees when higher ones are dropped, per Gaussian.

    Photos of a landmark are taken from one side of it. Over these directions, the higher degrees contribute mostly
    a constant and a slope, which plain truncation loses. Least squares over the directions from the cameras moves
    them to the remaining coefficients, with a weak prior towards plain truncation.

    Args:
        means: Centres of the Gaussians.
        viewpoints: Camera centres in the same frame, at least one.
        full_degree: Degree of the coefficients that are truncated.
        degree: Degree that remains, lower than `full_degree`.
        chunk: Number of Gaussians that are solved at once.

    Returns:
        L x M matrices from a channel's dropped coefficients to the correction of its remaining ones.
    """
    bases = num_sh_bases(degree)
    prior = _PRIOR * len(viewpoints) * torch.eye(bases).to(means)
    parts = []
    for part in means.split(chunk):
        directions = torch.nn.functional.normalize(part[:, None] - viewpoints.to(means), dim=-1)
        basis = sh_basis(full_degree, directions)
        gram = basis.transpose(1, 2) @ basis
        parts.append(torch.linalg.solve(gram[:, :bases, :bases] + prior, gram[:, :bases, bases:]))
    return torch.cat(parts) if parts else means.new_zeros(0, bases, num_sh_bases(full_degree) - bases)
