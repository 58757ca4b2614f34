"""Spherical harmonics of fewer degrees."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.spherical_harmonics import num_sh_bases, sh_basis

_PRIOR = 5e-4
"""Weight of the plain cut against the cameras' directions: decides where no camera looks."""


def cut_sh(
    sh: Float[Tensor, "N K 3"], degree: int, fit: Float[Tensor, "N L M"] | None = None
) -> Float[Tensor, "N L 3"]:
    """Colours with fewer coefficients.

    Args:
        sh: Coefficients.
        degree: Of the result; the coefficients come back as they are where theirs is not higher.
        fit: From `fit_cut` for these degrees: keeps the colours close to the old ones from where they are looked
            at; None cuts plainly, which is best on average over all directions.

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


def fit_cut(
    means: Float[Tensor, "N 3"],
    viewpoints: Float[Tensor, "V 3"],
    full_degree: int,
    degree: int,
    *,
    chunk: int = 4096,
) -> Float[Tensor, "N L M"]:
    """What the lower degrees must take over when the higher ones are cut off, per Gaussian.

    Photographers stand on one side of a landmark, and seen from there the higher degrees are mostly a constant
    and a slope, which are missing after a plain cut. Least squares over the directions from the viewpoints moves
    them into the coefficients that stay; where the directions do not decide, the plain cut does.

    Args:
        means: Centres of the Gaussians.
        viewpoints: Camera centres in the same frame, at least one.
        full_degree: Of the coefficients to be cut.
        degree: Of those that stay, lower.
        chunk: Gaussians that are solved at once.

    Returns:
        L x M matrices that take a channel's cut coefficients to what is added to those that stay.
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
