"""The CPU kernels compute what torch's operations compute, for images of any size and any number of threads."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.engine.warps.registration import fine_detail, mean_products, products, without_means
from wildgs.priors.resampling import pooled
from wildgs.scene.images import LUMA
from wildgs.threads import kernels_limited

SEEDS = st.integers(0, 2**16)


@given(height=st.integers(3, 50), width=st.integers(3, 50), seed=SEEDS)
@settings(max_examples=30, deadline=None)
def test_fine_detail_is_brightness_without_coarse_means(height: int, width: int, seed: int) -> None:
    torch.manual_seed(seed)
    images = [torch.rand(height, width, 3) for _ in range(2)]
    grey = torch.stack([image @ torch.tensor(LUMA) for image in images])
    expected = without_means(grey, -(-height // 4), -(-width // 4))
    torch.testing.assert_close(fine_detail(*images), expected, atol=1e-5, rtol=0)


@given(height=st.integers(3, 50), width=st.integers(3, 50), cells=st.integers(1, 60), seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_means_of_products_are_those_of_torch(height: int, width: int, cells: int, seed: int) -> None:
    torch.manual_seed(seed)
    seen, shown = torch.randn(height, width), torch.randn(height, width)
    expected = pooled(products(seen, shown), cells, cells)
    torch.testing.assert_close(mean_products(seen, shown, cells), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("threads", [2, 3])
def test_results_do_not_depend_on_the_number_of_threads(threads: int) -> None:
    torch.manual_seed(0)
    photo, render = torch.rand(101, 143, 3), torch.rand(101, 143, 3)

    def results(count: int) -> list[torch.Tensor]:
        with kernels_limited(count):
            seen, shown = fine_detail(photo, render)
            return [seen, shown, mean_products(seen, shown, 9)]

    for one, several in zip(results(1), results(threads), strict=True):
        assert torch.equal(one, several)
