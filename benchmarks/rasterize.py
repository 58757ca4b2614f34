"""How fast is the rasteriser, and how far from what the machine can do?

    python benchmarks/rasterize.py                 the table: N in 10k, 100k, 1M at three sizes
    python benchmarks/rasterize.py --quick         100k at 640 x 480 alone
    python benchmarks/rasterize.py --json          a row a line, each as soon as it is measured
    python benchmarks/rasterize.py --quick --against COMMIT --runs 50
                                                   this tree and that commit in turns, each in a process of its own

The scene: half of the Gaussians on a facade at depth 4, the rest uniform between depths 2 and 6, log-normal scales
around 0.01, opacities uniform in [0, 1], focal length 0.9 widths. A run blends three channels and depth. Forward
includes projection, binning and sorting; backward reaches means, quaternions, scales, opacities and colours.
The times are medians of at least 7 runs after warm-up; the shortest are given beside them, as they suffer less
from other programs.

The share of peak compares the blend's exponentials and multiply-adds with those of a kernel that does nothing else,
timed between the runs on as many threads.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from statistics import median

import numpy as np
import torch
from numba import njit

from peak import EXPONENTIAL_FMAS, peak_seconds_per_fma
from rasterize_against import compare
from rasterize_scene import make_scene, time_once
from wildgs.rasterize import BackendName, Projection
from wildgs.rasterize.cpu.reach_kernels import HALF, RECORD, count_bits, reach
from wildgs.threads import thread_count

SIZES = ((320, 240), (640, 480), (1280, 960))
COUNTS = (10_000, 100_000, 1_000_000)
REFERENCE_LIMIT = 1e9  # (Gaussian, pixel) pairs that the dense reference is asked for
# Multiply-adds beside the exponential that one block of 16 pixels needs, forward and backward.
BLEND_FMAS = {"forward": 14, "backward": 36}


@dataclass
class Row:
    """One line of the table; rates count pixels that the kernel computes, in blocks of 16."""

    backend: str
    n: int
    width: int
    height: int
    threads: int
    forward_ms: float
    backward_ms: float
    forward_min_ms: float
    backward_min_ms: float
    tile_pairs: int | None = None
    pixel_gaussians: int | None = None
    forward_per_second: float | None = None
    backward_per_second: float | None = None
    share_of_peak_forward: float | None = None
    share_of_peak_backward: float | None = None
    times_faster_than_reference: float | None = None


@njit(nogil=True, cache=True)
def count_blocks(offsets, entries, records, tiles_x):
    """Blocks of 16 pixels that Gaussians reach."""
    total = 0
    for tile in range(offsets.size - 1):
        x = np.float32(tile % tiles_x * 16) + HALF
        y = np.float32(tile // tiles_x * 16) + HALF
        for p in range(offsets[tile], offsets[tile + 1]):
            r = entries[2 * p] * RECORD
            total += count_bits(
                reach(
                    x - records[r], y - records[r + 1], np.float32(4.0), records[r + 2], records[r + 3],
                    records[r + 4], records[r + 5], records[r + 6], records[r + 7],
                )
            )  # fmt: skip
    return total


def measure(backend: BackendName, n: int, width: int, height: int, runs: int) -> Row:
    """Times one combination; see the module's words."""
    inputs, camera = make_scene(n, width, height)
    if backend == "cuda":
        inputs, camera = [t.cuda() for t in inputs], camera.to("cuda")
    leaves = [t.requires_grad_() for t in inputs]
    forward_times, backward_times, projection = [], [], None
    for run in range(runs + 2):
        forward, backward, projection = time_once(leaves, camera, backend)
        if run >= 2:
            forward_times.append(forward)
            backward_times.append(backward)
    row = Row(
        backend, n, width, height, thread_count(),
        median(forward_times), median(backward_times), min(forward_times), min(backward_times),
    )  # fmt: skip
    if backend == "cpu":
        add_rates(row, projection)
    return row


def add_rates(row: Row, projection: Projection) -> None:
    """What the CPU kernels did, and how that compares with the machine's peak."""
    tiles = projection.tiles
    blocks = count_blocks(tiles.offsets, tiles.entries, tiles.records, -(-row.width // 16))
    row.tile_pairs, row.pixel_gaussians = tiles.pairs, 16 * blocks
    row.forward_per_second = row.pixel_gaussians / row.forward_ms * 1e3
    row.backward_per_second = row.pixel_gaussians / row.backward_ms * 1e3
    row.share_of_peak_forward = (
        1e3
        * blocks
        * peak_seconds_per_fma()
        * (BLEND_FMAS["forward"] + EXPONENTIAL_FMAS)
        / row.forward_min_ms
    )
    row.share_of_peak_backward = (
        1e3
        * blocks
        * peak_seconds_per_fma()
        * (BLEND_FMAS["backward"] + EXPONENTIAL_FMAS)
        / row.backward_min_ms
    )


def reference_ms(n: int, width: int, height: int) -> float | None:
    """Forward and backward of the dense torch reference, one run; None where it would take minutes."""
    if n * width * height > REFERENCE_LIMIT:
        return None
    row = measure("reference", n, width, height, runs=1)
    return row.forward_ms + row.backward_ms


def table(rows: list[Row]) -> str:
    head = (
        "| backend | N | size | forward ms (min) | backward ms (min) | tile pairs | G pixel-Gaussians/s fwd, bwd |"
        " share of peak fwd, bwd | x reference |"
    )
    lines = [head, "|" + "---|" * 9]
    for r in rows:
        rates = shares = ratio = "-"
        if r.forward_per_second and r.backward_per_second:
            rates = f"{r.forward_per_second / 1e9:.2f}, {r.backward_per_second / 1e9:.2f}"
            shares = f"{r.share_of_peak_forward:.0%}, {r.share_of_peak_backward:.0%}"
        if r.times_faster_than_reference:
            ratio = f"{r.times_faster_than_reference:.0f}"
        lines.append(
            f"| {r.backend} | {r.n} | {r.width}x{r.height} | {r.forward_ms:.1f} ({r.forward_min_ms:.1f}) |"
            f" {r.backward_ms:.1f} ({r.backward_min_ms:.1f}) | {r.tile_pairs or '-'} |"
            f" {rates} | {shares} | {ratio} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, nargs="+", default=list(COUNTS), help="numbers of Gaussians")
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in SIZES], help="such as 640x480")
    parser.add_argument(
        "--backends", nargs="+", default=None, help="cpu, cuda; those that work here if not given"
    )
    parser.add_argument("--runs", type=int, default=9, help="runs after warm-up, at least 7")
    parser.add_argument("--quick", action="store_true", help="100k at 640x480 alone")
    parser.add_argument(
        "--reference", action="store_true", help="time the dense reference too, where feasible"
    )
    parser.add_argument("--against", metavar="COMMIT", help="compare the CPU backend with this commit's")
    parser.add_argument("--json", action="store_true", help="a row a line, and nothing else, on stdout")
    options = parser.parse_args()
    counts, sizes = options.n, [tuple(int(v) for v in size.split("x")) for size in options.sizes]
    if options.quick:
        counts, sizes = [100_000], [(640, 480)]
    if options.against:
        print(compare(options.against, counts, sizes, max(7, options.runs)))
        return
    backends = options.backends or (["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
    rows = []
    for backend in backends:
        for n in counts:
            for width, height in sizes:
                row = measure(backend, n, width, height, max(7, options.runs))
                dense = reference_ms(n, width, height) if options.reference else None
                if dense is not None:
                    row.times_faster_than_reference = dense / (row.forward_ms + row.backward_ms)
                print(
                    f"{backend} {n} {width}x{height}: {row.forward_ms:.1f} + {row.backward_ms:.1f} ms",
                    file=sys.stderr,
                )
                rows.append(row)
                if options.json:
                    print(json.dumps(asdict(row)), flush=True)
    if not options.json:
        print(table(rows))


if __name__ == "__main__":
    main()
