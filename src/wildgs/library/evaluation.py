"""`wildgs.evaluate`: scores a run on its held-out photos."""

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
"""The content of `metrics.json` of each protocol."""


def evaluate(
    run: str | Path | Run | LoadedScene,
    protocols: str | Sequence[str] = PROTOCOLS,
    *,
    scene: str | Path | Scene | None = None,
    lpips: str | Path | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Scores a run on its held-out photos and writes images and `metrics.json` to RUN/eval/.

    Args:
        run: A run folder, or a loaded run or scene.
        protocols: `full` embeds the whole photo and scores the whole image; `half` embeds the left half of the
            photo and scores the right half.
        scene: The scene, or its folder if it has moved since training.
        lpips: Folder with other LPIPS weights, for example AlexNet's, than the package's SqueezeNet.
        progress: Called for every photo read and every view scored.

    Raises:
        UserError: The run, a folder or a protocol does not exist, the scene's photos are missing, or none is held
            out.
    """
    check_lpips(lpips)
    chosen = _known_protocols(protocols)
    loaded = open_run(run)
    if not isinstance(scene, Scene):
        scene = read_run_scene(loaded, scene, progress)
    scores: Scores = {}
    scored = "full" in chosen and scene.test_views
    photos = LoadedScene(loaded).photo_fits(scene=scene, progress=progress) if scored else []
    for protocol in chosen:
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


def _known_protocols(protocols: str | Sequence[str]) -> Sequence[Protocol]:
    given = [protocols] if isinstance(protocols, str) else protocols
    for name in given:
        if name not in PROTOCOLS:
            raise UserError(f"unknown protocol {name!r}; choose {' or '.join(PROTOCOLS)}")
    return [protocol for protocol in PROTOCOLS if protocol in given]


def check_lpips(folder: str | Path | None) -> None:
    """Raises `UserError` if the folder of LPIPS weights does not exist."""
    if folder is not None and not Path(folder).is_dir():
        raise UserError(f"--lpips {folder}: no such folder; leave it out to use the package's weights")


def read_run_scene(run: Run, root: str | Path | None = None, progress: Progress | None = None) -> Scene:
    """Reads the scene on which a run was trained, with its photos at the size used in training.

    Args:
        run: The run.
        root: The scene folder, if it has moved.
        progress: Called for every photo read.

    Raises:
        UserError: The scene cannot be read, or is not that of the run.
    """
    return run.read_scene(None if root is None else Path(root), counter(progress, "reading photos"))


def open_run(run: str | Path | Run | LoadedScene) -> Run:
    """The run itself, that of a loaded scene, or that loaded from a folder."""
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
