"""What does a training step tell a GPU to do? Kernels launched, waits of the host, bytes: counted without a GPU.

    python benchmarks/launches.py                     3,000 Gaussians at 128x96: counts depend little on sizes
    python benchmarks/launches.py --n 1000000 --width 1000        bytes do
    python benchmarks/launches.py --eager             networks without graphs
    python benchmarks/launches.py --local-embeddings  with the triplane; --matched-loss 0 without the colour match
    python benchmarks/launches.py --json

The step is the one of CUDA (gsplat, mixed precision, graphs), on `pretend_cuda`'s device; gsplat's functions count
as one launch each. Needs g++ and a torch without CUDA; where there is a GPU, measure: benchmarks/train_step.py.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import pretend_cuda

if __name__ == "__main__":
    pretend_cuda.prepare()

import torch

from train_step import METHODS, make_scene, make_trainer
from wildgs.model.wildgs import WildGSConfig

FIRST_STEPS = 40
"""Steps after which all graphs are recorded: every shape of the scene has come often enough, with and without a
mask that learns."""


@dataclass
class Count:
    """One method's step, the mean over two: on one of them the encoder learns.

    Attributes:
        method: Which.
        launches: Operations that launch kernels.
        waits: Of the host for the device.
        megabytes: That torch's operations read and write, gsplat's and the graphs' left out.
        graphs: CUDA graphs that were recorded before.
        wait_places: What waits, and how often a step.
        by_operation: Launches a step.
    """

    method: str
    launches: float
    waits: float
    megabytes: float
    graphs: int
    wait_places: dict[str, float]
    by_operation: dict[str, float]


def count(n: int, width: int, first_steps: int, graphs: bool, model: WildGSConfig) -> list[Count]:
    """Both methods."""
    counts = []
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder) / "scene", width)
        for method in METHODS:
            with pretend_cuda.device() as record:
                before = record.graphs
                trainer = make_trainer(method, scene, n, torch.device("cuda"), model, graphs=graphs)
                for _ in range(first_steps):
                    trainer.advance()
                record.clear()
                for _ in range(2):
                    trainer.advance()
            counts.append(
                Count(
                    method, record.launches.total() / 2, record.waits.total() / 2, record.bytes / 2e6,
                    record.graphs - before, {what: times / 2 for what, times in record.waits.items()},
                    {name: times / 2 for name, times in record.launches.most_common()},
                )
            )  # fmt: skip
    return counts


def show(counts: list[Count]) -> None:
    """For people."""
    for each in counts:
        print(
            f"\n{each.method}: {each.launches:.0f} launches a step, {each.waits:.1f} waits, "
            f"{each.megabytes:,.0f} MB; {each.graphs} graphs recorded"
        )
        for what, times in each.wait_places.items():
            print(f"  waits {times:.1f} times: {what}")
        most = list(each.by_operation.items())[:12]
        print("  most often: " + ", ".join(f"{name} {times:.0f}" for name, times in most))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=3000, help="Gaussians")
    parser.add_argument("--width", type=int, default=128, help="of the photos' long side")
    parser.add_argument("--first-steps", type=int, default=FIRST_STEPS, help="before those that count")
    parser.add_argument("--eager", action="store_true", help="networks without graphs")
    parser.add_argument("--local-embeddings", action="store_true", help="with the triplane")
    parser.add_argument(
        "--matched-loss", type=float, default=WildGSConfig.matched_loss, help="as wildgs train"
    )
    parser.add_argument("--json", action="store_true", help="only the counts, on stdout")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    model = WildGSConfig(local_embeddings=options.local_embeddings, matched_loss=options.matched_loss)
    counts = count(options.n, options.width, options.first_steps, not options.eager, model)
    if options.json:
        json.dump([asdict(each) for each in counts], sys.stdout, indent=1)
    else:
        show(counts)


if __name__ == "__main__":
    main()
