"""`wildgs demo`: the built-in landmark, from its photos to a page to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wildgs.cli.eval import evaluate_run, print_scores
from wildgs.cli.progress import console
from wildgs.cli.showcase import Scores, write_showcase
from wildgs.cli.training import read_scene, train_or_go_on
from wildgs.cli.webpage import write_scene_page
from wildgs.config import RunConfig
from wildgs.engine.density import DensityConfig
from wildgs.engine.trainer import TrainConfig
from wildgs.errors import UserError
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import MethodName
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import load_run
from wildgs.scene.demo import write_demo_scene

TITLES: dict[MethodName, str] = {"wildgs": "Wild-GS", "3dgs": "3DGS"}
SUMMARY = (
    "A made-up landmark in {photos} rendered photos: different hours and cameras, and people in the way. Wild-GS "
    "and plain 3D Gaussian Splatting were trained on them for {steps:,} steps each. Both are scored on held-out "
    "photos, against the same views without the people."
)


MODEL = WildGSConfig(parsing=ParsingConfig(max_side=160))
MAX_GAUSSIANS = 30_000


@dataclass(frozen=True)
class Command:
    """Trains Wild-GS and plain 3DGS on the 40 photos of the built-in landmark, scores both and writes a page.

    Example: wildgs demo --output wildgs-demo
    """

    output: Path = Path("wildgs-demo")
    """Folder for the scene, both runs, report.html and scene.html."""
    steps: int = 1500
    """Training steps of each method."""


def run(command: Command) -> None:
    """Unpacks the scene, trains and scores both methods, and writes the pages."""
    if command.steps < 1:
        raise UserError(f"steps {command.steps}: must be 1 or more")
    page = command.output / "report.html"
    if page.exists():
        raise UserError(f"{page} exists already; open it, or choose another --output")
    folder = write_demo_scene(command.output / "scene")
    runs = []
    for method in ("wildgs", "3dgs"):
        config = RunConfig(folder.resolve(), method, model=MODEL, train=_training(command.steps))
        scene = read_scene(config)
        target = command.output / method
        train_or_go_on(target, config, scene)
        loaded = load_run(target)
        scores: Scores = {
            "full": evaluate_run(loaded, scene, "full"),
            "half": evaluate_run(loaded, scene, "half"),
        }
        runs.append((TITLES[method], loaded, scores))
    print_scores({name: scores for name, _, scores in runs})
    summary = SUMMARY.format(photos=len(scene.views), steps=command.steps)
    write_showcase(page, "Wild-GS demo", summary, scene, runs)
    scene_page = command.output / "scene.html"
    write_scene_page(runs[0][1], scene_page, "Wild-GS demo")
    console.print(f"open {page.resolve()} in a browser: scores and comparisons")
    console.print(f"open {scene_page.resolve()} in a browser: the scene itself, under several lights")


def _training(steps: int) -> TrainConfig:
    """The defaults, with as many Gaussians as photos of this size can resolve."""
    return TrainConfig(steps=steps, density=DensityConfig(max_gaussians=MAX_GAUSSIANS))
