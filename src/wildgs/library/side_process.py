"""The other process of `training_beside`: `python -m wildgs.library.side_process FOLDER THREADS < CONFIG`.

It starts by compiling kernels, so that two processes share this work while the other one still reads photos.
Modules that this does not need are imported afterwards.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import torch

from wildgs.losses.ssim import ssim
from wildgs.rasterize.cpu.warm_up import compile_blending, compile_gradients
from wildgs.threads import limited

if TYPE_CHECKING:
    from wildgs.engine.report import StepReport


def main(config: str, folder: str, threads: str) -> None:
    """Compiles kernels, then trains until the end, or until the process that started this one has ended.

    Args:
        config: Content of the run's configuration file.
        folder: The run folder.
        threads: Number of threads.
    """
    parent = os.getppid()
    with limited(int(threads)):
        compile_kernels()

        from wildgs.config_file import parse_config
        from wildgs.library.training import train

        def stop_if_orphaned(report: StepReport) -> None:
            if os.getppid() != parent:
                raise KeyboardInterrupt

        read = parse_config(config, "standard input")
        train(read.scene, read, output=folder, resume="auto", observers=[stop_if_orphaned])


def compile_kernels() -> None:
    """Compiles, or loads from the disk, the kernels that a training step calls last and that take longest."""
    compile_blending()
    compile_gradients()
    picture = torch.zeros(1, 1, 3, requires_grad=True)
    ssim(picture, picture).backward()


if __name__ == "__main__":
    main(sys.stdin.buffer.read().decode(), *sys.argv[1:])
