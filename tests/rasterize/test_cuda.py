"""What only the gsplat backend has, and what is said where it is missing."""

from __future__ import annotations

import sys

import pytest
import torch

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.rasterize import blend, cuda, project


def test_missing_gsplat_is_a_users_mistake(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(UserError, match=r"pip install 'wildgs\[cuda\]'"):
        cuda.selective_adam([])


@pytest.mark.cuda
def test_packed_mode_gives_the_same():
    g = torch.Generator().manual_seed(0)
    means = torch.randn(500, 3, generator=g) + torch.tensor([0.0, 0, 3])
    quats, scales = torch.randn(500, 4, generator=g), torch.rand(500, 3, generator=g) * 0.2
    inputs = [t.cuda().requires_grad_() for t in (means, quats, scales, torch.rand(500, generator=g))]
    camera = Camera(torch.eye(4), torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48).to("cuda")
    colors = torch.rand(500, 3, generator=g).cuda()
    results = []
    for packed in (False, True):
        projection = project(*inputs, camera, packed=packed, absgrad=True)
        rendering = blend(projection, colors)
        grads = torch.autograd.grad(rendering.colors.sum() + rendering.depth.sum(), inputs)
        results.append([rendering.colors, rendering.depth, rendering.alpha, projection.absgrad, *grads])
    for one, other in zip(*results, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.cuda
def test_selective_adam_leaves_the_unseen_alone():
    parameter = torch.nn.Parameter(torch.ones(4, 3, device="cuda"))
    optimizer = cuda.selective_adam([{"params": [parameter], "lr": 0.1}])
    parameter.sum().backward()
    optimizer.step(torch.tensor([True, False, True, False], device="cuda"))
    assert torch.allclose(parameter[1::2], torch.ones(2, 3, device="cuda"))
    assert (parameter[::2] < 1).all()
