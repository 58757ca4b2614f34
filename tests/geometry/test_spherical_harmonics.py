"""The basis is the one of 3DGS files; the fused CPU kernel agrees with it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from wildgs.geometry.camera import quats_to_rotations
from wildgs.geometry.spherical_harmonics import (
    fit_truncation,
    num_sh_bases,
    rotate_sh,
    sh_basis,
    sh_degree,
    truncate_sh,
)


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


def test_degree_out_of_range():
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis(4, torch.eye(3))


def _unit(count: int, seed: int) -> Tensor:
    values = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(values, dim=1)


def _rotation(seed: int) -> Tensor:
    quats = torch.randn(1, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return quats_to_rotations(quats)[0]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_harmonics_give_in_the_turned_direction_what_the_old_ones_gave(degree: int) -> None:
    rotation, directions = _rotation(1), _unit(20, 2)
    sh = torch.randn(5, num_sh_bases(degree), 3, generator=torch.Generator().manual_seed(3)).double()
    before = torch.einsum("dk,nkc->dnc", sh_basis(degree, directions), sh)
    after = torch.einsum("dk,nkc->dnc", sh_basis(degree, directions @ rotation.T), rotate_sh(sh, rotation))
    torch.testing.assert_close(after, before)


def test_a_full_turn_in_three_steps_changes_nothing() -> None:
    third = quats_to_rotations(torch.tensor([[0.5, 0.5, 0.5, 0.5]], dtype=torch.float64))[0]
    sh = torch.randn(4, 16, 3, generator=torch.Generator().manual_seed(0))
    turned = rotate_sh(rotate_sh(rotate_sh(sh, third), third), third)
    torch.testing.assert_close(turned, sh, atol=1e-5, rtol=0)
    assert (rotate_sh(sh, third) - sh).abs().max() > 0.1


def test_coefficients_of_no_degree_are_refused() -> None:
    with pytest.raises(ValueError, match="5 coefficients"):
        sh_degree(torch.zeros(2, 5, 3))


def test_the_fitted_cut_is_close_where_cameras_look_from() -> None:
    generator = torch.Generator().manual_seed(5)
    means = torch.randn(50, 3, generator=generator)
    viewpoints = torch.randn(30, 3, generator=generator) + torch.tensor([0.0, -8.0, 0.0])
    sh = 0.3 * torch.randn(50, 16, 3, generator=generator)
    here = torch.randn(10, 3, generator=generator) + torch.tensor([0.0, -8.0, 0.0])

    def error(reduced: Tensor) -> float:
        directions = torch.nn.functional.normalize(means[:, None] - here, dim=-1)
        whole = torch.einsum("nvk,nkc->nvc", sh_basis(3, directions), sh)
        part = torch.einsum("nvk,nkc->nvc", sh_basis(1, directions), reduced)
        return float((whole - part).square().mean().sqrt())

    fit = fit_truncation(means, viewpoints, 3, 1, chunk=16)
    assert error(truncate_sh(sh, 1, fit)) < 0.25 * error(truncate_sh(sh, 1))


def test_nothing_is_cut_from_harmonics_of_a_lower_degree() -> None:
    sh = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(6))
    assert torch.equal(truncate_sh(sh, 2), sh)
    with pytest.raises(ValueError, match="the fit has shape"):
        truncate_sh(sh, 0, torch.zeros(3, 1, 15))
