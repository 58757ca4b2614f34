"""`wildgs run`: a folder of photos becomes a scored scene, in one command."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.eval import evaluate_run, print_scores
from wildgs.cli.progress import console, counting
from wildgs.cli.sfm import print_report, reconstruct_with_progress
from wildgs.cli.showcase import Scores, write_showcase
from wildgs.cli.training import read_scene, train_or_go_on
from wildgs.cli.webpage import write_scene_page
from wildgs.config import RunConfig
from wildgs.engine.density import DensityConfig
from wildgs.engine.trainer import TrainConfig
from wildgs.priors.depth import fill_depth_folder, load_depth_anything
from wildgs.runs import default_device, load_run
from wildgs.scene import DataConfig, Scene
from wildgs.scene.images import UnreadableImageError, open_image
from wildgs.sfm.reconstruction import SfmConfig

CPU_STEPS, GPU_STEPS = 3000, 30_000
CPU_LONG_SIDE, GPU_LONG_SIDE = 400, 1600
CPU_MAX_GAUSSIANS = 80_000


@dataclass(frozen=True)
class Command:
    """Poses, trains, scores and shows a folder of photos.

    Steps and size follow the machine unless given: 30,000 steps on photos of up to 1,600 pixels on a GPU, 3,000
    steps on photos of up to 400 pixels on a CPU.

    Example: wildgs run photos/sacre_coeur --output runs/sacre_coeur
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    output: Path
    """Run folder; the posed scene goes to OUTPUT/scene."""
    steps: int | None = None
    """Training steps."""
    downscale: float | None = None
    """Divides the photos' width and height."""
    max_gaussians: int | None = None
    """Most Gaussians; follows the machine unless given."""
    holdout: int = 8
    """Every n-th photo is held out for scoring; 0 = none."""
    sfm: tyro.conf.OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)


def run(command: Command) -> None:
    """Runs every stage; a stage that is done already is not done again."""
    folder = command.output / "scene"
    if (folder / "sparse" / "0").is_dir():
        console.print(f"{folder} has poses already; going on with them")
    else:
        print_report(reconstruct_with_progress(command.photos, folder, command.sfm))
        estimate_depth(folder)
    config, scene = _configure(command, folder)
    train_or_go_on(command.output, config, scene)
    loaded = load_run(command.output)
    scores: Scores = {}
    if scene.test_views:
        scores = {"full": evaluate_run(loaded, scene, "full"), "half": evaluate_run(loaded, scene, "half")}
        print_scores({str(command.output): scores})
    page = command.output / "report.html"
    summary = f"{len(scene.views)} photos from {command.photos.name}, {loaded.step} steps of Wild-GS."
    title = command.photos.resolve().name
    write_showcase(page, title, summary, scene, [("Wild-GS", loaded, scores)])
    scene_page = command.output / "scene.html"
    write_scene_page(loaded, scene_page, title)
    console.print(f"open {page.resolve()} in a browser: scores and comparisons")
    console.print(f"open {scene_page.resolve()} in a browser: the scene, to fly through in any light")


def estimate_depth(folder: Path) -> None:
    """Fills the scene's depth folder where Depth Anything can be had; warns and goes on where not."""
    estimator = load_depth_anything()
    if estimator is not None:
        with counting("estimating depth") as progress:
            fill_depth_folder(folder, estimator, progress=progress)


def _configure(command: Command, folder: Path) -> tuple[RunConfig, Scene]:
    """Steps and size that suit the machine; reads the scene at that size."""
    gpu = default_device().type == "cuda"
    steps = command.steps or (GPU_STEPS if gpu else CPU_STEPS)
    downscale = command.downscale or _downscale_for(folder, GPU_LONG_SIDE if gpu else CPU_LONG_SIDE)
    data = DataConfig(downscale=downscale, holdout=command.holdout)
    most = command.max_gaussians or (DensityConfig().max_gaussians if gpu else CPU_MAX_GAUSSIANS)
    budget = DensityConfig(max_gaussians=most)
    train = TrainConfig(steps=steps, density=budget)
    config = RunConfig(folder.resolve(), data=data, train=train)
    return config, read_scene(config)


def _downscale_for(folder: Path, long_side: int) -> float:
    """The factor that brings the largest photo to `long_side` pixels; 1 where it is smaller."""
    sizes = [1]
    for path in sorted((folder / "images").rglob("*")):
        if path.is_file():
            with contextlib.suppress(UnreadableImageError), open_image(path) as image:
                sizes.append(max(image.size))
    return max(1.0, round(max(sizes) / long_side, 2))
