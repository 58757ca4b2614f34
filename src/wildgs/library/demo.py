"""`wildgs.demo`: the built-in landmark, from its photos to a page to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wildgs.config import ExecutionConfig, RunConfig
from wildgs.engine.config import DensityConfig, TrainConfig
from wildgs.engine.trainer import Observer
from wildgs.errors import UserError
from wildgs.library.evaluation import evaluate
from wildgs.library.pipeline import FinishedRun
from wildgs.library.showcase import write_showcase
from wildgs.library.training import read_scene, train
from wildgs.library.webpage import write_scene_page
from wildgs.model.config import ParsingConfig, WildGSConfig
from wildgs.model.registry import MethodName, method_type
from wildgs.progress import Progress
from wildgs.runs import load_run, lock_run
from wildgs.scene.demo import write_demo_scene

COMPARED: tuple[MethodName, ...] = ("wildgs", "3dgs")
TITLE = "Wild-GS demo"
SUMMARY = (
    "A made-up landmark in {photos} rendered photos: different hours and cameras, and people in the way. Wild-GS "
    "and plain 3D Gaussian Splatting were trained on them for {steps:,} steps each. Both are scored on held-out "
    "photos, against the same views without the people."
)
PARSED_SIDE = 160
MAX_GAUSSIANS = 30_000
"""As many Gaussians as photos of this size can resolve."""


def demo(
    output: str | Path = "wildgs-demo",
    *,
    steps: int = 1500,
    execution: ExecutionConfig | None = None,
    progress: Progress | None = None,
    observers: Sequence[Observer] = (),
) -> FinishedRun:
    """Trains Wild-GS and plain 3DGS on the photos of the built-in landmark, scores both and writes pages.

    Args:
        output: Folder for the scene, both runs, report.html and scene.html.
        steps: Training steps of each method.
        execution: How it is executed.
        progress: Called during all stages.
        observers: Called with a `StepReport` after every training step.

    Raises:
        UserError: The pages exist already, or the folder cannot be written to.
    """
    output = Path(output)
    report, page = output / "report.html", output / "scene.html"
    if steps < 1:
        raise UserError(f"steps {steps}: must be 1 or more")
    if report.exists():
        raise UserError(f"{report} exists already; open it, or choose another --output")
    with lock_run(output):
        folder = write_demo_scene(output / "scene")
        runs = []
        for method in COMPARED:
            config = _configuration(folder, method, steps)
            scene = read_scene(config, execution or ExecutionConfig(), progress)
            target = output / method
            train(
                scene,
                config,
                output=target,
                execution=execution,
                resume="auto",
                progress=progress,
                observers=observers,
            )
            loaded = load_run(target)
            runs.append((method_type(method).label, loaded, evaluate(loaded, scene=scene, progress=progress)))
        write_showcase(report, TITLE, SUMMARY.format(photos=len(scene.views), steps=steps), scene, runs)
        write_scene_page(runs[0][1], page, TITLE, progress)
    return FinishedRun(output, {name: scores for name, _, scores in runs}, report, page)


def _configuration(folder: Path, method: MethodName, steps: int) -> RunConfig:
    train = TrainConfig(steps=steps, density=DensityConfig(max_gaussians=MAX_GAUSSIANS))
    model = WildGSConfig(parsing=ParsingConfig(max_side=PARSED_SIDE))
    return RunConfig(folder.resolve(), model=model, train=train).with_method(method)
