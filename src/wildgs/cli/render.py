"""`wildgs render`: views of a run under the light of any of its photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from wildgs.cli.progress import console, counting
from wildgs.evaluation.metrics import to_8bit
from wildgs.evaluation.pictures import picture_paths, write_picture
from wildgs.light.photos import encode_view, find_view
from wildgs.runs import load_run


@dataclass(frozen=True)
class Command:
    """Renders photos' viewpoints under photos' light, one PNG each.

    Example: wildgs render runs/gate --view a.jpg b.jpg --appearance evening.jpg noon.jpg --output pictures
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path
    """Folder for the pictures: OUTPUT/<appearance>/<view>.png."""
    appearance: tuple[str, ...]
    """Photos of the scene whose light is used, by name."""
    view: tuple[str, ...] = ()
    """Photos whose viewpoint is rendered, by name; without any, all that were held out."""


def run(command: Command) -> None:
    """Renders every view under every appearance."""
    loaded = load_run(command.run)
    with counting("reading photos") as progress:
        scene = loaded.load_scene(progress)
    views = [find_view(scene, name) for name in command.view] or list(scene.test_views)
    lights = [find_view(scene, name) for name in command.appearance]
    paths = picture_paths([view.name for view in views])
    folders = picture_paths([light.name for light in lights])
    with counting("rendering") as progress, torch.no_grad():
        for number, light in enumerate(lights):
            sh = loaded.method.shade(encode_view(loaded.method, light))
            for index, view in enumerate(views):
                colors = loaded.method.render(view.camera.to(sh.device), sh).colors
                folder = command.output / folders[light.name].with_suffix("")
                write_picture(folder / paths[view.name], to_8bit(colors))
                progress(number * len(views) + index + 1, len(views) * len(lights))
    console.print(f"{len(views) * len(lights)} pictures -> {command.output}")
