"""A weight gradient that is summed in parts is the one that is not."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from wildgs.model.fusion_layers import PARTS, SplitLinear


@pytest.mark.parametrize("count", [3, PARTS, 2 * PARTS + 5])
@pytest.mark.parametrize("learns_rows", [True, False])
def test_value_and_gradients_are_those_of_a_linear_layer(count: int, learns_rows: bool):
    generator = torch.Generator().manual_seed(0)
    shapes = ((count, 4), (6, 4), (6,))
    leaves = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    for leaf in leaves[0 if learns_rows else 1 :]:
        leaf.requires_grad_()
    learnt = [leaf for leaf in leaves if leaf.requires_grad]
    weights = torch.randn(count, 6, generator=generator, dtype=torch.float64)
    results = []
    for function in (functional.linear, SplitLinear.apply):
        value = function(*leaves)
        results.append((value.detach(), *torch.autograd.grad((value * weights).sum(), learnt)))
    for found, wanted in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted, atol=1e-4, rtol=1e-4)
