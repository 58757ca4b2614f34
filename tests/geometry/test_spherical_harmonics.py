"""The basis is the one of 3DGS files; the fused CPU kernel agrees with it."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from wildgs.geometry.spherical_harmonics import num_sh_bases, rgb_to_sh0, sh0_to_rgb, sh_basis


def test_basis_is_orthonormal_on_the_sphere():
    g = torch.Generator().manual_seed(0)
    directions = normalize(torch.randn(400_000, 3, generator=g, dtype=torch.float64), dim=-1)
    values = sh_basis(3, directions)
    gram = 4 * torch.pi * values.T @ values / len(values)
    assert (gram - torch.eye(16)).abs().max() < 0.02


def test_degree_1_follows_minus_y_z_minus_x():
    axes = torch.eye(3)
    assert torch.allclose(
        sh_basis(1, axes)[:, 1:], 0.4886025 * torch.tensor([[0, 0, -1], [-1, 0, 0], [0, 1.0, 0]])
    )


def test_lower_degrees_are_prefixes():
    directions = normalize(torch.randn(5, 3), dim=-1)
    full = sh_basis(3, directions)
    for degree in range(3):
        assert torch.equal(sh_basis(degree, directions), full[:, : num_sh_bases(degree)])


def test_flat_colour_round_trip():
    rgb = torch.rand(4, 3)
    assert torch.allclose(sh0_to_rgb(rgb_to_sh0(rgb)), rgb, atol=1e-6)
    assert torch.allclose(rgb_to_sh0(rgb) * sh_basis(0, torch.eye(3)[:1]) + 0.5, rgb, atol=1e-6)


def test_degree_out_of_range():
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis(4, torch.eye(3))
