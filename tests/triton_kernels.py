"""Compares Triton kernels with the CPU's by Triton's interpreter, and compiles them; test_triton runs it."""

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


SIZES = ("count", "length", "channels", "resolution")


def compile_all() -> None:
    """To machine code, with no GPU: sizes as int32, and once as the constant 1, as which Triton takes a 1."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from wildgs.losses import ssim_triton
    from wildgs.model import triplane_triton

    for module in (ssim_triton, triplane_triton):
        constants = {"BLOCK": ssim_triton.BLOCK, "POINTS": triplane_triton.POINTS, "WIDTH": 32}
        for name, kernel in vars(module).items():
            if not isinstance(kernel, triton.runtime.JITFunction) or not constants.keys() & {
                *kernel.arg_names
            }:
                continue
            given = {arg: constants[arg] for arg in kernel.arg_names if arg in constants}
            for ones in ({}, {arg: 1 for arg in ("resolution", "channels") if arg in kernel.arg_names}):
                fixed = given | ones
                signature = {
                    arg: "constexpr" if arg in fixed else "i32" if arg in SIZES else "*fp32"
                    for arg in kernel.arg_names
                }
                for capability in (80, 90):
                    source = ASTSource(kernel, signature, constexprs=fixed)
                    made = triton.compile(source, target=GPUTarget("cuda", capability, 32))
                    print(name, sorted(ones), f"sm_{capability}", len(made.asm["cubin"]), "bytes")
                    assert made.asm["cubin"]


if __name__ == "__main__":
    {"ssim": compare_ssim, "planes": compare_planes, "compile": compile_all}[sys.argv[1]]()
