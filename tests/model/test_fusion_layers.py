"""Layers in parts and in chunks compute what plain layers compute."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from wildgs.model import fusion_layers
from wildgs.model.fusion_layers import PARTS, ChunkedLayers, SplitLinear, layers_over_rows


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


def plain_layers(rows, first, first_bias, second, second_bias, last, last_bias, direct=None):
    hidden = functional.linear(rows, first, first_bias).relu()
    output = functional.linear(functional.linear(hidden, second, second_bias).relu(), last, last_bias)
    return output if direct is None else output + rows @ direct.T


def layer_inputs(count: int, inputs: int, hidden: int, outputs: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = [(count, inputs), (hidden, inputs), (hidden,), (hidden, hidden), (hidden,)]
    shapes += [(outputs, hidden), (outputs,), (outputs, inputs)]
    return [0.5 * torch.randn(shape, generator=generator) for shape in shapes]


def value_and_gradients(function, leaves: list[torch.Tensor]) -> list[torch.Tensor]:
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    value = function(*leaves)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1))
    return [value.detach(), *torch.autograd.grad((value * weights).sum(), leaves)]


@pytest.mark.parametrize("count", [1, 8, 21])
@pytest.mark.parametrize("skips", [True, False])
def test_chunks_have_the_value_and_gradients_of_plain_layers(
    monkeypatch: pytest.MonkeyPatch, count: int, skips: bool
):
    monkeypatch.setattr(fusion_layers, "CHUNK", 8)
    leaves = layer_inputs(count, 5, 6, 4)[: 8 if skips else 7]

    def chunked(*given):
        return ChunkedLayers.apply(*given, *([] if skips else [None]), torch.float32)

    results = [value_and_gradients(function, leaves) for function in (plain_layers, chunked)]
    for found, wanted in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("avx512", "kind"), [(True, "FusedLayersBackward"), (False, "ChunkedLayersBackward")]
)
def test_processors_without_avx512_use_the_library(monkeypatch: pytest.MonkeyPatch, avx512: bool, kind: str):
    monkeypatch.setattr(fusion_layers, "has_avx512", lambda: avx512)
    leaves = [leaf.requires_grad_() for leaf in layer_inputs(20, 5, 6, 4)]
    value = layers_over_rows(*leaves, precision=torch.float32)
    assert type(value.grad_fn).__name__ == kind
    torch.testing.assert_close(value, plain_layers(*leaves), atol=1e-5, rtol=1e-5)


def test_the_skip_connection_is_not_rounded():
    """In bfloat16, base colours would have steps of 1/256."""
    rows, direct = torch.linspace(0, 1, 5000)[:, None], torch.ones(1, 1)
    zeros = [torch.zeros(shape) for shape in ((4, 1), (4,), (4, 4), (4,), (1, 4), (1,))]
    assert torch.equal(ChunkedLayers.apply(rows, *zeros, direct, torch.bfloat16), rows)
