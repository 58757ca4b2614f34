"""How well training photos fit a trained run: what their masks hide, and which photos are misfits.

A misfit is a photo that the model reproduces badly under every appearance: a collage, a drawing, another place, or
a wrong pose.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn import functional

from wildgs.errors import UserError
from wildgs.evaluation.metrics import MAX_PSNR
from wildgs.evaluation.pictures import write_json
from wildgs.files import read_json
from wildgs.model.appearance import Appearance
from wildgs.model.camera_response import responded, squared_radius
from wildgs.model.method import Method
from wildgs.rasterize import blend
from wildgs.scene.scene import Scene, View, observed_pixels
from wildgs.threads import infer_each

PHOTOS_FILE = "photos.json"
"""File in the run folder with the results of `inspect_photos`."""
HIDDEN = 0.5
"""Pixels with a visibility M below this are hidden."""
COMPARED_SIDE = 160
"""Maximum long side in pixels at which renders are compared with photos."""
LEAST_SHOWN = 0.01
"""Photos of which the mask leaves a smaller share visible are not compared."""
DEVIATIONS = 3.5
"""A photo is a misfit if it is this many robust standard deviations worse than the collection's median."""
LEAST_DEVIATION = {"psnr": 1.0, "hidden": 0.05}
"""Lower bounds of the standard deviations (dB, and share of the photo), for very uniform collections."""
MOSTLY = 0.5
"""A mask that hides a smaller share of a photo does not make it a misfit."""
STRUCTURE_LOSS = 0.5
"""A photo is a misfit if its structure is below the median by more than this share of the median."""
LEAST_STRUCTURE = 0.2
"""Structure is not judged if its median is lower: the model has not learnt enough yet."""
WINDOW = 0.025
"""Standard deviation of the Gaussian window of structure, relative to the longer side."""
LEAST_VARIANCE = 1e-4
"""Regulariser of the correlation: windows of lower luminance variance are flat, and their correlation is noise."""
LEAST_PHOTOS = 8
"""Minimum number of photos for robust statistics."""


@dataclass(frozen=True)
class PhotoFit:
    """How well one training photo fits the run; None for values that could not be computed.

    Attributes:
        name: Name of the photo.
        psnr: PSNR of the render under the photo's own appearance over pixels that the mask does not hide, dB.
        structure: Local correlation of the luminances of render and photo over the same pixels, weighted by the
            photo's local contrast: 1 if all edges agree, independent of lighting; 0 if none do.
        hidden: Share of pixels with M < `HIDDEN`.
        static_hidden: Share of static observations with M < `HIDDEN`. Static observations are projections of points
            that at least three photos triangulated, so they cannot show passers-by.
        observations: Number of static observations.
    """

    name: str
    psnr: float | None
    structure: float
    hidden: float | None
    static_hidden: float | None
    observations: int


@contextmanager
def inference(method: Method) -> Iterator[None]:
    """Context manager: evaluation mode without gradients."""
    # Not torch.inference_mode, since tensors that a method caches must remain usable in training.
    training = method.training
    method.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        method.train(training)


def inspect_photos(
    method: Method,
    scene: Scene,
    on_photo: Callable[[int, int], None] | None = None,
    on_appearance: Callable[[str, Appearance], None] | None = None,
) -> list[PhotoFit]:
    """Renders every training photo under its own appearance at low resolution, and measures its mask.

    Args:
        method: A trained method.
        scene: The scene on which it was trained.
        on_photo: Called with (photos inspected, total).
        on_appearance: Called with the name and the appearance of each photo.

    Returns:
        One entry per readable training photo; none for a method without appearance.
    """
    if not method.relightable:
        return []
    observed, views, found = observed_pixels(scene), scene.train_views, []

    def inspect(view: View) -> tuple[PhotoFit, Appearance] | None:
        try:
            return _inspect(method, view, observed.get(view.name))
        except UserError:  # the photo was removed after training; the others are still inspected
            return None

    with inference(method):
        results = infer_each(inspect, views, method.gaussians.means.device)
        for count, (view, result) in enumerate(zip(views, results, strict=True), start=1):
            if result is None:
                continue
            found.append(result[0])
            if on_appearance is not None:
                on_appearance(view.name, result[1])
            if on_photo is not None:
                on_photo(count, len(views))
    return found


def _inspect(
    method: Method, view: View, observed: Float[Tensor, "K 2"] | None
) -> tuple[PhotoFit, Appearance]:
    """The fit of a photo, and its appearance."""
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
    if appearance.response is not None:
        colors = responded(colors, squared_radius(projection.camera), appearance.response)
    error = (colors.nan_to_num().clamp(0, 1).permute(2, 0, 1) - small[:3]).square().mean(dim=0)
    weights, psnr, structure = small[3], None, 0.0
    if float(weights.mean()) >= LEAST_SHOWN:
        mean = (error * weights).sum() / weights.sum()
        psnr = min(float(-10 * mean.log10()), MAX_PSNR)
        structure = _structure(small[:3].mean(dim=0), colors.nan_to_num().mean(dim=2), weights)
    return PhotoFit(view.name, psnr, structure, hidden, static_hidden, count), appearance


def _structure(
    photo: Float[Tensor, "h w"], render: Float[Tensor, "h w"], weights: Float[Tensor, "h w"]
) -> float:
    """Correlation of two luminances in Gaussian windows, averaged with the photo's contrast as weight."""
    first, second, shown = (values.double().cpu().numpy() for values in (photo, render, weights))
    sigma = WINDOW * max(first.shape)
    blurs = [gaussian_filter(x, sigma) for x in (first, second, first**2, second**2, first * second)]
    variance, other = (np.maximum(blurs[i + 2] - blurs[i] ** 2, 0) for i in (0, 1))
    covariance = blurs[4] - blurs[0] * blurs[1]
    correlation = covariance / np.sqrt((variance + LEAST_VARIANCE) * (other + LEAST_VARIANCE))
    contrast = np.sqrt(variance) * shown
    return float((correlation * contrast).sum() / max(contrast.sum(), 1e-9))


def find_misfits(photos: Sequence[PhotoFit]) -> list[PhotoFit]:
    """Selects misfits, worst first: collages, drawings, photos of other places, wrong poses.

    A photo is a misfit if at least one of three criteria holds. Its structure is less than half of the median:
    edges are in other places, which lighting cannot explain. Its PSNR is `DEVIATIONS` robust standard deviations
    below the median. Or its mask hides most of the photo, and `DEVIATIONS` robust deviations more than the median.

    The deviations are robust, since outliers would dominate mean and standard deviation: the standard deviation is
    that of a normal distribution with the same median absolute deviation, or with the same quartile on the bad
    side if that is larger. A quarter of the photos, for example those at night, are therefore not misfits.
    """
    severities = dict.fromkeys((photo.name for photo in photos), 0.0)

    def judge(names: Sequence[str], values: Sequence[float]) -> None:
        for name, value in zip(names, values, strict=True):
            severities[name] = max(severities[name], value)

    rated = [(photo.name, photo.psnr, photo.structure) for photo in photos if photo.psnr is not None]
    if len(rated) < LEAST_PHOTOS:
        return []
    names, fits, structures = zip(*rated, strict=True)
    judge(names, _deviations([-fit for fit in fits], LEAST_DEVIATION["psnr"]))
    usual = statistics.median(structures)
    if usual >= LEAST_STRUCTURE:
        judge(names, [(usual - structure) / (STRUCTURE_LOSS * usual) for structure in structures])
    masked = [(photo.name, photo.hidden) for photo in photos if photo.hidden is not None]
    unusual = _deviations([hidden for _, hidden in masked], LEAST_DEVIATION["hidden"])
    mostly = [(name, value) for (name, hidden), value in zip(masked, unusual, strict=True) if hidden > MOSTLY]
    judge([name for name, _ in mostly], [value for _, value in mostly])
    named = [photo for photo in photos if severities[photo.name] > 1]
    return sorted(named, key=lambda photo: severities[photo.name], reverse=True)


def _deviations(values: Sequence[float], least: float) -> list[float]:
    """Distance of each value above the median, in units of `DEVIATIONS` robust standard deviations."""
    if not values:
        return []
    middle, quartile = (float(q) for q in np.quantile(values, (0.5, 0.75)))
    spread = statistics.median(abs(value - middle) for value in values)
    deviation = max(1.4826 * spread, 1.4826 * (quartile - middle), least)
    return [(value - middle) / (DEVIATIONS * deviation) for value in values]


def describe_misfits(photos: Sequence[PhotoFit], most: int = 8) -> list[str]:
    """Log lines that list the misfits, worst first, with the share of each that its mask hides."""
    named = find_misfits(photos)
    if not named:
        return []
    rated = [photo for photo in photos if photo.psnr is not None]
    usual = statistics.median(photo.psnr or 0.0 for photo in rated)
    structure = statistics.median(photo.structure for photo in rated)
    lines = [
        f"{len(named)} of {len(photos)} training photos do not fit the scene (median: {usual:.1f} dB, structure "
        f"{structure:.2f}), worst first; remove them if they show something else:"
    ]
    for photo in named[:most]:
        fit = "no visible pixels to compare"
        if photo.psnr is not None:
            fit = f"{photo.psnr:.1f} dB, structure {photo.structure:.2f}"
        mask = "" if photo.hidden is None else f", {photo.hidden:.0%} hidden by its mask"
        lines.append(f"  {photo.name}: {fit}{mask}")
    return lines + ([f"  and {len(named) - most} more, see {PHOTOS_FILE}"] if len(named) > most else [])


def summarize_photos(photos: Sequence[PhotoFit]) -> dict[str, Any]:
    """Entries of `metrics.json` about training photos; null without tracks or masks.

    Returns:
        `static_hidden`, the share of static observations hidden over all photos; `static_hidden_worst`, that of
        the worst photo; and `misfits`, the entries of the misfits.
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
    """Reads the results that `write_photos` stored for a training step; None if there are none."""
    try:
        content = read_json(folder / PHOTOS_FILE)
        return [PhotoFit(**photo) for photo in content["photos"]] if content["step"] == step else None
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
    ):  # missing, truncated or of another version: computed again
        return None
