"""The page that ends `wildgs demo` and `wildgs run`: a few views of a run, and their light exchanged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wildgs.evaluation.metrics import to_8bit
from wildgs.exporters.report import MethodScores, Report, ReportExample, write_report
from wildgs.geometry.tour import spread_out
from wildgs.library.evaluation import Scores
from wildgs.light.photos import encode_view
from wildgs.model.method import Method
from wildgs.runs import Run
from wildgs.scene import Scene, View

EXAMPLES = 4
LIGHTS = 3


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
    lights = different_lights(scene.train_views, LIGHTS + 1)
    with torch.no_grad():
        examples = tuple(_example(view, lights, shown, baseline) for view in chosen)
    methods = tuple(MethodScores.from_metrics(name, {**scores}) for name, _, scores in runs if scores)
    write_report(Report(title, summary, methods, examples), file)


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
