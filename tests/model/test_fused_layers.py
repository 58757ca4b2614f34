"""Kernels of the fusion network compute what plain layers compute, for all rows or for regions of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from wildgs.model.fused_layers import fused_layers
from wildgs.model.fusion_kernels import PART
from wildgs.threads import kernels_limited


def plain_layers(
    rows: Tensor, regions: Sequence[tuple[Tensor | None, Sequence[Tensor | None]]]
) -> tuple[Tensor, Tensor]:
    outputs, found = [], []
    for index, (first, first_bias, second, second_bias, last, last_bias, direct, codes) in regions:
        taken = rows if index is None else rows[index]
        hidden = functional.linear(taken, first, first_bias).relu()
        output = functional.linear(functional.linear(hidden, second, second_bias).relu(), last, last_bias)
        outputs.append(output if direct is None else output + taken @ direct.T)
        if codes is not None:
            found.append(taken @ codes.T)
    return torch.cat(outputs), torch.cat(found) if found else rows.new_empty(0, 0)


def weights(inputs: int, hidden: int, outputs: int, codes: int = 0, *, skips: bool = True, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    shapes = [(hidden, inputs), (hidden,), (hidden, hidden), (hidden,), (outputs, hidden), (outputs,)]
    shapes += [(outputs, inputs), (codes, inputs)]
    found: list[Tensor | None] = [0.5 * torch.randn(shape, generator=generator) for shape in shapes]
    return [*found[:6], found[6] if skips else None, found[7] if codes else None]


def rows_of(count: int, width: int) -> Tensor:
    return 0.5 * torch.randn(count, width, generator=torch.Generator().manual_seed(9))


def values_and_gradients(
    function: Callable[..., tuple[Tensor, Tensor]], rows: Tensor, regions
) -> list[Tensor]:
    rows = rows.clone().requires_grad_()
    regions = [
        (index, [None if w is None else w.clone().requires_grad_() for w in each]) for index, each in regions
    ]
    values = function(rows, regions)
    generator = torch.Generator().manual_seed(1)
    total = sum((value * torch.randn(value.shape, generator=generator)).sum() for value in values)
    leaves = [rows, *(w for _, each in regions for w in each if w is not None)]
    return [*(value.detach() for value in values), *torch.autograd.grad(total, leaves)]


def assert_alike(rows: Tensor, regions) -> None:
    results = [values_and_gradients(function, rows, regions) for function in (fused_layers, plain_layers)]
    for found, wanted in zip(*results, strict=True):
        scale = wanted.abs().max().clamp_min(1e-6) if wanted.numel() else 1.0
        torch.testing.assert_close(found / scale, wanted / scale, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [0, 1, 2 * PART + 100])
@pytest.mark.parametrize("sizes", [(32, 32, 12), (32, 48, 12), (5, 20, 3), (33, 64, 48), (16, 16, 27)])
@pytest.mark.parametrize("skips", [True, False])
def test_values_and_gradients_of_all_rows(count: int, sizes: tuple[int, int, int], skips: bool):
    assert_alike(rows_of(count, sizes[0]), [(None, weights(*sizes, skips=skips))])


@settings(max_examples=20, deadline=None)
@given(
    counts=st.tuples(st.integers(0, 60), st.integers(0, 250), st.integers(0, 40)),
    codes=st.integers(0, 20),
    width=st.sampled_from([5, 16, 32, 37]),
)
def test_values_and_gradients_of_regions(counts: tuple[int, int, int], codes: int, width: int):
    """Rows of no region get a gradient of zero."""
    shuffled = torch.randperm(sum(counts), generator=torch.Generator().manual_seed(2))
    first, second, _ = (part.sort().values for part in shuffled.split(list(counts)))
    regions = [
        (first, weights(width, 20, 12, codes)),
        (second, weights(width, 20, 12, skips=False, seed=3)),
    ]
    assert_alike(rows_of(sum(counts), width), regions)


def test_results_do_not_depend_on_the_number_of_threads():
    rows, regions = rows_of(3 * PART + 7, 32), [(None, weights(32, 48, 12, 8))]
    results = []
    for threads in (1, 3):
        with kernels_limited(threads):
            results.append(values_and_gradients(fused_layers, rows, regions))
    assert all(torch.equal(one, three) for one, three in zip(*results, strict=True))


@pytest.mark.parametrize("place", range(9))
def test_what_is_not_finite_is_not_hidden(place: int):
    """Steps with non-finite values are skipped, which needs them to arrive at the loss."""
    leaves = [rows_of(4, 32), *weights(32, 48, 12, 8)]
    leaves[place].view(-1)[0] = torch.nan
    values = fused_layers(leaves[0], [(torch.arange(4), leaves[1:])])
    assert any(bool(value.isnan().any()) for value in values)
