"""The package on a device that says it is CUDA; test_pretended_cuda runs it in a process of its own.

python pretended_cuda.py SCENE OUTPUT       writes OUTPUT/found.json
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from pathlib import Path
from typing import Any

from benchmarks import pretend_cuda

if __name__ == "__main__":
    pretend_cuda.prepare()

import torch

from benchmarks.pretend_cuda.tensors import Record
from tests.engine.conftest import build_tiny_model, build_wall_scene
from wildgs import features
from wildgs.cli import main
from wildgs.engine.config import DensityConfig, ScheduleConfig, TrainConfig, WarpConfig
from wildgs.engine.trainer import Trainer
from wildgs.model.registry import MethodName, create_method

METHODS: tuple[MethodName, ...] = ("3dgs", "wildgs", "affine")
STEPS = 12
SCHEDULE = ScheduleConfig(first_stage=0, sh_every=1, mask_pause=0)
TRAIN = ("--steps", "10", "--max-gaussians", "400", "--density.grow-gradient", "1e-6", "--log-every", "4")
TINY = ("--wrapping.resolution", "16", "--parsing.max-side", "64", "--checkpoint-every", "4")


def trainer_on(device: str, method: MethodName) -> Trainer:
    """A trainer that densifies and resets within a few steps."""
    torch.manual_seed(0)
    made = create_method(method, build_tiny_model() if method == "wildgs" else None, build_wall_scene())
    density = DensityConfig(grow_gradient=1e-5, max_gaussians=700)
    warp = WarpConfig(residuals=False, photos=0)
    config = TrainConfig(steps=20, precision="float32", schedule=SCHEDULE, density=density, warp=warp)
    trainer = Trainer(made.to(device), build_wall_scene(), config)
    schedule = trainer.schedule
    schedule.densify_from, schedule.densify_every, schedule.reset_every = 3, 5, 11
    trainer.begin()
    return trainer


def losses_of(trainer: Trainer) -> list[float]:
    """Totals of all steps."""
    reports = [trainer.advance() for _ in range(STEPS)]
    return [float(report.losses.total) for report in reports]


def trained(record: Record, method: MethodName, wanted: list[float]) -> dict[str, Any]:
    """A training on the device: losses, what a late step waits for, and convolutions that no graph replays."""
    trainer = trainer_on("cuda", method)
    before = record.graphs
    found = losses_of(trainer)
    record.clear()
    trainer.schedule.densify_every = trainer.schedule.reset_every = 0
    trainer.advance()
    waits = dict(record.waits)
    record.clear()
    for _ in range(SCHEDULE.mask_every):
        trainer.advance()
    convolutions = sum(times for name, times in record.launches.items() if "convolution" in name)
    state = {name: str(value.device) for name, value in trainer.state().items()}
    trainer.end()
    return {
        "method": method, "without": os.environ.get("WILDGS_WITHOUT", ""), "wanted": wanted, "found": found,
        "convolutions": convolutions, "waits": waits, "graphs": record.graphs - before,
        "on_cpu": sorted(name for name, device in state.items() if device == "cpu"),
    }  # fmt: skip


def through_the_command_line(scene: Path, output: Path) -> None:
    """Every verb that computes."""
    for method in METHODS:
        options = [*TRAIN, *TINY] if method == "wildgs" else TRAIN
        main(["train", str(scene), "--output", str(output / method), "--method", method, *options])
        # Masks, which other methods do not have, are scored in protocol full.
        main(["eval", str(output / method), "--protocol", "both" if method == "wildgs" else "half"])
    run, names = str(output / "wildgs"), sorted(path.name for path in (scene / "images").iterdir())
    for verb, *rest in (
        ("train", scene, "--resume", "--steps", 10, "--output", run),
        ("render", run, "--appearance", names[0], "--output", output / "pictures", "--view", names[0]),
        ("export", run, "--appearance", names[0], "--format", "ply", "--output", output / "scene.ply"),
        ("appearance", run, names[1], "--output", output / "light.safetensors"),
    ):
        main([verb, *map(str, rest)])


if __name__ == "__main__":
    scene, output = map(Path, sys.argv[1:])
    warnings.simplefilter("error")
    wanted = {method: losses_of(trainer_on("cpu", method)) for method in METHODS}
    with pretend_cuda.device() as device:
        trainings = [trained(device, method, wanted[method]) for method in METHODS]
        os.environ["WILDGS_WITHOUT"] = ",".join(features.FEATURES)
        trainings.append(trained(device, "wildgs", wanted["wildgs"]))
        del os.environ["WILDGS_WITHOUT"]
        through_the_command_line(scene, output)
    (output / "found.json").write_text(json.dumps(trainings, indent=1))
