"""How well training photos fit a trained run: what their masks hide, and which photos fit no light."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.errors import UserError
from wildgs.evaluation.metrics import MAX_PSNR
from wildgs.evaluation.pictures import write_json
from wildgs.model.method import Method
from wildgs.rasterize import blend
from wildgs.scene.scene import Scene, View, observed_pixels

PHOTOS_FILE = "photos.json"
"""In the run folder: what `inspect_photos` found."""
HIDDEN = 0.5
"""Pixels with a visibility M below it are hidden."""
COMPARED_SIDE = 160
"""Renders are compared with photos at this long side, at most, in pixels."""
LEAST_SHOWN = 0.01
"""Photos of which the mask leaves less than this share are not compared."""
DEVIATIONS = 3.5
"""A photo fits no light if it is so many robust standard deviations worse than the collection's median."""
LEAST_DEVIATION = {"psnr": 1.0, "hidden": 0.05}
"""Smaller deviations count as this: dB, and share of the photo. In an even collection little would stand out."""
MOSTLY = 0.5
"""A mask that hides less of a photo than this share is no reason to name the photo."""
LEAST_PHOTOS = 8
"""Fewer photos have no usual fit from which one could differ."""


@dataclass(frozen=True)
class PhotoFit:
    """How well one training photo fits the run; None for what could not be computed.

    Attributes:
        name: Of the photo.
        psnr: Of the render under the photo's own appearance, over pixels that the mask does not hide, dB.
        hidden: Share of pixels with M < `HIDDEN`.
        static_hidden: Share of static observations with M < `HIDDEN`: projections of points that three photos or
            more triangulated, which are no passers-by.
        observations: Number of these observations.
    """

    name: str
    psnr: float | None
    hidden: float | None
    static_hidden: float | None
    observations: int


@contextmanager
def inference(method: Method) -> Iterator[None]:
    """Evaluation mode without gradients for the time of a block."""
    # Not inference_mode: tensors that a method caches must stay usable in training.
    training = method.training
    method.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        method.train(training)


def inspect_photos(
    method: Method, scene: Scene, on_photo: Callable[[int, int], None] | None = None
) -> list[PhotoFit]:
    """Renders every training photo under its own appearance, small, and looks at its mask.

    Args:
        method: A trained method.
        scene: The scene on which it was trained.
        on_photo: Called with (photos inspected, photos in all).

    Returns:
        One entry per training photo that can be read; none for a method that has one light only.
    """
    if not method.relightable:
        return []
    observed, views, found = observed_pixels(scene), scene.train_views, []
    with inference(method):
        for count, view in enumerate(views, start=1):
            try:
                found.append(_inspect(method, view, observed.get(view.name)))
            except UserError:  # the photo is gone since training; the others are as good
                continue
            if on_photo is not None:
                on_photo(count, len(views))
    return found


def _inspect(method: Method, view: View, observed: Float[Tensor, "K 2"] | None) -> PhotoFit:
    device = method.gaussians.means.device
    photo, keep = view.load(device)
    appearance = method.encode(photo, view.camera.to(device), keep, name=view.name)
    visibility = appearance.visibility
    static_hidden, count = None, 0 if observed is None else len(observed)
    if visibility is not None and observed is not None and count:
        x, y = observed.to(device).long().unbind(1)
        static_hidden = float((visibility[y, x] < HIDDEN).float().mean())
    shown = torch.ones_like(photo[..., 0]) if visibility is None else (visibility >= HIDDEN).float()
    hidden = None if visibility is None else float(1 - shown.mean())
    if keep is not None:
        shown = shown * keep
    shrink = min(1.0, COMPARED_SIDE / max(view.camera.width, view.camera.height))
    width, height = (max(1, round(side * shrink)) for side in (view.camera.width, view.camera.height))
    pictures = torch.cat([photo, shown[..., None]], dim=2).permute(2, 0, 1)[None]
    small = functional.interpolate(pictures, (height, width), mode="bilinear", antialias=True)[0]
    projection = method.gaussians.project(view.camera.resized(width, height).to(device))
    colors = blend(projection, method.paint(projection, appearance, method.sh_degree)).colors
    error = (colors.nan_to_num().clamp(0, 1).permute(2, 0, 1) - small[:3]).square().mean(dim=0)
    weights, psnr = small[3], None
    if float(weights.mean()) >= LEAST_SHOWN:
        mean = (error * weights).sum() / weights.sum()
        psnr = min(float(-10 * mean.log10()), MAX_PSNR)
    return PhotoFit(view.name, psnr, hidden, static_hidden, count)


def find_misfits(photos: Sequence[PhotoFit]) -> list[PhotoFit]:
    """Photos that fit no light, worst first: prints, drawings, collages, other places, wrong poses.

    A photo is named if its PSNR lies `DEVIATIONS` robust standard deviations below the collection's median, or if
    its mask hides most of it and as many deviations more than usual. The deviation is that of a normal distribution
    with the same median absolute deviation, or with the same quartile on the bad side where that is more: a quarter
    of all photos, say those at night, is no misfit. Mean and standard deviation would follow what is looked for.
    """
    rated = [photo for photo in photos if photo.psnr is not None]
    if len(rated) < LEAST_PHOTOS:
        return []
    fit = _deviations([-photo.psnr for photo in rated if photo.psnr is not None], LEAST_DEVIATION["psnr"])
    by_fit = dict(zip((photo.name for photo in rated), fit, strict=True))
    masked = [photo for photo in photos if photo.hidden is not None]
    hiding = _deviations([photo.hidden or 0.0 for photo in masked], LEAST_DEVIATION["hidden"])
    by_mask = {
        photo.name: deviation
        for photo, deviation in zip(masked, hiding, strict=True)
        if (photo.hidden or 0.0) > MOSTLY
    }
    worst = {photo.name: max(by_fit.get(photo.name, 0.0), by_mask.get(photo.name, 0.0)) for photo in photos}
    named = [photo for photo in photos if worst[photo.name] > DEVIATIONS]
    return sorted(named, key=lambda photo: worst[photo.name], reverse=True)


def _deviations(values: Sequence[float], least: float) -> list[float]:
    """How many robust standard deviations each value lies above the median."""
    if not values:
        return []
    middle, quartile = (float(q) for q in np.quantile(values, (0.5, 0.75)))
    spread = statistics.median(abs(value - middle) for value in values)
    deviation = max(1.4826 * spread, 1.4826 * (quartile - middle), least)
    return [(value - middle) / deviation for value in values]


def describe_misfits(photos: Sequence[PhotoFit], most: int = 8) -> list[str]:
    """Lines for people: which photos fit no light, worst first, and how much of each was hidden."""
    named = find_misfits(photos)
    if not named:
        return []
    usual = statistics.median(photo.psnr for photo in photos if photo.psnr is not None)
    plural = "s fit" if len(named) > 1 else " fits"
    lines = [
        f"{len(named)} of {len(photos)} training photo{plural} no light (usual: {usual:.1f} dB); consider removing:"
    ]
    for photo in named[:most]:
        fit = "nothing to compare" if photo.psnr is None else f"{photo.psnr:.1f} dB"
        mask = "" if photo.hidden is None else f", {photo.hidden:.0%} hidden by its mask"
        lines.append(f"  {photo.name}: {fit}{mask}")
    return lines + ([f"  and {len(named) - most} more, see {PHOTOS_FILE}"] if len(named) > most else [])


def summarize_photos(photos: Sequence[PhotoFit]) -> dict[str, Any]:
    """What `metrics.json` says of training photos; nulls without tracks or masks.

    Returns:
        `static_hidden`, the share of static observations hidden over all photos; `static_hidden_worst`, that of
        the worst photo; and `misfits`, the photos that fit no light.
    """
    proven = [photo for photo in photos if photo.static_hidden is not None]
    total = sum(photo.observations for photo in proven)
    shares = [photo.static_hidden or 0.0 for photo in proven]
    hidden = sum(share * photo.observations for share, photo in zip(shares, proven, strict=True))
    return {
        "static_hidden": hidden / total if total else None,
        "static_hidden_worst": max(shares) if total else None,
        "misfits": [asdict(photo) for photo in find_misfits(photos)],
    }


def write_photos(folder: Path, step: int, photos: Sequence[PhotoFit]) -> None:
    """Writes RUN/photos.json."""
    content = {"step": step, "misfits": [photo.name for photo in find_misfits(photos)]}
    write_json(folder / PHOTOS_FILE, content | {"photos": [asdict(photo) for photo in photos]})


def read_photos(folder: Path, step: int) -> list[PhotoFit] | None:
    """What `write_photos` wrote after so many steps; None where there is no such file."""
    try:
        content = json.loads((folder / PHOTOS_FILE).read_text(encoding="utf-8"))
        return [PhotoFit(**photo) for photo in content["photos"]] if content["step"] == step else None
    except (OSError, ValueError, TypeError, KeyError):  # absent, of another version, or cut off: found anew
        return None
