"""The two web pages of a run: the report (scores and comparisons), and the page with the 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.evaluation.metrics import to_8bit
from wildgs.evaluation.photos import PhotoFit, find_misfits, read_photos
from wildgs.exporters.page import Page, PageLight, PageView, write_page
from wildgs.exporters.report import (
    MethodScores,
    Report,
    ReportExample,
    ReportMask,
    ReportUnplaced,
    write_report,
)
from wildgs.exporters.splats import CleanupConfig, Splats, kept_rows
from wildgs.geometry.trajectory import spread_out
from wildgs.library.day import find_day, has_day, in_order_of_day, viewpoints_of
from wildgs.library.evaluation import Scores
from wildgs.library.loaded import LoadedScene, find_looks
from wildgs.light.look import NEUTRAL, Look
from wildgs.light.photos import encode_view
from wildgs.model.gaussians import NEAR
from wildgs.model.method import Method
from wildgs.progress import Progress
from wildgs.scene import Scene, View
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.scene.start import choose_start
from wildgs.sfm.report import describe_placed, read_left_out
from wildgs.threads import infer_each

PAGE_LIGHTS = 6


@dataclass(frozen=True)
class ExportedFile:
    """A written file.

    Attributes:
        file: The file.
        megabytes: Its size in MB.
        num_gaussians: Number of Gaussians in it.
        sh_degree: Degree of its spherical harmonics.
        looks: The appearances in it.
    """

    file: Path
    megabytes: float
    num_gaussians: int
    sh_degree: int
    looks: tuple[Look, ...]


@torch.no_grad()
def write_webpage(
    loaded: LoadedScene,
    looks: Sequence[Look],
    file: Path,
    *,
    title: str,
    cleanup: CleanupConfig | None = None,
) -> ExportedFile:
    """Writes the web page of a run under several looks; it opens with the first.

    If the looks are those of photos in the order of the run's day, the page can play the day.
    """
    cleanup = cleanup or CleanupConfig()
    scene = loaded.scene
    start, depth = choose_start(scene)
    splats = baked(loaded, looks[0])
    keep = kept_rows(cleanup, splats, scene.points)
    lights = [
        PageLight(look.name, look.sh.cpu().detach()[keep], thumbnail(loaded, look, start)) for look in looks
    ]
    page = Page(
        title=title,
        summary=f"{int(keep.sum()):,} Gaussians from {len(scene.views)} photos, by Wild-GS.",
        splats=splats.select(keep),
        lights=lights,
        start=PageView(start.camera, depth),
        near=NEAR,
        eps2d=loaded.gaussians.eps2d,
        antialiased=loaded.gaussians.antialiased,
        day=in_order_of_day(loaded, [look.name for look in looks]),
    )
    degree = write_page(page, file, viewpoints=viewpoints_of(scene.views), sh_degree=cleanup.sh_degree)
    return ExportedFile(file, file.stat().st_size / 1e6, len(page.splats), degree, tuple(looks))


def write_scene_page(
    loaded: LoadedScene, file: Path, title: str, progress: Progress | None = None
) -> ExportedFile:
    """Writes the web page of a run under automatically selected lights, for `wildgs run` and `wildgs demo`."""
    return write_webpage(loaded, page_looks(loaded, progress), file, title=title)


def page_looks(loaded: LoadedScene, progress: Progress | None = None) -> list[Look]:
    """Looks for the web page: the course of a day, else very different photos; one look if it cannot be relit."""
    if not loaded.relightable:
        return [loaded.appearance(NEUTRAL)]
    day = find_day(loaded, progress=progress) if has_day(loaded) else None
    if day is not None and len(day.keys) > PAGE_LIGHTS // 2:
        shown = min(PAGE_LIGHTS, len(day.keys))
        chosen = [day.keys[round(index * (len(day.keys) - 1) / (shown - 1))] for index in range(shown)]
        return find_looks(loaded, chosen, progress=progress)
    views = loaded.scene.train_views or loaded.views
    misfits = find_misfits(read_photos(loaded.run.folder, loaded.run.step) or [])
    chosen = different_lights(_without(views, misfits), PAGE_LIGHTS)
    return find_looks(loaded, [view.name for view in chosen], progress=progress)


def baked(loaded: LoadedScene, look: Look) -> Splats:
    """The run's Gaussians under a look, on the CPU, in the aligned frame."""
    gaussians = loaded.gaussians
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, look.sh)
    sky = loaded.run.method.sky()
    return Splats(*(value.detach().cpu().float() for value in values), sky=None if sky is None else sky.cpu())


def thumbnail(loaded: LoadedScene, look: Look, start: View) -> np.ndarray:
    """The photo of a look; if it is not a photo of the scene, a render of the start view under it."""
    view = next((view for view in loaded.views if view.name == look.name), None)
    pixels = loaded.render(start.camera, look) if view is None else view.read_photo()
    return pixels.numpy()


EXAMPLES = 4
LIGHTS = 3
MISFITS, MASKS = 12, 24
"""Upper bounds on the number of photos in the report's sections."""


def write_showcase(
    file: Path,
    title: str,
    summary: str,
    scene: Scene,
    runs: Sequence[tuple[str, LoadedScene, Scores]],
) -> None:
    """Writes the report on one or more runs on the same scene.

    Args:
        file: The HTML file.
        title: The title.
        summary: A paragraph below the title.
        scene: The scene of all runs.
        runs: Name, run and scores. Images show the first run, and the second as its baseline.
    """
    shown = runs[0][1]
    baseline = runs[1][1].run.method if len(runs) > 1 else None
    device = shown.gaussians.means.device
    views = scene.test_views or scene.train_views
    chosen = views[:: max(1, -(-len(views) // EXAMPLES))][:EXAMPLES]
    fits = shown.photo_fits(scene=scene)
    misfits = find_misfits(fits)
    lights = different_lights(_without(scene.train_views, misfits), LIGHTS + 1)
    with torch.no_grad():
        shaded = [(light, shown.run.method.shade(shown.encode(light))) for light in lights]
    examples = tuple(infer_each(lambda view: _example(view, shaded, shown, baseline), chosen, device))
    methods = tuple(MethodScores.from_metrics(name, {**scores}) for name, _, scores in runs if scores)
    others = [fit for fit in fits if fit.hidden is not None and fit not in misfits]
    others.sort(key=lambda fit: (fit.static_hidden or 0.0, fit.hidden or 0.0), reverse=True)
    report = Report(
        title,
        summary,
        methods,
        examples,
        misfits=_beside_masks(shown.run.method, scene, misfits[:MISFITS]),
        masks=_beside_masks(shown.run.method, scene, others[:MASKS]),
        poses=describe_placed(scene.root),
        unplaced=tuple(
            ReportUnplaced(photo.name, photo.reason, _matches(photo.picture))
            for photo in read_left_out(scene.root)
        ),
    )
    write_report(report, file)


def _matches(picture: Path | None) -> np.ndarray | None:
    """The image of a photo's best matches; None if there is none or it cannot be read."""
    try:
        return None if picture is None else read_photo(picture).pixels
    except UnreadableImageError:
        return None


def _beside_masks(method: Method, scene: Scene, fits: Sequence[PhotoFit]) -> tuple[ReportMask, ...]:
    """Training photos with their masks, and captions with their measurements."""
    views = {view.name: view for view in scene.train_views}
    device = method.gaussians.means.device

    def show(fit: PhotoFit) -> ReportMask:
        visibility = method.visibility(views[fit.name].load(device)[0])
        mask = None if visibility is None else visibility.float().cpu().numpy()
        caption = [
            "nothing to compare" if fit.psnr is None else f"{fit.psnr:.1f} dB, structure {fit.structure:.2f}"
        ]
        if fit.static_hidden is not None:
            caption.append(f"{fit.static_hidden:.1%} of {fit.observations} static observations hidden")
        if fit.hidden is not None:
            caption.append(f"{fit.hidden:.0%} of the photo hidden")
        photo = views[fit.name].read_photo().numpy()
        return ReportMask(fit.name, photo, mask, "; ".join(caption))

    return tuple(infer_each(show, [fit for fit in fits if fit.name in views], device))


def _without(views: Sequence[View], misfits: Sequence[PhotoFit]) -> list[View]:
    """The views without misfits, whose appearance is that of a drawing or a collage."""
    names = {photo.name for photo in misfits}
    return [view for view in views if view.name not in names]


def different_lights(views: Sequence[View], count: int) -> list[View]:
    """Photos that differ most in colour; the first is the most typical one."""
    if not views:
        return []
    described = torch.stack([_colour_of(view) for view in views]).double().numpy()
    return [views[index] for index in spread_out(described, count)]


def _colour_of(view: View) -> Tensor:
    pixels = view.read_photo().float().reshape(-1, 3) / 255
    return torch.cat([pixels.mean(dim=0), pixels.std(dim=0)])


def _example(
    view: View,
    lights: Sequence[tuple[View, Float[Tensor, "N K 3"]]],
    shown: LoadedScene,
    baseline: Method | None,
) -> ReportExample:
    """The images of a view, also under the lights of other photos (given as shaded harmonics)."""
    method = shown.run.method
    camera = view.camera.to(method.gaussians.means.device)
    appearance = shown.encode(view)
    rendering = method.render(camera, method.shade(appearance), response=appearance.response)
    depth = torch.where(rendering.alpha > 0.5, rendering.depth, 0.0)
    visibility = appearance.visibility
    mask = torch.ones_like(depth) if visibility is None else visibility
    relit = tuple(
        (light.name, light.read_photo().numpy(), _picture(method, view, sh))
        for light, sh in [(light, sh) for light, sh in lights if light.name != view.name][:LIGHTS]
    )
    clean = view.read_clean() if view.split == "test" else None
    return ReportExample(
        name=view.name,
        photo=view.read_photo().numpy(),
        render=to_8bit(rendering.colors).cpu().numpy(),
        mask=(mask * 255).byte().cpu().numpy(),
        depth=depth.cpu().numpy(),
        clean=None if clean is None else clean.numpy(),
        baseline=None
        if baseline is None
        else _picture(baseline, view, baseline.shade(encode_view(baseline, view))),
        relit=relit,
    )


def _picture(method: Method, view: View, sh: Float[Tensor, "N K 3"]) -> np.ndarray:
    return to_8bit(method.render(view.camera.to(sh.device), sh).colors).cpu().numpy()
