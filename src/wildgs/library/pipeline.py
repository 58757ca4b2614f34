"""`wildgs.run` (a folder of photos), `wildgs.demo` (the built-in photos) and `wildgs.estimate_depth`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from wildgs.config import ExecutionConfig, RunConfig, with_entries
from wildgs.config_file import CONFIG_FILE, read_config
from wildgs.engine.config import DensityConfig, TrainConfig
from wildgs.engine.report import Observer
from wildgs.errors import UserError
from wildgs.library.collection import (
    changed_options,
    compare_collection,
    record_collection,
)
from wildgs.library.evaluation import Scores, evaluate
from wildgs.library.loaded import LoadedScene
from wildgs.library.logs import logger
from wildgs.library.pages import write_scene_page, write_showcase
from wildgs.library.side_training import training_beside
from wildgs.library.training import read_scene, train
from wildgs.model.config import ParsingConfig, WildGSConfig
from wildgs.model.registry import MethodName, method_type
from wildgs.priors.config import StereoConfig
from wildgs.priors.depth import DEPTH_ANYTHING, fill_depth_folder, load_depth_anything
from wildgs.priors.stereo.depth import fill_metric_folder
from wildgs.progress import Progress, counter, silent
from wildgs.runs import default_device, load_run, lock_run
from wildgs.scene import Scene
from wildgs.scene.config import DataConfig
from wildgs.scene.demo import write_demo_scene
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.reconstruction import check_photos, reconstruct

CPU_STEPS, GPU_STEPS = 3000, 30_000
CPU_LONG_SIDE, GPU_LONG_SIDE = 400, 1600
CPU_MAX_GAUSSIANS = 80_000


@dataclass(frozen=True)
class FinishedRun:
    """Results of `run` and `demo`.

    Attributes:
        folder: The run folder, or the demo's folder.
        scores: Scores by the name of the run; empty if no photo is held out.
        report: The web page with scores and comparisons.
        page: The web page with the 3D scene.
    """

    folder: Path
    scores: dict[str, Scores]
    report: Path
    page: Path


def run(
    photos: str | Path,
    output: str | Path,
    *,
    steps: int | None = None,
    max_side: int | None = None,
    downscale: float | None = None,
    max_gaussians: int | None = None,
    holdout: int | None = None,
    sfm: SfmConfig | None = None,
    execution: ExecutionConfig | None = None,
    progress: Progress | None = None,
    observers: Sequence[Observer] = (),
) -> FinishedRun:
    """Estimates camera poses for a folder of photos, trains, scores and writes web pages; skips finished stages.

    When a run is continued, options that are None keep the run's values.

    Args:
        photos: Folder of photos.
        output: Run folder; the scene with camera poses is written to OUTPUT/scene.
        steps: Training steps. Default: 30,000 on a GPU, 3,000 on a CPU.
        max_side: Longest side of a photo in pixels; larger photos are reduced to it. Default: 1,600 on a GPU and
            400 on a CPU, or no limit if `downscale` is given.
        downscale: Factor by which the photos' width and height are divided, before `max_side`.
        max_gaussians: Upper bound on the number of Gaussians. Default: depends on the machine's memory.
        holdout: Hold out every n-th photo for scoring; 0 = none. Default: 8.
        sfm: Options of structure from motion.
        execution: How training is executed.
        progress: Called during all stages.
        observers: Called with a `StepReport` after every training step.

    Raises:
        UserError: The photos cannot be used, OUTPUT was made from other photos, or another process uses OUTPUT.
    """
    photos, output, progress = Path(photos), Path(output), progress or silent
    check_photos(photos, output)  # before anything is written
    with lock_run(output):
        scene_folder = output / "scene"
        _estimate_poses(photos, scene_folder, sfm, progress)
        if not (output / CONFIG_FILE).is_file():
            given = DataConfig().holdout if holdout is None else holdout
            estimate_depth(scene_folder, by="stereo", holdout=given, progress=progress)
            _estimate_depth_if_possible(scene_folder, progress)
        size = _photo_size(output, max_side, downscale)
        config = _configure(scene_folder, output / CONFIG_FILE, steps, size, max_gaussians, holdout)
        scene = read_scene(config, execution or ExecutionConfig(), progress)
        trained = train(
            scene,
            config,
            output=output,
            execution=execution,
            resume="auto",
            progress=progress,
            observers=observers,
            locked=True,
        )
        loaded = LoadedScene(load_run(output), trained.appearances)
        scores = evaluate(loaded, scene=scene, progress=progress) if scene.test_views else {}
        title = output.resolve().name
        report, page = output / "report.html", output / "scene.html"
        summary = f"{len(scene.views)} photos from {photos.resolve().name}, {trained.steps} steps of Wild-GS."
        write_showcase(report, title, summary, scene, [("Wild-GS", loaded, scores)])
        write_scene_page(loaded, page, title, progress)
    return FinishedRun(output, {str(output): scores} if scores else {}, report, page)


def _estimate_poses(photos: Path, scene: Path, sfm: SfmConfig | None, progress: Progress) -> None:
    """Runs structure from motion, or checks that existing poses were computed from these photos.

    Raises:
        UserError: They were computed from other photos or with other options.
    """
    if not (scene / "sparse" / "0").is_dir():
        report = reconstruct(photos, scene, sfm, progress=progress)
        record_collection(photos, scene, sfm or SfmConfig())
        for line in report.lines():
            logger.info("%s", line)
        return
    changes = compare_collection(photos, scene)
    if changes:
        inside = photos.resolve().is_relative_to(scene.parent.resolve())
        again = "" if inside else f", or delete {scene.parent} to start again with these photos"
        raise UserError(
            f"{photos} has changed since {scene} was made: {changes}; choose another --output{again}"
        )
    if options := changed_options(scene, sfm or SfmConfig()):
        raise UserError(
            f"the poses in {scene} were computed with other options ({options}); leave them out, or choose another "
            "--output"
        )
    logger.info("using the existing poses in %s", scene)


@dataclass(frozen=True)
class EstimatedDepth:
    """Results of `estimate_depth`.

    Attributes:
        folder: SCENE/depth.
        written: Number of depth maps written.
        kept: Number of depth maps that existed already.
    """

    folder: Path
    written: int
    kept: int


def estimate_depth(
    scene: str | Path,
    *,
    by: Literal["network", "stereo"] = "network",
    model: str = DEPTH_ANYTHING,
    stereo: StereoConfig | None = None,
    holdout: int = DataConfig().holdout,
    overwrite: bool = False,
    device: str | None = None,
    progress: Progress | None = None,
) -> EstimatedDepth:
    """Estimates depth maps for the photos of a scene and writes them to SCENE/depth/.

    Args:
        scene: Folder of a COLMAP scene.
        by: 'network': disparity of every photo by Depth Anything V2, as 16-bit PNGs. 'stereo': metric depth of the
            training photos by multi-view stereo, as 32-bit floats in units of the COLMAP model.
        model: Name of the network on the Hugging Face hub, or its folder in the hub's layout.
        stereo: Options of stereo.
        holdout: For stereo: skip every n-th photo if the scene has no .tsv split.
        overwrite: Replace existing depth maps.
        device: Device of the network, `cpu` or `cuda`. Default: CUDA if available.
        progress: Called for every photo.

    Raises:
        UserError: The scene does not exist, or the network is not available.
    """
    scene = Path(scene)
    if not scene.is_dir():
        raise UserError(f"{scene}: no such folder; give the folder of a COLMAP scene")
    if by == "stereo":
        show = counter(progress, "multi-view stereo")
        written, kept = fill_metric_folder(
            scene, stereo or StereoConfig(), holdout=holdout, overwrite=overwrite, progress=show
        )
        return EstimatedDepth(scene / "depth", written, kept)
    estimator = load_depth_anything(model, device=device, required=True)
    assert estimator is not None  # `required` raises otherwise
    show = counter(progress, "estimating depth")
    written, kept = fill_depth_folder(scene, estimator, overwrite=overwrite, progress=show)
    return EstimatedDepth(scene / "depth", written, kept)


def _estimate_depth_if_possible(scene: Path, progress: Progress) -> None:
    """Writes missing depth maps by the network; warns if it is not available."""
    estimator = load_depth_anything()
    if estimator is not None:
        fill_depth_folder(scene, estimator, progress=counter(progress, "estimating depth"))


def _configure(
    scene: Path,
    file: Path,
    steps: int | None,
    size: DataConfig,
    max_gaussians: int | None,
    holdout: int | None,
) -> RunConfig:
    """The configuration of an existing run, or the machine's default, with the given options."""
    if file.is_file():
        config = read_config(file)
    else:
        gpu = default_device().type == "cuda"
        density = DensityConfig(max_gaussians=DensityConfig().max_gaussians if gpu else CPU_MAX_GAUSSIANS)
        config = RunConfig(scene, train=TrainConfig(steps=GPU_STEPS if gpu else CPU_STEPS, density=density))
    given = {
        "train.steps": steps,
        "train.density.max_gaussians": max_gaussians,
        "data.holdout": holdout,
    }
    config = with_entries(config, {name: value for name, value in given.items() if value is not None})
    data = replace(config.data, downscale=size.downscale, max_side=size.max_side)
    return replace(config, scene=scene.resolve(), data=data)


def _photo_size(output: Path, max_side: int | None, downscale: float | None) -> DataConfig:
    """The size of photos: as given, as in an existing run, or the machine's default."""
    if max_side is None and downscale is None:
        if (output / CONFIG_FILE).is_file():
            return read_config(output / CONFIG_FILE).data
        max_side = GPU_LONG_SIDE if default_device().type == "cuda" else CPU_LONG_SIDE
    return DataConfig(downscale=downscale or 1, max_side=max_side)


COMPARED: tuple[MethodName, ...] = ("wildgs", "3dgs")
TITLE = "Wild-GS demo"
SUMMARY = (
    "An artificial landmark in {photos} rendered photos with different times of day, cameras and passers-by. "
    "Wild-GS and plain 3D Gaussian Splatting were trained on them for {steps:,} steps each. Both are scored on "
    "held-out photos, against the same views without passers-by."
)
PARSED_SIDE = 160
MAX_GAUSSIANS = 30_000
"""Sufficient for the resolution of the demo's photos."""


def demo(
    output: str | Path = "wildgs-demo",
    *,
    steps: int = 1500,
    execution: ExecutionConfig | None = None,
    progress: Progress | None = None,
    observers: Sequence[Observer] = (),
) -> FinishedRun:
    """Trains Wild-GS and plain 3DGS on photos of the built-in landmark, scores both and writes web pages.

    Args:
        output: Folder for the scene, both runs, report.html and scene.html.
        steps: Training steps of each method.
        execution: How training is executed.
        progress: Called during all stages.
        observers: Called with a `StepReport` after every training step in this process. On a CPU with several
            threads, 3DGS is trained in another process at the same time.

    Raises:
        UserError: The pages already exist, or the folder cannot be written to.
    """
    output = Path(output)
    report, page = output / "report.html", output / "scene.html"
    if steps < 1:
        raise UserError(f"steps {steps}: must be 1 or more")
    if report.exists():
        raise UserError(f"{report} already exists; open it, or choose another --output")
    execution = execution or ExecutionConfig()
    with lock_run(output):
        folder = write_demo_scene(output / "scene")
        first, second = (_configuration(folder, method, steps) for method in COMPARED)
        runs = []
        # First of all, since the other process compiles kernels while this one reads photos.
        with training_beside(second, output / second.method, execution) as (give_threads, beside):
            scene = read_scene(first, execution, progress)
            own = replace(execution, threads=None) if beside else execution
            runs.append(_train_and_score(first, scene, output, own, progress, [*observers, give_threads]))
            if beside is not None and beside.poll() is None:
                logger.info(f"waiting for the training of {second.method}")
                beside.wait()
            give_threads(None)
            runs.append(_train_and_score(second, scene, output, own, progress, observers))
            write_showcase(report, TITLE, SUMMARY.format(photos=len(scene.views), steps=steps), scene, runs)
            write_scene_page(runs[0][1], page, TITLE, progress)
    return FinishedRun(output, {name: scores for name, _, scores in runs}, report, page)


def _train_and_score(
    config: RunConfig,
    scene: Scene,
    output: Path,
    execution: ExecutionConfig,
    progress: Progress | None,
    observers: Sequence[Observer],
) -> tuple[str, LoadedScene, Scores]:
    """Trains, or continues, a run of the demo; returns its label, the run and its scores."""
    folder = output / config.method
    trained = train(
        scene,
        config,
        output=folder,
        execution=execution,
        resume="auto",
        progress=progress,
        observers=observers,
    )
    loaded = LoadedScene(load_run(folder), trained.appearances)
    return method_type(config.method).label, loaded, evaluate(loaded, scene=scene, progress=progress)


def _configuration(folder: Path, method: MethodName, steps: int) -> RunConfig:
    train = TrainConfig(steps=steps, density=DensityConfig(max_gaussians=MAX_GAUSSIANS))
    model = WildGSConfig(parsing=ParsingConfig(max_side=PARSED_SIDE))
    return RunConfig(folder.resolve(), model=model, train=train).with_method(method)
