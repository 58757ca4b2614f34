"""Does light move from one photo to the view of another, and nothing else?

    python benchmarks/transfer.py runs/gate --pictures transfer

Every held-out view is rendered under its own photo's light (unchanged) and under that of other photos (relit).

- Colour: the mean CIE Lab colour of the static pixels, its distance to that of the source photo's static pixels.
  Relit over unchanged is the ratio; the goal is at most 0.5 for every view. Static is what the scene's true masks
  say (`truth/masks/`), else the predicted mask.
- The same at the source photo's own camera, pixel by pixel: mean Lab distance between the source photo and the
  render there under its own light, over that under the view's light. Framing plays no part here.
- Geometry: depth and alpha must be identical under both lights.
- Mix: from 0 to 1 in steps, the pictures' mean Lab distance to the first must rise and to the last must fall, and
  no step may be much larger than the mean step.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image

import wildgs
from wildgs.library.gallery import contact_sheet
from wildgs.library.pages import different_lights
from wildgs.light.look import Look
from wildgs.light.photos import encode_view
from wildgs.scene import View

SOURCES = 4
LEAST_DISTANCE = 5.0  # Lab; below, the source's light is the view's own and a ratio says nothing
MIX_STEPS = 10
SHOWN = 4


@dataclass(frozen=True)
class Command:
    """Measures light transfer on a run."""

    run: tyro.conf.Positional[Path]
    """Run folder, of a scene with held-out photos."""
    output: Path | None = None
    """JSON file for all figures."""
    pictures: Path | None = None
    """Folder for sheets: views under the sources' light, mixes, a picture's style."""


def to_lab(picture: np.ndarray) -> np.ndarray:
    """8-bit sRGB to CIE Lab (D65)."""
    unit = picture / 255.0
    linear = np.where(unit <= 0.04045, unit / 12.92, ((unit + 0.055) / 1.055) ** 2.4)
    matrix = [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
    xyz = linear @ np.array(matrix).T / [0.95047, 1.0, 1.08883]
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1
    )


def static_of(scene: wildgs.LoadedScene, view: View) -> np.ndarray:
    """Pixels of a photo that show the static scene."""
    mask = view.read_truth_mask()
    if mask is not None:
        return mask.numpy() > 127
    visibility = encode_view(scene.run.method, view).visibility
    everything = np.ones((view.camera.height, view.camera.width), dtype=bool)
    return everything if visibility is None else visibility.cpu().numpy() > 0.5


def mean_lab(picture: np.ndarray, keep: np.ndarray) -> np.ndarray:
    return to_lab(picture)[keep].mean(axis=0)


def pixelwise(first: np.ndarray, second: np.ndarray, keep: np.ndarray) -> float:
    return float(np.linalg.norm(to_lab(first) - to_lab(second), axis=-1)[keep].mean())


def compare(scene: wildgs.LoadedScene, view: View, source: View) -> dict[str, Any]:
    """One view under another photo's light."""
    own, lent = scene.appearance(view.name), scene.appearance(source.name)
    unchanged, relit = (scene.render(view.camera, look).numpy() for look in (own, lent))
    keep, keep_source = static_of(scene, view), static_of(scene, source)
    photo = source.read_photo().numpy()
    goal = mean_lab(photo, keep_source)
    there = [pixelwise(scene.render(source.camera, look).numpy(), photo, keep_source) for look in (own, lent)]
    return {
        "view": view.name,
        "source": source.name,
        "unchanged": float(np.linalg.norm(mean_lab(unchanged, keep) - goal)),
        "relit": float(np.linalg.norm(mean_lab(relit, keep) - goal)),
        "at_source_other_light": there[0],
        "at_source_own_light": there[1],
        "same_geometry": same_geometry(scene, view, own, lent),
    }


@torch.no_grad()
def same_geometry(scene: wildgs.LoadedScene, view: View, first: Look, second: Look) -> bool:
    device = first.sh.device
    one, two = (scene.run.method.render(view.camera.to(device), look.sh) for look in (first, second))
    return torch.equal(one.depth, two.depth) and torch.equal(one.alpha, two.alpha)


def sweep(scene: wildgs.LoadedScene, view: View, source: View) -> dict[str, Any]:
    """A mix from the view's own light to the source's."""
    looks = [scene.appearance(view.name), scene.appearance(source.name)]
    pictures = [
        scene.render(view.camera, wildgs.mix(looks, [1 - share, share])).numpy()
        for share in np.linspace(0, 1, MIX_STEPS + 1)
    ]
    everything = np.ones(pictures[0].shape[:2], dtype=bool)
    away = np.array([pixelwise(picture, pictures[0], everything) for picture in pictures])
    towards = np.array([pixelwise(picture, pictures[-1], everything) for picture in pictures])
    steps = np.array([pixelwise(a, b, everything) for a, b in zip(pictures[1:], pictures[:-1], strict=True)])
    return {
        "view": view.name,
        "source": source.name,
        "monotone": bool((np.diff(away) >= 0).all() and (np.diff(towards) <= 0).all()),
        "whole_way": float(away[-1]),
        "largest_step_over_mean": float(steps.max() / max(steps.mean(), 1e-9)),
    }


def sources_for(view: View, sources: Sequence[View]) -> list[View]:
    return [source for source in sources if source.name != view.name]


def summarize(pairs: list[dict[str, Any]], sweeps: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the pairs of a view, and how many views and mixes are as they should be."""
    counted = [pair for pair in pairs if pair["unchanged"] >= LEAST_DISTANCE]
    views = {}
    for name in dict.fromkeys(pair["view"] for pair in counted):
        own = [pair for pair in counted if pair["view"] == name]
        views[name] = sum(pair["relit"] for pair in own) / sum(pair["unchanged"] for pair in own)
    there = [pair["at_source_own_light"] / pair["at_source_other_light"] for pair in counted]
    return {
        "pairs": len(pairs),
        "pairs_with_other_light": len(counted),
        "ratio_by_view": views,
        "ratio_mean": float(np.mean(list(views.values()))) if views else None,
        "ratio_by_pair": [pair["relit"] / pair["unchanged"] for pair in counted],
        "views_at_most_half": sum(ratio <= 0.5 for ratio in views.values()),
        "at_source_ratio_mean": float(np.mean(there)) if there else None,
        "same_geometry": all(pair["same_geometry"] for pair in pairs),
        "mixes": len(sweeps),
        "mixes_monotone": sum(one["monotone"] for one in sweeps),
        "largest_step_over_mean": max((one["largest_step_over_mean"] for one in sweeps), default=None),
    }


def draw(scene: wildgs.LoadedScene, views: Sequence[View], sources: Sequence[View], folder: Path) -> None:
    """A sheet of views under the sources' light, and one of mixes."""
    folder.mkdir(parents=True, exist_ok=True)
    size = (240, 180)
    looks = [scene.appearance(source.name) for source in sources]
    rows: list[list[np.ndarray | None]] = [[None, None, *(source.read_photo().numpy() for source in sources)]]
    mixes: list[list[np.ndarray | None]] = []
    for view in views:
        own = scene.appearance(view.name)
        relit = [scene.render(view.camera, look).numpy() for look in (own, *looks)]
        rows.append([view.read_photo().numpy(), *relit])
        other = looks[0] if looks[0] is not own else looks[-1]
        shares = (0.0, 0.25, 0.5, 0.75, 1.0)
        mixes.append(
            [scene.render(view.camera, wildgs.mix([own, other], [1 - s, s])).numpy() for s in shares]
        )
    captions = ["photo", "own light", *(source.name for source in sources)]
    contact_sheet(rows, captions, tile=size).save(folder / "transfer.png")
    contact_sheet(mixes, ["0", "0.25", "0.5", "0.75", "1"], tile=size).save(folder / "mix.png")


def style_picture(width: int = 480, height: int = 360, seed: int = 3) -> np.ndarray:
    """A painting of no place: patches of orange over violet, lit from the left, with brush strokes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / height
    seeds = rng.uniform(0, 1, (60, 2)) * [1, width / height]
    nearest = ((y[..., None] - seeds[:, 0]) ** 2 + (x[..., None] - seeds[:, 1]) ** 2).argmin(axis=-1)
    warm = rng.uniform(0, 1, 60)[nearest] * 0.4 + 0.6 * (y + 0.15 * np.sin(9 * x))
    violet, orange = np.array([70, 40, 130.0]), np.array([250, 150, 50.0])
    strokes = 1 + 0.12 * np.sin(60 * (x + 0.6 * y) + 7 * np.sin(5 * y))
    light = 1.15 - 0.35 * x[..., None] * height / width
    color = (violet + np.clip(warm, 0, 1)[..., None] * (orange - violet)) * strokes[..., None] * light
    return np.clip(color, 0, 255).astype(np.uint8)


def draw_style(scene: wildgs.LoadedScene, views: Sequence[View], folder: Path) -> None:
    """Views under the light of a picture that shows no place."""
    file = folder / "style.png"
    Image.fromarray(style_picture()).save(file)
    look = scene.appearance(file, like="auto")
    print(f"style: {look.note}")
    own = [scene.render(view.camera, scene.appearance(view.name)).numpy() for view in views]
    styled = [scene.render(view.camera, look).numpy() for view in views]
    rows = [[style_picture(), *own], [None, *styled]]
    captions = ["the picture", *(view.name for view in views)]
    contact_sheet(rows, captions, tile=(240, 180)).save(folder / "styled.png")


def main(command: Command) -> None:
    scene = wildgs.load(command.run)
    views = list(scene.scene.test_views)
    sources = different_lights(scene.scene.train_views, SOURCES)
    pairs = [compare(scene, view, source) for view in views for source in sources_for(view, sources)]
    sweeps = [sweep(scene, view, source) for view in views for source in sources_for(view, sources)[:1]]
    summary = summarize(pairs, sweeps)
    for name, ratio in summary["ratio_by_view"].items():
        print(f"{name}: relit / unchanged {ratio:.2f}")
    if summary["ratio_mean"] is not None:
        print(
            f"colour: mean ratio {summary['ratio_mean']:.2f}, at most 0.5 in {summary['views_at_most_half']} of"
            f" {len(summary['ratio_by_view'])} views ({summary['pairs_with_other_light']} pairs with another"
            f" light); pixel by pixel at the source's camera {summary['at_source_ratio_mean']:.2f}"
        )
    print(f"geometry: depth and alpha {'identical' if summary['same_geometry'] else 'DIFFER'} in all pairs")
    print(
        f"mix: monotone in {summary['mixes_monotone']} of {summary['mixes']}, largest step"
        f" {summary['largest_step_over_mean']:.2f} times the mean one"
    )
    if command.output is not None:
        content = {"run": command.run.name, "summary": summary, "pairs": pairs, "mixes": sweeps}
        command.output.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    if command.pictures is not None:
        draw(scene, views[:SHOWN], sources, command.pictures)
        draw_style(scene, views[:3], command.pictures)


if __name__ == "__main__":
    main(tyro.cli(Command))
