"""How much faster do K processes train than one?

    python benchmarks/scaling.py                          1 and 2 processes, both methods, the demo's landmark
    python benchmarks/scaling.py --processes 1 2 4 8      one GPU each, where there are GPUs
    python benchmarks/scaling.py --json                   the rows, and nothing else, on stdout

For each number of processes, torchrun starts this script again. Every process times whole steps, one photo each,
and then the exchange of gradients and statistics by itself, from the moment when all are there. Efficiency is the
photos per second of K processes over K times those of one process with the same means: its own GPU, or on CPUs the
K-th part of the cores. Speedup is over one process with everything: one GPU, or all cores.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch

from train_step import make_scene, make_trainer, peak_memory
from wildgs.engine.density.control import SeenView
from wildgs.engine.distributed import join
from wildgs.engine.team import Team
from wildgs.engine.trainer import Trainer
from wildgs.model.registry import MethodName
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import default_device
from wildgs.scene import DataConfig, Scene, load_scene


@dataclass
class Row:
    """One method on some processes."""

    method: str
    device: str
    n: int
    width: int
    height: int
    processes: int
    threads: int
    step_ms: float
    photos_per_second: float
    exchange_ms: float
    exchange_mb: float
    peak_memory_gb: float
    speedup: float = 1.0
    efficiency: float = 1.0


def time_steps(trainer: Trainer, count: int) -> float:
    """Median milliseconds of a step, once every photo has been seen: its features are computed once and kept."""
    times, rhythm = [], trainer.config.schedule.encoder_every
    warm_up = -(-len(trainer.views) // (rhythm * trainer.team.size)) + 1
    for index in range(count + warm_up):
        start = time.perf_counter()
        for _ in range(rhythm):
            trainer.advance()
        if trainer.device.type == "cuda":
            torch.cuda.synchronize()
        if index >= warm_up:
            times.append(1e3 * (time.perf_counter() - start) / rhythm)
    return median(times)


def time_exchange(trainer: Trainer, count: int) -> tuple[float, float]:
    """Median milliseconds of the exchange once all processes are there, and its megabytes."""
    view = trainer.feed.next_view()
    photo, keep = trainer.feed.photo(view)
    sky = trainer._sky(view)
    output, losses = trainer._forward(view, photo, keep, sky)
    static = trainer._static_pixels(output, keep, sky)
    seen = SeenView(output.projection, output.rendering.colors, output.painted, photo, static)
    seen = trainer.density.before_backward(seen)
    losses.total.backward()
    statistics = trainer.density.measure(seen)
    gradients = [p.grad for p in trainer.method.parameters() if p.grad is not None]
    size = sum(4 * gradient.numel() for gradient in gradients) + 3 * 4 * len(statistics.seen)
    times = []
    for _ in range(count):
        trainer.team.least(0)  # all are there
        start = time.perf_counter()
        trainer.team.average(trainer.method.parameters(), losses)
        trainer.team.pool(statistics)
        if trainer.device.type == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    trainer.method.zero_grad(set_to_none=True)
    return median(times), size / 1e6


def work(options: argparse.Namespace, team: Team) -> None:
    """One process's part; the first one writes the rows."""
    if options.threads:
        torch.set_num_threads(options.threads)
    scene: Scene = load_scene(options.folder / "scene", DataConfig(holdout=0))
    rows = []
    for method in options.methods:
        trainer = make_trainer(method, scene, options.gaussians, default_device(), WildGSConfig(), team)
        step_ms = time_steps(trainer, options.steps)
        exchange_ms, megabytes = time_exchange(trainer, max(3, options.steps // 2))
        camera = scene.train_views[0].camera
        rows.append(
            Row(
                method, str(trainer.device), options.gaussians, camera.width, camera.height, team.size,
                torch.get_num_threads(), step_ms, 1e3 * team.size / step_ms,
                exchange_ms if team.size > 1 else 0.0, megabytes, peak_memory(trainer.device),
            )
        )  # fmt: skip
        del trainer
    if team.first:
        (options.folder / "rows.json").write_text(json.dumps([asdict(row) for row in rows]))


def launch(options: argparse.Namespace, folder: Path, processes: int, threads: int) -> list[Row]:
    """Runs `work` in so many processes."""
    launcher = [sys.executable]
    if processes > 1:
        launcher += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    arguments = [
        __file__,
        "--folder",
        str(folder),
        "--gaussians",
        str(options.gaussians),
        "--steps",
        str(options.steps),
    ]
    arguments += ["--methods", *options.methods, "--threads", str(threads)]
    environment = os.environ | ({"WILDGS_NUM_THREADS": str(threads)} if threads else {})
    subprocess.run([*launcher, *arguments], env=environment, check=True, stdout=sys.stderr)
    return [Row(**entry) for entry in json.loads((folder / "rows.json").read_text())]


def measure(options: argparse.Namespace, folder: Path) -> list[Row]:
    """All rows, with what they are worth against one process."""
    gpu = default_device().type == "cuda"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    rows: list[Row] = []
    for processes in options.processes:
        threads = 0 if gpu else max(1, cores // processes)
        found = launch(options, folder, processes, threads)
        whole = found if processes == 1 else launch(options, folder, 1, 0 if gpu else cores)
        part = whole if gpu or processes == 1 else launch(options, folder, 1, threads)
        for row, with_all, with_part in zip(found, whole, part, strict=True):
            row.speedup = row.photos_per_second / with_all.photos_per_second
            row.efficiency = row.photos_per_second / (processes * with_part.photos_per_second)
        rows += found
    return rows


def show(rows: list[Row]) -> None:
    """The table, for people."""
    print(
        "| method | device | N | size | processes | threads each | step ms | photos/s | exchange ms "
        "| exchange MB | peak GB | speedup | efficiency |"
    )
    print("|---" * 13 + "|")
    for r in rows:
        print(
            f"| {r.method} | {r.device} | {r.n:,} | {r.width}x{r.height} | {r.processes} | {r.threads} | "
            f"{r.step_ms:.0f} | {r.photos_per_second:.2f} | {r.exchange_ms:.1f} | {r.exchange_mb:.1f} | "
            f"{r.peak_memory_gb:.1f} | {r.speedup:.2f} | {r.efficiency:.0%} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    methods: tuple[MethodName, ...] = ("3dgs", "wildgs")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--methods", nargs="+", choices=methods, default=list(methods))
    parser.add_argument("--gaussians", type=int, default=100_000, help="Gaussians")
    parser.add_argument("--width", type=int, default=480, help="pixels of the longer side")
    parser.add_argument("--steps", type=int, default=12, help="timed steps")
    parser.add_argument("--json", action="store_true", help="only the rows, on stdout")
    parser.add_argument("--threads", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.folder is not None:
        with join() as team:
            work(options, team)
        return
    with tempfile.TemporaryDirectory() as folder:
        make_scene(Path(folder) / "scene", options.width, photos=max(8, max(options.processes)))
        rows = measure(options, Path(folder))
    if options.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
    else:
        show(rows)


if __name__ == "__main__":
    main()
