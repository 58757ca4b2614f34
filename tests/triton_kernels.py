"""Compares Triton kernels with the CPU's, by Triton's interpreter; test_triton runs it in a process of its own."""

from __future__ import annotations

import sys

import torch
from torch import Tensor

from wildgs.losses.ssim import ssim
from wildgs.losses.ssim_triton import TritonSSIM
from wildgs.model.triplane import sample_planes
from wildgs.model.triplane_triton import TritonSample


def leaves(*shapes: tuple[int, ...]) -> list[Tensor]:
    g = torch.Generator().manual_seed(0)
    return [torch.rand(shape, generator=g).requires_grad_() for shape in shapes]


def compare_ssim() -> None:
    for height, width, channels in ((13, 17, 3), (4, 9, 1), (1, 1, 3)):
        pictures = leaves((height, width, channels), (height, width, channels))
        values = [function(*pictures) for function in (ssim, TritonSSIM.apply)]
        torch.testing.assert_close(values[1], values[0], atol=1e-5, rtol=1e-5)
        found, wanted = (torch.autograd.grad(3 * value, pictures) for value in values[::-1])
        for one, other in zip(found, wanted, strict=True):
            torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-3)


def compare_planes() -> None:
    for resolution, channels, count in ((8, 5, 70), (1, 4, 3), (16, 32, 40), (4, 2, 0)):
        planes, points = leaves((3, channels, resolution, resolution), (count, 3))
        points = (2.4 * points - 1.2).detach()  # beyond the border, too
        values = [function(planes, points) for function in (sample_planes, TritonSample.apply)]
        torch.testing.assert_close(values[1], values[0], atol=1e-5, rtol=1e-5)
        weights = torch.linspace(-1, 1, values[0].numel()).reshape(values[0].shape)
        found, wanted = (torch.autograd.grad((value * weights).sum(), planes)[0] for value in values[::-1])
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-4)


if __name__ == "__main__":
    {"ssim": compare_ssim, "planes": compare_planes}[sys.argv[1]]()
