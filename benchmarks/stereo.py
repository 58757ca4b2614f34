"""`python -m benchmarks.stereo`: cost of comparing planes in multi-view stereo, and of a photo's depth.

Prints nanoseconds per plane and neighbour on one thread with the share of peak (the time that the multiply-adds
alone would take, see `benchmarks.peak`), and seconds and memory per photo of the demo's scene on as many
threads as `WILDGS_NUM_THREADS` says, without compilation.
"""

from __future__ import annotations

import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import tyro

from benchmarks.peak import peak_seconds_per_fma
from benchmarks.resized_demo import write_resized_demo
from wildgs.priors.config import StereoConfig
from wildgs.priors.stereo import cost_kernels as kernels
from wildgs.priors.stereo.depth import stereo_depth
from wildgs.scene import DataConfig, load_scene
from wildgs.threads import thread_count

NEIGHBOURS, WIDTH, HEIGHT = 6, 400, 300
FMAS = 14
"""Multiply-adds per pixel of a window: projection, interpolation and sums. Gathers, conversions, clamps and the
division are not counted."""


@dataclass(frozen=True)
class Command:
    """Times stereo."""

    photos: int = 12
    """Photos of the demo's scene, a quarter of which are held out."""
    max_side: int = 240
    """Longer side of the photos, pixels."""
    planes: int = 100_000
    """Planes to compare."""


def nanoseconds_per_comparison(planes: int) -> float:
    """Of one window with one neighbour, whose pixels lie a few pixels apart from plane to plane."""
    rng = np.random.default_rng(0)
    blocks = kernels.pack_blocks(rng.uniform(size=(HEIGHT, WIDTH)).astype(np.float32))
    motions = np.tile(np.array([1, 0.01, 0, 0, 1, 0.02, 0, 0, 1, 50, 0, 0], np.float32), (NEIGHBOURS, 1))
    layout = np.tile(np.array([0, WIDTH, HEIGHT]), (NEIGHBOURS, 1))
    nothing, pixels = np.zeros((0, 3), np.float32), np.zeros(1, np.float32)
    compared = (pixels, blocks, layout, 0, np.arange(NEIGHBOURS), motions, nothing, layout, 3)
    values = rng.normal(size=kernels.SAMPLES).astype(np.float32) / kernels.SAMPLES
    window = (kernels.window_offsets(), values, np.full(kernels.SAMPLES, 1 / kernels.SAMPLES, np.float32))
    costs = np.empty(NEIGHBOURS, np.float32)
    plane_cost = kernels.plane_cost

    @numba.njit
    def compare(count, compared, window, costs):
        for i in range(count):
            plane_cost(
                compared,
                100 + i % 200,
                100,
                np.float32(0.1),
                np.float32(0),
                np.float32(0),
                window,
                np.float32(0.01),
                costs,
            )

    compare(10, compared, window, costs)
    start = time.process_time()
    compare(planes, compared, window, costs)
    return (time.process_time() - start) * 1e9 / (planes * NEIGHBOURS)


def main(command: Command) -> None:
    """Prints the figures."""
    spent = nanoseconds_per_comparison(command.planes)
    least = peak_seconds_per_fma() * thread_count() * 1e9 * FMAS * kernels.SAMPLES / 16
    print(f"{spent:.0f} ns per plane and neighbour, one thread, {least / spent:.0%} of peak")
    with tempfile.TemporaryDirectory() as folder:
        root = write_resized_demo(Path(folder) / "scene", photos=command.photos)
        scene = load_scene(root, DataConfig(max_side=command.max_side, use_depth=False))
        stereo_depth(load_scene(root, DataConfig(max_side=32, use_depth=False)), StereoConfig())  # compiles
        start = time.perf_counter()
        depths = stereo_depth(scene, StereoConfig())
        seconds = (time.perf_counter() - start) / len(depths)
    pixels = np.mean([depth.size for depth in depths.values()])
    print(f"{seconds:.2f} s per photo of {pixels:,.0f} pixels, {thread_count()} threads")
    print(
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:,.0f} MB at most, {len(depths)} photos"
    )


if __name__ == "__main__":
    main(tyro.cli(Command))
