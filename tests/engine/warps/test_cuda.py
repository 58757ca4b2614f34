"""Displaced photos on CUDA, which torch samples and registers there, are those of the CPU's kernels."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests.engine.warps.test_photo_warps import CELLS, crop, texture
from wildgs.engine.warps.registration import displacement
from wildgs.priors.resampling import warp

pytestmark = pytest.mark.cuda

SIZES = [(96, 128), (61, 90), (400, 530)]


def smooth_grid(seed: int, side: int) -> Float[Tensor, "2 G G"]:
    """Displacements of up to two pixels."""
    return (4 * torch.rand(2, CELLS, CELLS, generator=torch.Generator().manual_seed(seed)) - 2) / side


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_warped_photo_is_the_same(height: int, width: int):
    photo, grid = crop(texture(0, height, width)), smooth_grid(0, width)
    found = warp(photo.cuda(), grid.cuda()).cpu()
    torch.testing.assert_close(found, warp(photo, grid), atol=2e-4, rtol=0)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_registration_finds_the_same_displacements(height: int, width: int):
    render = crop(texture(1, height, width))
    photo = warp(render, 0.2 * smooth_grid(1, width))
    wanted = displacement(photo, render, CELLS)
    found = displacement(photo.cuda(), render.cuda(), CELLS).cpu()
    assert float(width * wanted.abs().max()) > 0.1
    # In pixels.
    torch.testing.assert_close(width * found, width * wanted, atol=2e-3, rtol=0)
