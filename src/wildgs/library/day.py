"""The course of a day: orders the photos of a run, and makes a timeline of their lights at an even pace."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.errors import UserError
from wildgs.evaluation.photos import find_misfits, read_photos
from wildgs.files import is_file, read_json, written_aside
from wildgs.geometry.camera import Camera
from wildgs.library.loaded import LoadedScene
from wildgs.light.day import LEAST_PHOTOS, Day, Pattern, pattern_of, plan_day, visible_rows
from wildgs.light.look import Timeline
from wildgs.light.photos import MAX_PHOTOS
from wildgs.light.shadows import SIDE, SunFinder
from wildgs.light.sun import phases_of
from wildgs.progress import Progress, counter
from wildgs.scene import View
from wildgs.scene.capture import Capture, read_capture
from wildgs.scene.colmap import find_model
from wildgs.scene.photo_store import with_ending
from wildgs.scene.start import choose_start
from wildgs.threads import infer_each

DAY_FILE = "day.json"
"""Caches the day in the run folder; valid for one checkpoint and one `DAY_VERSION`."""

DAY_VERSION = 2
"""To be raised with every change that orders the photos of a run differently."""

_SAMPLES = 4
"""Images between two key frames from which the pace is measured."""

_SIDE = 160


@torch.no_grad()
def find_day(loaded: LoadedScene, photos: Path | None = None, *, progress: Progress | None = None) -> Day:
    """Orders the photos of a run by the time of day; the result is cached in the run folder.

    Misfits (`LoadedScene.misfits`) are left out.

    Args:
        loaded: The run.
        photos: Folder of the original photos with EXIF times; None takes the scene folder of the run.
        progress: Called for every photo.

    Raises:
        UserError: The run cannot be relit or has too few photos, or the folder `photos` does not exist.
    """
    captures = read_captures(loaded, photos)
    kept, timed = loaded.run.folder / DAY_FILE, _digest(captures)
    found = None if photos is not None else _read(kept, loaded, timed)
    if found is not None:
        return found
    views = _usable_views(loaded)
    if len(views) < LEAST_PHOTOS:
        raise UserError(
            f"{loaded.run.folder}: --over day needs a run that can be relit, with at least {LEAST_PHOTOS} photos"
        )
    lights = _lights(loaded, views, progress)
    day = plan_day(lights.patterns, phases_of(captures), _find_suns(loaded, views, lights))
    assert day is not None  # there are enough photos
    try:
        with written_aside(kept) as aside:
            content = {"version": DAY_VERSION, "step": loaded.run.step, "timed": timed, **asdict(day)}
            aside.write_text(json.dumps(content, indent=1), encoding="utf-8")
    except UserError:  # a run on a read-only disk works without the cache
        pass
    return day


def _usable_views(loaded: LoadedScene) -> list[View]:
    if not loaded.relightable:
        return []
    misfits = {fit.name for fit in find_misfits(read_photos(loaded.run.folder, loaded.run.step) or [])}
    views = [view for view in loaded.scene.train_views if view.name not in misfits]
    count = min(len(views), MAX_PHOTOS)
    return [views[index * len(views) // count] for index in range(count)]


@dataclass(frozen=True)
class _Lights:
    """The lights of some photos: their patterns and masks, and the mean harmonics of all Gaussians."""

    patterns: dict[str, Pattern]
    masks: list[Tensor | None]
    rows: Tensor
    mean: Tensor


def _lights(loaded: LoadedScene, views: list[View], progress: Progress | None) -> _Lights:
    method, show = loaded.run.method, counter(progress, "comparing the light of photos")
    rows = visible_rows(method, viewpoints_of(views))
    mean, patterns, masks = torch.zeros((), device=rows.device), {}, []

    def describe(view: View) -> tuple[Tensor, Tensor | None]:
        appearance = loaded.encode(view)
        mask = appearance.visibility
        return method.shade(appearance), None if mask is None else _small(mask)

    found = infer_each(describe, views, rows.device)
    for number, (view, (sh, mask)) in enumerate(zip(views, found, strict=True), start=1):
        mean = mean + sh / len(views)
        patterns[view.name] = pattern_of(sh[rows])
        masks.append(mask)
        show(number, len(views))
    return _Lights(patterns, masks, rows, mean)


def _find_suns(loaded: LoadedScene, views: list[View], lights: _Lights) -> Float[np.ndarray, "P 3"]:
    method = loaded.run.method
    finder = SunFinder(method.gaussians, method.sky(), lights.rows, lights.mean)

    def find(seen: tuple[View, Tensor | None]) -> Tensor:
        view, mask = seen
        photo, keep = view.load(lights.rows.device)
        return finder.direction(photo, view.camera, (keep, mask))

    suns = infer_each(find, list(zip(views, lights.masks, strict=True)), lights.rows.device)
    return torch.stack(list(suns)).double().cpu().numpy()


def _digest(captures: dict[str, Capture]) -> str:
    return hashlib.sha256(repr(sorted(captures.items())).encode()).hexdigest()[:16]


def _read(file: Path, loaded: LoadedScene, timed: str | None = None) -> Day | None:
    """Reads the cached day; None if it is damaged or outdated.

    It is outdated if it is of another version or checkpoint, or made with other times than `timed`.
    """
    try:
        content = read_json(file)
        version, found_step, found_timed = (content.pop(entry) for entry in ("version", "step", "timed"))
        if version != DAY_VERSION or found_step != loaded.run.step or timed not in (None, found_timed):
            return None
        lists = {entry: tuple(content[entry]) for entry in ("keys", "untimed")}
        day = Day(**content | lists | {"left_out": {**content["left_out"]}})
        known = set(day.keys) <= set(day.phases) <= {view.name for view in loaded.views}
        return day if day.keys and known and all(map(math.isfinite, day.phases.values())) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def viewpoints_of(views: Sequence[View]) -> torch.Tensor:
    """Camera centres of the views, or an even selection of about 64."""
    chosen = views[:: max(1, -(-len(views) // 64))]
    return torch.stack([view.camera.position for view in chosen]) if chosen else torch.zeros(0, 3)


def has_day(loaded: LoadedScene) -> bool:
    """Whether a run can be relit and has enough photos for `find_day`."""
    return len(_usable_views(loaded)) >= LEAST_PHOTOS


def known_day(loaded: LoadedScene) -> Day | None:
    """The cached day of a run, if there is one."""
    return _read(loaded.run.folder / DAY_FILE, loaded)


def in_order_of_day(loaded: LoadedScene, names: Sequence[str]) -> bool:
    """Whether these are at least two photos in the order of the run's cached day."""
    day = known_day(loaded)
    phases = [day.phases[name] for name in names if name in day.phases] if day else []
    return len(phases) == len(names) > 1 and phases == sorted(phases)


def day_timeline(
    loaded: LoadedScene, day: Day, camera: Camera | None = None, *, progress: Progress | None = None
) -> Timeline:
    """A timeline through the lights of a day, paced so that the rendered image changes evenly.

    Args:
        loaded: The run.
        day: From `find_day`.
        camera: Camera for measuring the changes; None takes that of `wildgs.scene.start.choose_start`.
        progress: Called for every rendered image.
    """
    looks = tuple(loaded.appearance(name) for name in day.keys)
    timeline = Timeline(looks)
    camera = camera or choose_start(loaded.scene)[0].camera
    shrink = min(1.0, _SIDE / max(camera.width, camera.height))
    camera = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
    count, show = _SAMPLES * (len(looks) - 1) + 1, counter(progress, "pacing the day")
    pictures = []
    for number in range(count):
        pictures.append(loaded.render(camera, timeline.at(number / max(count - 1, 1))).float())
        show(number + 1, count)
    changes = [float((one - other).abs().mean()) for one, other in pairwise(pictures)]
    return timeline.paced(changes)


def _small(mask: Float[Tensor, "H W"]) -> Float[Tensor, "h w"]:
    """Every n-th pixel, since the masks of all photos are in memory at once."""
    step = max(1, max(mask.shape) // SIDE)
    return mask[::step, ::step].clone()


def read_captures(loaded: LoadedScene, photos: Path | None = None) -> dict[str, Capture]:
    """Reads time and place of all photos that have EXIF data.

    Args:
        loaded: The run.
        photos: Folder of the original photos, whose extensions may differ from those of the scene. None looks in
            the run's scene folder (undistorted photos of `wildgs sfm` keep EXIF time and place) and at the copies
            in the run folder.

    Raises:
        UserError: The folder `photos` does not exist.
    """
    originals = None if photos is None else _by_stem(photos)
    folder = photos or _scene_photos(loaded)
    found = {}
    for view in loaded.views:
        files = [folder and folder / view.name]
        if originals is None:
            files.append(view.photos.file(view.name))
        else:
            files.append(originals.get(with_ending(view.name, "")))
        captures = (read_capture(file) for file in files if file is not None and is_file(file))
        found[view.name] = next((capture for capture in captures if capture is not None), None)
    return {name: capture for name, capture in found.items() if capture is not None}


def _by_stem(photos: Path) -> dict[str, Path]:
    """The files of a folder by relative path without extension."""
    if not photos.is_dir():
        raise UserError(f"{photos}: no such folder; give the folder of the original photos")
    return {
        with_ending(path.relative_to(photos).as_posix(), ""): path
        for path in sorted(photos.rglob("*"))
        if is_file(path)
    }


def _scene_photos(loaded: LoadedScene) -> Path | None:
    try:
        return find_model(Path(loaded.run.config.scene))[1]
    except Exception:  # a run works without its scene folder
        return None


def read_times(loaded: LoadedScene) -> dict[str, str]:
    """Local capture times in ISO 8601, by photo name."""
    return {name: capture.local.isoformat() for name, capture in read_captures(loaded).items()}
