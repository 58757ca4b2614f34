"""The README's picture, from a finished demo: a photo, the scene without people, and the view in other light.

Example: wildgs demo --output wildgs-demo && python benchmarks/readme_picture.py wildgs-demo
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from wildgs.evaluation.metrics import to_8bit
from wildgs.library.pages import different_lights
from wildgs.light.photos import encode_view
from wildgs.model.method import Method
from wildgs.runs import load_run
from wildgs.scene import View, find_view

GAP = 6


@dataclass(frozen=True)
class Command:
    """Makes the README's picture."""

    demo: tyro.conf.Positional[Path]
    """Folder that `wildgs demo` left."""
    view: str | None = None
    """Held-out photo to show; the first by default."""
    lights: int = 3
    """How many other photos lend their light."""
    output: Path = Path("docs/figures/demo.jpg")
    """Where the picture goes."""


def draw(method: Method, view: View, light: View) -> np.ndarray:
    sh = method.shade(encode_view(method, light))
    return to_8bit(method.render(view.camera.to(sh.device), sh).colors).cpu().numpy()


def main(command: Command) -> None:
    run = load_run(command.demo / "wildgs")
    scene = run.read_scene()
    view = find_view(scene, command.view) if command.view else scene.test_views[0]
    lights = different_lights(scene.train_views, command.lights)
    with torch.no_grad():
        tiles = [view.read_photo().numpy()] + [draw(run.method, view, light) for light in (view, *lights)]
    height, width = tiles[0].shape[:2]
    sheet = Image.new("RGB", (len(tiles) * (width + GAP) - GAP, height), "white")
    for index, tile in enumerate(tiles):
        sheet.paste(Image.fromarray(tile), (index * (width + GAP), 0))
    command.output.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(command.output, quality=90)
    print(f"{command.output}: {view.name} under the light of itself, {', '.join(v.name for v in lights)}")


if __name__ == "__main__":
    main(tyro.cli(Command))
