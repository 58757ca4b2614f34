"""Parts of the model that take another way on CUDA give there what they give on the CPU."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from wildgs.model.encoder import FrozenBatchNorm
from wildgs.model.gaussians import rows_to_shade, take_rows
from wildgs.model.parsing import Parsing, ParsingConfig
from wildgs.model.triplane import project_cloud, sample_planes

pytestmark = [pytest.mark.cuda, pytest.mark.filterwarnings("ignore:no ImageNet weights")]


def assert_same_on_both(function: Callable[..., Tensor], *inputs: Tensor, tolerance: float = 1e-5) -> None:
    """Compares values, and gradients of all inputs that are to have one."""
    results = {}
    for device in ("cpu", "cuda"):
        leaves = [value.detach().to(device).requires_grad_(value.requires_grad) for value in inputs]
        output = function(*leaves)
        learnt = [leaf for leaf in leaves if leaf.requires_grad]
        weights = torch.linspace(-1, 1, output.numel(), device=device).reshape(output.shape)
        gradients = torch.autograd.grad((output * weights).sum(), learnt) if learnt else ()
        results[device] = [value.detach().cpu() for value in (output, *gradients)]
    for found, wanted in zip(results["cuda"], results["cpu"], strict=True):
        torch.testing.assert_close(found, wanted, atol=tolerance, rtol=tolerance)


def test_sampling_of_planes():
    planes = torch.randn(3, 8, 16, 16, generator=torch.Generator().manual_seed(0), requires_grad=True)
    points = 2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 1
    assert_same_on_both(sample_planes, planes, points, tolerance=1e-4)


def test_pictures_of_a_cloud():
    points = 1.2 * (2 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 1)
    colors = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1))
    keep = torch.rand(3000, generator=torch.Generator().manual_seed(2)) > 0.3
    assert_same_on_both(
        lambda *cloud: project_cloud(*cloud[:2], 16, cloud[2]), points, colors, keep, tolerance=0
    )


def test_no_point_and_no_kept_point():
    for keep in (torch.zeros(0, dtype=torch.bool), torch.zeros(5, dtype=torch.bool)):
        cloud = torch.zeros(len(keep), 3, device="cuda")
        assert not project_cloud(cloud, cloud + 1, 8, keep.cuda()).any()


def test_rows():
    values = torch.randn(40, 5, requires_grad=True)
    visible = torch.arange(40) % 3 == 0
    assert_same_on_both(lambda values, visible: take_rows(values, visible.nonzero()[:, 0]), values, visible)
    assert torch.equal(rows_to_shade(visible.cuda()).cpu(), visible.nonzero()[:, 0])


def test_frozen_normalisation():
    norm = torch.nn.BatchNorm2d(6)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    norm.running_mean.uniform_(-1, 1)
    norm.running_var.uniform_(0.5, 2)
    frozen = FrozenBatchNorm(norm)
    frozen.weight.data.uniform_(0.5, 2)
    frozen.bias.data.uniform_(-1, 1)
    x = torch.randn(2, 6, 5, 7, requires_grad=True)
    assert_same_on_both(lambda x: frozen.to(x.device)(x), x, tolerance=1e-4)


def test_parsing():
    torch.manual_seed(0)
    parsing = Parsing(ParsingConfig(encoder="nobody/none", max_side=64))
    photo = torch.rand(48, 80, 3)
    for output in (0, 1):
        assert_same_on_both(lambda photo: parsing.to(photo.device)(photo)[output], photo, tolerance=5e-3)  # noqa: B023
