"""Do all ranks hold the same bits after a training with densification?

    python benchmarks/identical_ranks.py [--processes 2] [--steps 200]

Trains a small landmark with both methods for so many optimiser steps (each a photo on every rank) and compares
SHA-256 over all that resuming needs: parameters, Adam's moments, statistics, orders, generators. Exit code
1 where ranks differ, or where nothing was densified.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from train_step import make_scene
from wildgs.engine.checkpoint import Checkpoint
from wildgs.engine.config import DensityConfig
from wildgs.engine.distributed import join
from wildgs.engine.schedule import ScheduleConfig
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.model.registry import MethodName, create_method
from wildgs.runs import default_device
from wildgs.scene import DataConfig, load_scene

METHODS: tuple[MethodName, ...] = ("3dgs", "wildgs")
DENSIFY_EVERY = 20  # optimiser steps


def work(folder: Path, steps: int, team: Team) -> None:
    """Trains on this rank, and leaves a line a method."""
    scene = load_scene(folder / "scene", DataConfig(holdout=0))
    lines = []
    for name in METHODS:
        torch.manual_seed(0)
        method = create_method(name, None, scene)
        schedule = ScheduleConfig(
            first_stage=10_000,
            densify_from=1,
            densify_every=30_000 * DENSIFY_EVERY // steps,
            densify_until=29_000,
        )
        config = TrainConfig(
            steps=steps * team.size, schedule=schedule, density=DensityConfig(grow_gradient=5e-5)
        )
        trainer = Trainer(method.to(default_device()), scene, config, team)
        rounds: list[int] = []
        before = len(method.gaussians)
        trainer.run([lambda report, rounds=rounds: rounds.append(report.density is not None)])
        state = {key: value for key, value in trainer.state().items() if key != "random.cuda"}
        digest = Checkpoint(state, {}).fingerprint
        after = len(method.gaussians)
        lines.append(f"{name} {digest} {len(rounds)} {sum(rounds)} {before} {after}")
    (folder / f"rank_{team.rank}.txt").write_text("\n".join(lines))


def compare(folder: Path, processes: int) -> bool:
    """Prints what the ranks left; whether all is well."""
    ranks = [(folder / f"rank_{rank}.txt").read_text().splitlines() for rank in range(processes)]
    well = True
    for lines in zip(*ranks, strict=True):
        name, digest, steps, rounds, before, after = lines[0].split()
        same = len(set(lines)) == 1
        well &= same and before != after
        print(
            f"{name}: {steps} steps on {processes} ranks, {rounds} densifications, {int(before):,} -> "
            f"{int(after):,} Gaussians: {'the same bits on all' if same else 'RANKS DIFFER'} ({digest[:16]})"
        )
    return well


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--width", type=int, default=64, help="pixels of the longer side")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.folder is not None:
        with join() as team:
            work(options.folder, options.steps, team)
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_scene(folder / "scene", options.width, photos=max(8, options.processes))
        launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={options.processes}"]
        arguments = [__file__, "--folder", name, "--steps", str(options.steps)]
        subprocess.run([sys.executable, *launcher, *arguments], env=os.environ, check=True)
        return 0 if compare(folder, options.processes) else 1


if __name__ == "__main__":
    sys.exit(main())
