"""Stages of gpu.sh that train: each prints one JSON object a line as soon as it has it.

    python benchmarks/gpu_stages.py eager       60 steps without CUDA graphs; run it with CUDA_LAUNCH_BLOCKING=1
    python benchmarks/gpu_stages.py graphs      200 steps without and with graphs: recorded, and the same losses
    python benchmarks/gpu_stages.py profile     10 steps at 1M and at 100k Gaussians: kernels and waits of the host
    python benchmarks/gpu_stages.py host        a step's time without a profiler, and where Python spends it
    python benchmarks/gpu_stages.py features    a step's time with each of WILDGS_WITHOUT's features switched off

--tiny: sizes for a dry run on the CPU. Exit code 1 where a stage finds that something is wrong.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import math
import os
import pstats
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch

from train_step import make_scene, make_trainer
from wildgs.engine.report import StepReport
from wildgs.engine.trainer import Trainer
from wildgs.errors import WildGSWarning
from wildgs.features import FEATURES
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import default_device
from wildgs.scene import Scene

WARM_UP = 40
"""Steps after which every shape of photo has its graphs, with and without a mask that learns."""
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize", "cudaMemcpy", "aten::item")


class _EnoughError(Exception):
    """Ends a training after the stage's steps."""


@dataclass(frozen=True)
class Size:
    """How much a stage does."""

    width: int
    gaussians: tuple[int, ...]
    eager_steps: int
    graph_steps: int
    profiled_steps: int


FULL = Size(480, (1_000_000, 100_000), 60, 200, 10)
TINY = Size(48, (300, 200), 2, 4, 1)


def say(**values: Any) -> None:
    """One line, on disk at once."""
    print(json.dumps(values), flush=True)


def trained(scene: Scene, n: int, steps: int, graphs: bool) -> tuple[int, list[float], list[str], float]:
    """Trains through `Trainer.run`: graphs that were recorded, losses, warnings and seconds."""
    trainer = make_trainer("wildgs", scene, n, default_device(), WildGSConfig(), graphs=graphs)
    last = trainer.step + steps
    losses: list[torch.Tensor] = []
    recorded = 0

    def observe(report: StepReport) -> None:
        nonlocal recorded
        losses.append(report.losses.total)
        recorded = max(recorded, count_recorded(trainer))
        if report.step >= last:
            raise _EnoughError

    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", WildGSWarning)
        with suppress(_EnoughError):
            trainer.run([observe])
    values = torch.stack(losses).tolist()
    seconds = time.perf_counter() - start
    return recorded, values, [str(warning.message) for warning in caught], seconds


def count_recorded(trainer: Trainer) -> int:
    """CUDA graphs that the method's networks hold."""
    modules = trainer.method.modules()
    return sum(module.replays.recorded for module in modules if hasattr(module, "replays"))


def eager(scene: Scene, size: Size) -> bool:
    """Steps without graphs: finite losses."""
    _, losses, said, seconds = trained(scene, size.gaussians[-1], size.eager_steps, graphs=False)
    well = all(map(math.isfinite, losses))
    say(
        stage="eager",
        well=well,
        steps=len(losses),
        seconds=seconds,
        first=losses[0],
        last=losses[-1],
        warnings=said,
    )
    return well


def graphs(scene: Scene, size: Size) -> bool:
    """The same steps with and without graphs."""
    found: dict[bool, list[float]] = {}
    well, on_cuda = True, default_device().type == "cuda"
    for on in (False, True):
        recorded, found[on], said, seconds = trained(scene, size.gaussians[-1], size.graph_steps, graphs=on)
        well &= not any("CUDA graphs do not work" in line for line in said)
        well &= (recorded > 0) == (on and on_cuda)
        say(
            stage="graphs",
            graphs=on,
            recorded=recorded,
            seconds=seconds,
            warnings=said,
            losses=found[on][::10],
        )
    difference = abs(mean(found[True]) - mean(found[False])) / mean(found[False])
    first = max(abs(a - b) / b for a, b in zip(found[True][:4], found[False][:4], strict=True))
    well &= difference < 0.05 and first < 0.02
    say(stage="graphs", well=well, mean_difference=difference, first_steps_difference=first)
    return well


def profile(scene: Scene, size: Size) -> bool:
    """Where the device's time goes, and what the host waits for."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    on_cuda = default_device().type == "cuda"
    if on_cuda:
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    for n in size.gaussians:
        for method in ("wildgs", "3dgs"):
            trainer = make_trainer(method, scene, n, default_device(), WildGSConfig())
            for _ in range(WARM_UP if on_cuda else 1):
                trainer.advance()
            with torch.profiler.profile(activities=activities) as recorded:
                for _ in range(size.profiled_steps):
                    trainer.advance()
            trainer.end()
            events = recorded.key_averages()
            attribute = "self_device_time_total" if on_cuda else "self_cpu_time_total"
            top = sorted(events, key=lambda event: -getattr(event, attribute))[:25]
            steps = size.profiled_steps
            kernels = [
                {
                    "name": event.key[:120],
                    "ms": getattr(event, attribute) / 1e3 / steps,
                    "calls": event.count / steps,
                }
                for event in top
            ]
            waits = {e.key: e.count / steps for e in events if e.key in WAITS}
            total = sum(getattr(event, attribute) for event in events) / 1e3 / steps
            say(stage="profile", method=method, n=n, total_ms=total, kernels=kernels, waits=waits)
    return True


def host(scene: Scene, size: Size) -> bool:
    """Steps that nothing observes, then the same under cProfile."""
    for n in size.gaussians:
        for method in ("wildgs", "3dgs"):
            trainer = make_trainer(method, scene, n, default_device(), WildGSConfig())
            for _ in range(WARM_UP if default_device().type == "cuda" else 1):
                trainer.advance()
            steps = size.graph_steps // 2
            seconds = _seconds(trainer, steps)
            profiler = cProfile.Profile()
            profiler.enable()
            profiled = _seconds(trainer, steps)
            profiler.disable()
            trainer.end()
            found = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
            functions = [
                {
                    "name": _short(name),
                    "calls": calls / steps,
                    "own_ms": 1e3 * own / steps,
                    "ms": 1e3 * total / steps,
                }
                for name, (_, calls, own, total, _) in sorted(found.items(), key=lambda each: -each[1][3])[
                    :120
                ]
            ]
            say(stage="host", method=method, n=n, step_ms=1e3 * seconds / steps,
                profiled_ms=1e3 * profiled / steps, functions=functions)  # fmt: skip
    return True


def _seconds(trainer: Trainer, steps: int) -> float:
    """The time of steps, until the device has done them."""
    start = time.perf_counter()
    for _ in range(steps):
        trainer.advance()
    if default_device().type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def _short(name: tuple[str, int, str]) -> str:
    file, line, function = name
    return f"{Path(file).name}:{line} {function}" if line else function[:80]


def features(scene: Scene, size: Size) -> bool:
    """A step's time with all features, then without each."""
    before = os.environ.get("WILDGS_WITHOUT", "")
    for without in ("", *FEATURES):
        os.environ["WILDGS_WITHOUT"] = without
        trainer = make_trainer("wildgs", scene, size.gaussians[0], default_device(), WildGSConfig())
        times = []
        for _ in range(2 * size.profiled_steps + WARM_UP * (default_device().type == "cuda")):
            start = time.perf_counter()
            trainer.advance()
            if default_device().type == "cuda":
                torch.cuda.synchronize()
            times.append(1e3 * (time.perf_counter() - start))
        trainer.end()
        say(stage="features", without=without or None, step_ms=median(times[-2 * size.profiled_steps :]))
    os.environ["WILDGS_WITHOUT"] = before
    return True


STAGES = {"eager": eager, "graphs": graphs, "profile": profile, "host": host, "features": features}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stage", choices=[*STAGES], nargs="+")
    parser.add_argument("--tiny", action="store_true", help="a dry run's sizes")
    options = parser.parse_args()
    size = TINY if options.tiny else FULL
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder) / "scene", size.width, *((8,) if options.tiny else ()))
        return 0 if all(STAGES[stage](scene, size) for stage in options.stage) else 1


if __name__ == "__main__":
    sys.exit(main())
