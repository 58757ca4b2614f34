"""Trains on the CPU and on a pretended CUDA device; prints both runs' losses and counts as JSON. Run by a test."""

# ruff: noqa: E402 - the device has to be there before torch is
from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "benchmarks"), str(Path(__file__).parent)]

import pretend_cuda

pretend_cuda.prepare()

import torch

from conftest import build_tiny_model, build_wall_scene
from wildgs.engine.density import DensityConfig
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.model.registry import MethodName, create_method, restore_method

STEPS, RESUMED = 60, 5
CONFIG = TrainConfig(
    steps=120, precision="float32", density=DensityConfig(grow_gradient=1e-5, max_gaussians=900)
)


def train(name: MethodName, device: str) -> dict[str, list[float] | int]:
    """Losses of a training with a densification, and of the same one taken up again from its state."""
    scene = build_wall_scene()
    torch.manual_seed(0)
    method = create_method(name, build_tiny_model(), scene.points, scene.point_colors).to(device)
    trainer = Trainer(method, scene, CONFIG)
    trainer.begin()
    losses = [float(trainer.advance().losses.total.detach()) for _ in range(STEPS)]
    state = {key: value.detach().cpu().clone() for key, value in trainer.state().items()}
    parameters = {
        key.removeprefix("method."): value for key, value in state.items() if key.startswith("method.")
    }
    again = restore_method(name, build_tiny_model(), parameters).to(device)
    resumed = Trainer(again, scene, CONFIG)
    resumed.restore(state)
    resumed.begin()
    further = [float(resumed.advance().losses.total.detach()) for _ in range(RESUMED)]
    return {"losses": losses, "resumed": further, "gaussians": len(again.gaussians)}


def main() -> None:
    warnings.simplefilter("ignore")
    found = {}
    for name in ("3dgs", "wildgs"):
        found[name] = {"cpu": train(name, "cpu")}
        with pretend_cuda.device() as record:
            before = record.graphs
            found[name]["cuda"] = train(name, "cuda")
            found[name]["graphs"] = record.graphs - before
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
