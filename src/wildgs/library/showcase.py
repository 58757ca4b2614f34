"""The page that ends `wildgs demo` and `wildgs run`: a few views of a run, and their light exchanged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wildgs.evaluation.metrics import to_8bit
from wildgs.evaluation.photos import PhotoFit, find_misfits
from wildgs.exporters.report import MethodScores, Report, ReportExample, ReportMask, write_report
from wildgs.geometry.tour import spread_out
from wildgs.library.evaluation import Scores
from wildgs.library.loaded import LoadedScene
from wildgs.light.photos import encode_view
from wildgs.model.method import Method
from wildgs.runs import Run
from wildgs.scene import Scene, View

EXAMPLES = 4
LIGHTS = 3
MISFITS, MASKS = 12, 24
"""Photos in the report's sections, at most."""


def write_showcase(
    file: Path,
    title: str,
    summary: str,
    scene: Scene,
    runs: Sequence[tuple[str, Run, Scores]],
) -> None:
    """Writes the page.

    Args:
        file: The HTML file.
        title: Its headline.
        summary: A paragraph below it.
        scene: The scene of all runs.
        runs: Name, run and scores; the first is shown in pictures, the second is its baseline.
    """
    shown = runs[0][1].method
    baseline = runs[1][1].method if len(runs) > 1 else None
    views = scene.test_views or scene.train_views
    chosen = views[:: max(1, -(-len(views) // EXAMPLES))][:EXAMPLES]
    fits = LoadedScene(runs[0][1]).photo_fits(scene=scene)
    misfits = find_misfits(fits)
    lights = different_lights(without(scene.train_views, misfits), LIGHTS + 1)
    with torch.no_grad():
        examples = tuple(_example(view, lights, shown, baseline) for view in chosen)
    methods = tuple(MethodScores.from_metrics(name, {**scores}) for name, _, scores in runs if scores)
    others = [fit for fit in fits if fit.hidden is not None and fit not in misfits]
    others.sort(key=lambda fit: (fit.static_hidden or 0.0, fit.hidden or 0.0), reverse=True)
    report = Report(
        title,
        summary,
        methods,
        examples,
        misfits=_beside_masks(shown, scene, misfits[:MISFITS]),
        masks=_beside_masks(shown, scene, others[:MASKS]),
    )
    write_report(report, file)


@torch.no_grad()
def _beside_masks(method: Method, scene: Scene, fits: Sequence[PhotoFit]) -> tuple[ReportMask, ...]:
    """Training photos with their masks, and what was measured of them."""
    views = {view.name: view for view in scene.train_views}
    device, found = method.gaussians.means.device, []
    for fit in fits:
        if fit.name not in views:
            continue
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
        found.append(ReportMask(fit.name, photo, mask, "; ".join(caption)))
    return tuple(found)


def without(views: Sequence[View], misfits: Sequence[PhotoFit]) -> list[View]:
    """Views but those of photos that fit no light: their appearance is that of a drawing or a collage."""
    names = {photo.name for photo in misfits}
    return [view for view in views if view.name not in names]


def different_lights(views: Sequence[View], count: int) -> list[View]:
    """Photos as unlike each other in colour as the collection allows; the first is the most usual one."""
    if not views:
        return []
    described = torch.stack([_colour_of(view) for view in views]).double().numpy()
    return [views[index] for index in spread_out(described, count)]


def _colour_of(view: View) -> Tensor:
    pixels = view.read_photo().float().reshape(-1, 3) / 255
    return torch.cat([pixels.mean(dim=0), pixels.std(dim=0)])


def _example(view: View, lights: Sequence[View], method: Method, baseline: Method | None) -> ReportExample:
    device = method.gaussians.means.device
    camera = view.camera.to(device)
    appearance = encode_view(method, view)
    rendering = method.render(camera, method.shade(appearance))
    depth = torch.where(rendering.alpha > 0.5, rendering.depth, 0.0)
    visibility = appearance.visibility
    mask = torch.ones_like(depth) if visibility is None else visibility
    relit = tuple(
        (light.name, light.read_photo().numpy(), _picture(method, view, light))
        for light in [light for light in lights if light.name != view.name][:LIGHTS]
    )
    clean = view.read_clean() if view.split == "test" else None
    return ReportExample(
        name=view.name,
        photo=view.read_photo().numpy(),
        render=to_8bit(rendering.colors).cpu().numpy(),
        mask=(mask * 255).byte().cpu().numpy(),
        depth=depth.cpu().numpy(),
        clean=None if clean is None else clean.numpy(),
        baseline=None if baseline is None else _picture(baseline, view, view),
        relit=relit,
    )


def _picture(method: Method, view: View, light: View) -> np.ndarray:
    sh = method.shade(encode_view(method, light))
    return to_8bit(method.render(view.camera.to(sh.device), sh).colors).cpu().numpy()
