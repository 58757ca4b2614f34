"""Colours turn with the world, and fewer coefficients keep what the cameras saw."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from wildgs.geometry.rotation import quats_to_rotations, rotations_to_quats
from wildgs.geometry.sh_cut import cut_sh, fit_cut
from wildgs.geometry.sh_rotation import rotate_sh, sh_degree
from wildgs.geometry.spherical_harmonics import num_sh_bases, sh_basis


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


def test_quaternions_of_rotations_come_back_even_where_w_is_zero() -> None:
    quats = torch.randn(200, 4, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    half_turns = torch.tensor([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0]], dtype=torch.float64)
    rotations = quats_to_rotations(torch.cat([quats, half_turns]))
    found = rotations_to_quats(rotations)
    assert (found[:, 0] >= 0).all()
    torch.testing.assert_close(quats_to_rotations(found), rotations)


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

    fit = fit_cut(means, viewpoints, 3, 1, chunk=16)
    assert error(cut_sh(sh, 1, fit)) < 0.25 * error(cut_sh(sh, 1))


def test_nothing_is_cut_from_harmonics_of_a_lower_degree() -> None:
    sh = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(6))
    assert torch.equal(cut_sh(sh, 2), sh)
    with pytest.raises(ValueError, match="the fit has shape"):
        cut_sh(sh, 0, torch.zeros(3, 1, 15))
