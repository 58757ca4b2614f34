"""`wildgs demo`: the built-in landmark, from nothing to a page to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demo_generator import SyntheticConfig, make_landmark
from wildgs.cli.eval import evaluate_run, print_scores
from wildgs.cli.progress import console, counting
from wildgs.cli.showcase import Scores, write_showcase
from wildgs.cli.training import read_scene, train_or_go_on
from wildgs.cli.webpage import write_scene_page
from wildgs.config import RunConfig
from wildgs.engine.density import DensityConfig
from wildgs.engine.trainer import TrainConfig
from wildgs.errors import UserError
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import method_type
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import load_run

SUMMARY = (
    "A landmark made in code and photographed by {photos} imagined visitors: other hours, other cameras, people in "
    "the way. Wild-GS and plain 3D Gaussian Splatting were trained on their photos for the same number of steps; "
    "both are scored on photos that neither has seen, against the same views without passers-by."
)


MODEL = WildGSConfig(parsing=ParsingConfig(max_side=160))
MAX_GAUSSIANS = 30_000


@dataclass(frozen=True)
class Command:
    """Makes a small landmark, trains Wild-GS and plain 3DGS on its photos, scores both, writes a page.

    Example: wildgs demo --output wildgs-demo
    """

    output: Path = Path("wildgs-demo")
    """Folder for the scene, both runs, report.html and scene.html."""
    steps: int = 1500
    """Training steps of each method."""
    photos: int = 40
    """How many visitors take a photo."""
    long_side: int = 240
    """Longer side of the photos, pixels."""


def run(command: Command) -> None:
    """Makes, trains, scores, writes the page."""
    if command.photos < 8 or command.long_side < 32 or command.steps < 1:
        raise UserError("the demo needs at least 8 photos of 32 pixels and 1 step")
    page = command.output / "report.html"
    if page.exists():
        raise UserError(f"{page} exists already; open it, or choose another --output")
    folder = command.output / "scene"
    if not (folder / "split.tsv").is_file():
        with counting("photographing the landmark") as progress:
            make_landmark(
                folder,
                SyntheticConfig(photos=command.photos, long_side=command.long_side),
                progress=progress,
            )
    runs = []
    for method in ("wildgs", "3dgs"):
        config = RunConfig(folder.resolve(), model=MODEL, train=_training(command.steps)).with_method(method)
        scene = read_scene(config)
        target = command.output / method
        train_or_go_on(target, config, scene)
        loaded = load_run(target)
        scores: Scores = {
            "full": evaluate_run(loaded, scene, "full"),
            "half": evaluate_run(loaded, scene, "half"),
        }
        runs.append((method_type(method).label, loaded, scores))
    print_scores({name: scores for name, _, scores in runs})
    write_showcase(page, "Wild-GS demo", SUMMARY.format(photos=command.photos), scene, runs)
    scene_page = command.output / "scene.html"
    write_scene_page(runs[0][1], scene_page, "Wild-GS demo")
    console.print(f"open {page.resolve()} in a browser: scores and comparisons")
    console.print(f"open {scene_page.resolve()} in a browser: the scene, to fly through in any light")


def _training(steps: int) -> TrainConfig:
    """The defaults, with no more Gaussians than photos this small can tell apart."""
    return TrainConfig(steps=steps, density=DensityConfig(max_gaussians=MAX_GAUSSIANS))
