"""`wildgs.evaluate`: scores of a run on the photos that were held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wildgs.errors import UserError
from wildgs.evaluation.protocol import Protocol
from wildgs.evaluation.protocol import evaluate as score_views
from wildgs.library.loaded import LoadedScene
from wildgs.progress import Progress, counter
from wildgs.runs import Run, load_run
from wildgs.scene import Scene

PROTOCOLS: tuple[Protocol, ...] = ("full", "half")

Scores = dict[Protocol, dict[str, Any]]
"""By protocol, what its `metrics.json` holds."""


def evaluate(
    run: str | Path | Run | LoadedScene,
    protocols: Sequence[Protocol] = PROTOCOLS,
    *,
    scene: str | Path | Scene | None = None,
    lpips: str | Path | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Scores a run's held-out views and writes pictures and `metrics.json` to RUN/eval/.

    Args:
        run: A run folder, or a run loaded from one.
        protocols: `full` takes a view's light from the whole photo and scores the whole frame; `half` takes it from
            the left half and scores the right one.
        scene: The scene folder, where it moved since training, or the scene read from it.
        lpips: Folder with other LPIPS weights (AlexNet's, say) than the package's SqueezeNet.
        progress: Called for every photo read and every view scored.

    Raises:
        UserError: There is no such run or folder, the photos are gone, or none is held out.
    """
    check_lpips(lpips)
    loaded = opened(run)
    if not isinstance(scene, Scene):
        scene = read_run_scene(loaded, scene, progress)
    scores: Scores = {}
    scored = "full" in protocols and scene.test_views
    photos = LoadedScene(loaded).photo_fits(scene=scene, progress=progress) if scored else []
    for protocol in protocols:
        count = _ViewCounter(progress, f"scoring {loaded.config.method}, protocol {protocol}", scene)
        scores[protocol] = score_views(
            loaded.method,
            scene,
            protocol,
            loaded.folder,
            step=loaded.step,
            train_seconds=loaded.train_seconds,
            lpips_folder=None if lpips is None else Path(lpips),
            mask_threshold=loaded.method.mask_threshold,
            photos=photos,
            on_view=count,
        )
    return scores


def check_lpips(folder: str | Path | None) -> None:
    """Raises `UserError` if a folder of LPIPS weights was asked for and is not there."""
    if folder is not None and not Path(folder).is_dir():
        raise UserError(f"--lpips {folder}: no such folder; leave it out for the weights of the package")


def read_run_scene(run: Run, root: str | Path | None = None, progress: Progress | None = None) -> Scene:
    """The scene on which a run was trained, with its photos at full size.

    Args:
        run: The run.
        root: The scene folder, where it is not where it was.
        progress: Called for every photo read.

    Raises:
        UserError: The scene cannot be read, or is another one.
    """
    return run.read_scene(None if root is None else Path(root), counter(progress, "reading photos"))


def opened(run: str | Path | Run | LoadedScene) -> Run:
    """The run that a user means by a folder or a loaded scene."""
    if isinstance(run, LoadedScene):
        return run.run
    return run if isinstance(run, Run) else load_run(Path(run))


class _ViewCounter:
    """Counts views that are named one by one."""

    def __init__(self, progress: Progress | None, stage: str, scene: Scene) -> None:
        self._show, self._total, self._done = counter(progress, stage), len(scene.test_views), 0

    def __call__(self, _: str) -> None:
        self._done += 1
        self._show(self._done, self._total)
