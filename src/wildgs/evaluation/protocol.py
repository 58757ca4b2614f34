"""The two evaluation protocols: appearance from the whole test photo (`full`), or from its left half (`half`)."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from wildgs.errors import UserError
from wildgs.evaluation.benchmark import METRICS
from wildgs.evaluation.lpips import LPIPS, MIN_SIDE, load_lpips
from wildgs.evaluation.metrics import (
    LEAST_LANDMARK_PIXELS,
    MaskScore,
    detail,
    landmark_pixels,
    psnr,
    structural_similarity,
    to_8bit,
)
from wildgs.evaluation.photos import PhotoFit, inference, summarize_photos
from wildgs.evaluation.pictures import picture_paths, write_json, write_picture
from wildgs.model.method import Method
from wildgs.scene.scene import Scene, View, observed_pixels
from wildgs.threads import infer_each

Protocol = Literal["full", "half"]
_TIMED_FRAMES = 15


@dataclass(frozen=True)
class ImageScore:
    """Scores of one view; None if a metric could not be computed.

    Attributes:
        name: Name of the photo.
        psnr: PSNR, dB.
        ssim: SSIM.
        lpips: LPIPS.
        landmark: PSNR of the pixels near triangulated observations, dB, see `landmark_pixels`.
        elsewhere: PSNR of the other pixels (sky, ground, passers-by), dB.
        detail_energy: See `wildgs.evaluation.metrics.Detail`.
        detail_correlation: See `wildgs.evaluation.metrics.Detail`.
    """

    name: str
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    landmark: float | None = None
    elsewhere: float | None = None
    detail_energy: float | None = None
    detail_correlation: float | None = None


@dataclass
class _Notes:
    """Distinct notes for `metrics.json`."""

    lines: list[str] = field(default_factory=list)

    def add(self, *lines: str) -> None:
        self.lines += [line for line in dict.fromkeys(lines) if line not in self.lines]


def evaluate(
    method: Method,
    scene: Scene,
    protocol: Protocol,
    run: Path,
    *,
    step: int,
    train_seconds: float | None = None,
    lpips_folder: Path | None = None,
    mask_threshold: float = 0.5,
    photos: Sequence[PhotoFit] = (),
    on_view: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Renders and scores the held-out views; writes ``eval/<protocol>/<stem>.png`` and ``metrics.json``.

    `full` takes the appearance of a view from the whole test photo and scores the whole image. `half` takes it
    from the left half (columns below ``W // 2``, with a cropped camera, so that mask, embedding and lifting use
    nothing else) and scores the right half as a separate image. The whole image is written in both cases.

    A view is scored against its clean ground truth if there is one, otherwise against the photo. In the latter
    case, pixels that the user's mask ignores are excluded from PSNR and SSIM, and replaced by the photo for LPIPS.
    Renders are rounded to 8 bits first.

    In `full`, predicted masks of training photos are scored too: against ground truth masks if the scene has any,
    and by the share of static observations that they hide (`photos`).

    Args:
        method: A trained method.
        scene: Scene with at least one test view.
        protocol: `full` or `half`.
        run: Run folder.
        step: Number of training steps of `method`; only recorded.
        train_seconds: Training time; only recorded.
        lpips_folder: Folder of LPIPS weights; the default is described in `load_lpips`.
        mask_threshold: Threshold Th of the intersection over union of masks.
        photos: Results of `inspect_photos`.
        on_view: Called with the name of each finished view.

    Returns:
        Content of `metrics.json`.

    Raises:
        UserError: The scene has no test views.
    """
    if not scene.test_views:
        raise UserError(
            f"{scene.root} has no held-out photos to score: mark some as 'test' in its split .tsv"
        )
    folder = run / "eval" / protocol
    lpips, line = load_lpips(lpips_folder)
    notes = _Notes([line])
    device = method.gaussians.means.device
    lpips = lpips.to(device) if lpips is not None else None
    paths = picture_paths(view.name for view in scene.test_views)
    observed = observed_pixels(scene, least_photos=1, split="test")
    scores: list[ImageScore] = []

    def score(view: View) -> tuple[ImageScore, _Notes, Tensor | None]:
        own = _Notes()
        sh, response = _shade(method, view, protocol, device)
        render = _render(method, view, sh, response, own)
        write_picture(folder / paths[view.name], render)
        found = _score_view(view, render, protocol, observed, lpips, own)
        return found, own, sh if view is scene.test_views[-1] else None

    with inference(method):
        sh = None
        for found, own, last in infer_each(score, scene.test_views, device):
            sh = last
            scores.append(found)
            notes.add(*own.lines)
            if on_view is not None:
                on_view(found.name)
        assert sh is not None
        fps = _measure_fps(method, sh, scene.test_views, device)
        masks = _score_masks(method, scene, device, mask_threshold) if protocol == "full" else None
    content: dict[str, Any] = {
        "protocol": protocol,
        "step": step,
        "num_gaussians": method.num_gaussians,
        "train_seconds": train_seconds,
        "render_fps": fps,
        "device": _describe(device),
        "lpips_network": None if lpips is None else lpips.network,
        "mean": {metric: _mean(scores, metric) for metric in METRICS},
        "images": [asdict(score) for score in scores],
        "notes": notes.lines,
    }
    if masks is not None:
        content["masks"] = masks.as_dict()
    if protocol == "full":
        content |= summarize_photos(photos)
    write_json(folder / "metrics.json", content)
    return content


def _shade(
    method: Method, view: View, protocol: Protocol, device: torch.device
) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, " Q"] | None]:
    """Spherical harmonics and camera response of the part of the photo that the protocol allows."""
    (photo, keep), camera = view.load(device), view.camera.to(device)
    if protocol == "half":
        half = photo.shape[1] // 2
        photo, camera = photo[:, :half].contiguous(), camera.cropped(0, 0, half, camera.height)
        keep = None if keep is None else keep[:, :half].contiguous()
    appearance = method.encode(photo, camera, keep)
    return method.shade(appearance), appearance.response


def _render(
    method: Method,
    view: View,
    sh: Float[Tensor, "N K 3"],
    response: Float[Tensor, " Q"] | None,
    notes: _Notes,
) -> UInt8[Tensor, "H W 3"]:
    colors = method.render(view.camera.to(sh.device), sh, response=response).colors
    if not colors.isfinite().all():
        notes.add(f"{view.name}: the render contains non-finite values, scored as black")
    return to_8bit(colors)


def _score_view(
    view: View,
    render: UInt8[Tensor, "H W 3"],
    protocol: Protocol,
    observed: Mapping[str, Float[Tensor, "_ 2"]],
    lpips: LPIPS | None,
    notes: _Notes,
) -> ImageScore:
    clean = view.read_clean()
    truth = (view.read_photo() if clean is None else clean).to(render.device)
    keep = _read_keep(view, render.device) if clean is None else None
    if clean is not None:
        notes.add("views with a clean ground truth are scored against it instead of the photo")
    near = landmark_pixels(observed[view.name], *render.shape[:2]) if view.name in observed else None
    near = None if near is None else near.to(render.device)
    if protocol == "half":
        half = render.shape[1] // 2
        render, truth = render[:, half:], truth[:, half:]
        keep = None if keep is None else keep[:, half:]
        near = None if near is None else near[:, half:]
    if keep is not None:
        notes.add(
            "pixels that a mask ignores are excluded from PSNR and SSIM, and replaced by the photo for LPIPS"
        )
        if not keep.any():
            notes.add(f"{view.name}: the mask ignores all pixels that would be scored")
            return ImageScore(view.name)
    energy, correlation = detail(render, truth, keep)
    landmark, elsewhere = (None, None) if near is None else _landmark_psnr(render, truth, near, keep)
    return ImageScore(
        name=view.name,
        psnr=psnr(render, truth, keep),
        ssim=structural_similarity(render, truth, keep),
        lpips=_perceptual(view, render, truth, keep, lpips, notes),
        landmark=landmark,
        elsewhere=elsewhere,
        detail_energy=energy,
        detail_correlation=correlation,
    )


def _landmark_psnr(
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    near: Bool[Tensor, "H W"],
    keep: Bool[Tensor, "H W"] | None,
) -> tuple[float | None, float | None]:
    """PSNR of the landmark and of the remaining pixels; None if the landmark has too few pixels."""
    parts = [part if keep is None else part & keep for part in (near, ~near)]
    if int(parts[0].sum()) < LEAST_LANDMARK_PIXELS:
        return None, None
    landmark, elsewhere = (psnr(render, truth, part) if part.any() else None for part in parts)
    return landmark, elsewhere


def _read_keep(view: View, device: torch.device) -> Bool[Tensor, "H W"] | None:
    mask = view.read_mask()
    return None if mask is None else (mask > 0).to(device)


def _perceptual(
    view: View,
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    keep: Bool[Tensor, "H W"] | None,
    lpips: LPIPS | None,
    notes: _Notes,
) -> float | None:
    if lpips is None:
        return None
    if min(render.shape[:2]) < MIN_SIDE:
        notes.add(
            f"{view.name}: LPIPS is null, since the scored part has fewer than {MIN_SIDE} pixels per side"
        )
        return None
    if keep is not None:
        render = torch.where(keep[..., None], render, truth)
    return float(lpips(render, truth))


def _measure_fps(
    method: Method, sh: Float[Tensor, "N K 3"], views: tuple[View, ...], device: torch.device
) -> float:
    """Rendering speed in frames per second with cached harmonics: the median over the cameras of the views."""
    cameras = [view.camera.to(device) for view in views[:_TIMED_FRAMES]]
    method.render(cameras[0], sh)
    seconds = []
    for i in range(_TIMED_FRAMES):
        _synchronize(device)
        start = time.perf_counter()
        method.render(cameras[i % len(cameras)], sh)
        _synchronize(device)
        seconds.append(time.perf_counter() - start)
    return 1 / statistics.median(seconds)


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _score_masks(method: Method, scene: Scene, device: torch.device, threshold: float) -> MaskScore | None:
    """Scores of the masks of training photos; None without ground truth or predicted masks."""
    score = MaskScore(threshold)

    def compare(view: View) -> tuple[Tensor | None, Tensor] | None:
        truth = view.read_truth_mask()
        return None if truth is None else (method.visibility(view.load(device)[0]), truth)

    for compared in infer_each(compare, scene.train_views, device):
        if compared is None:
            continue
        visibility, truth = compared
        if visibility is None:
            return None
        score.add(visibility, truth > 127)
    return score if score.images else None


def _mean(scores: list[ImageScore], metric: str) -> float | None:
    values = [value for value in (getattr(score, metric) for score in scores) if value is not None]
    return math.fsum(values) / len(values) if values else None


def _describe(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
