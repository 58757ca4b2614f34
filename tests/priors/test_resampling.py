"""Photos are displaced as torch would, for images of any size and any number of threads."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from wildgs.priors.resampling import interpolated, pooled, sampled, warp
from wildgs.threads import kernels_limited

SIDES = st.integers(1, 50)


@given(
    height=SIDES, width=SIDES, cells=st.integers(1, 9), reach=st.floats(0, 0.6), seed=st.integers(0, 2**16)
)
@settings(max_examples=60, deadline=None)
def test_warped_photos_are_those_of_torch(
    height: int, width: int, cells: int, reach: float, seed: int
) -> None:
    """Displacements of up to more than half of the photo lead far beyond its border."""
    torch.manual_seed(seed)
    photo, grid = torch.rand(height, width, 3), reach * (2 * torch.rand(2, cells, cells) - 1)
    by_torch = sampled(photo, max(height, width) * interpolated(grid, height, width))
    torch.testing.assert_close(warp(photo, grid), by_torch, atol=1e-4, rtol=0)


def test_bicubic_interpolation_overshoots_no_further_than_a_photo_can() -> None:
    photo = (torch.rand(20, 20, 3) > 0.5).float()
    warped = warp(photo, torch.full((2, 1, 1), 0.02))
    assert warped.min() == 0
    assert warped.max() == 1


def test_means_of_cells_are_those_of_adaptive_pooling() -> None:
    maps = torch.rand(3, 24, 36)
    torch.testing.assert_close(pooled(maps, 6, 4), functional.adaptive_avg_pool2d(maps, (6, 4)))


def test_interpolation_is_torchs_bilinear_one() -> None:
    maps = torch.rand(3, 5, 7)
    expected = functional.interpolate(maps[None], size=(41, 30), mode="bilinear")[0]
    torch.testing.assert_close(interpolated(maps, 41, 30), expected, atol=1e-6, rtol=0)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    photo, grid = torch.rand(101, 143, 3), 0.01 * torch.randn(2, 9, 9)
    results = []
    for count in (1, 2, 3):
        with kernels_limited(count):
            results.append(warp(photo, grid))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])
