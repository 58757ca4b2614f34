"""`wildgs eval`: scores of a run on the photos that were held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.table import Table

from wildgs.cli.progress import console, counting
from wildgs.evaluation.protocol import Protocol, evaluate
from wildgs.runs import Run, load_run
from wildgs.scene import Scene


@dataclass(frozen=True)
class Command:
    """Scores a run's held-out views and writes them to RUN/eval/.

    `full` takes a view's light from the whole photo and scores the whole frame; `half` takes it from the left
    half and scores the right one.

    Example: wildgs eval runs/gate --protocol half
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    protocol: Literal["full", "half", "both"] = "both"
    """Where the light comes from and what is scored."""
    lpips: Path | None = None
    """Folder with LPIPS weights, where they are not in torch's cache."""


def run(command: Command) -> None:
    """Scores and prints a table."""
    loaded = load_run(command.run)
    with counting("reading photos") as progress:
        scene = loaded.read_scene(progress=progress)
    protocols: tuple[Protocol, ...] = ("full", "half") if command.protocol == "both" else (command.protocol,)
    scores: dict[Protocol, dict[str, Any]] = {
        protocol: evaluate_run(loaded, scene, protocol, lpips_folder=command.lpips) for protocol in protocols
    }
    print_scores({str(command.run): scores})


def evaluate_run(
    loaded: Run, scene: Scene, protocol: Protocol, *, lpips_folder: Path | None = None
) -> dict[str, Any]:
    """Evaluates a loaded run under one protocol, with progress; returns what `metrics.json` holds."""
    total = len(scene.test_views)
    with counting(f"scoring {loaded.config.method}, protocol {protocol}") as count:
        done = 0

        def on_view(_: str) -> None:
            nonlocal done
            done += 1
            count(done, total)

        return evaluate(
            loaded.method,
            scene,
            protocol,
            loaded.folder,
            step=loaded.step,
            train_seconds=loaded.train_seconds,
            lpips_folder=lpips_folder,
            mask_threshold=loaded.method.mask_threshold,
            on_view=on_view,
        )


def print_scores(runs: dict[str, dict[Protocol, dict[str, Any]]]) -> None:
    """Prints one table over runs and protocols, then what could not be computed."""
    table = Table("run", "protocol", "PSNR", "SSIM", "LPIPS", "Gaussians", "frames/s")
    notes: dict[str, None] = {}
    for name, protocols in runs.items():
        for protocol, metrics in protocols.items():
            mean = metrics["mean"]
            cells = [_number(mean["psnr"], 2), _number(mean["ssim"], 3), _number(mean["lpips"], 3)]
            table.add_row(
                name, protocol, *cells, f"{metrics['num_gaussians']:,}", _number(metrics["render_fps"], 0)
            )
            notes |= dict.fromkeys(metrics.get("notes", ()))
    console.print(table)
    for note in notes:
        console.print(note, style="dim")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
