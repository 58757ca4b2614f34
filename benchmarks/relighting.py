"""Views of the generated landmark under the light of training photos, against the rendered truth.

    python benchmarks/relighting.py landmark102 --photos 102 --long-side 480 --seed 7
    wildgs train landmark102 --output runs/landmark --downscale 2 --steps 1500
    python benchmarks/relighting.py landmark102 runs/landmark --photos 102 --long-side 480 --seed 7

The first call renders the scene, with other photographers, lights and passers-by than the demo's if the seed is
another, and the truth: every held-out viewpoint in the light, exposure and camera response of one training photo,
without passers-by. No training photo shows this viewpoint, and no photo at all shows it in this light. Runs are
scored on the whole picture, on the place without the sky, whose clouds another viewpoint cannot know, and, for
comparison, at the training photos' own viewpoints.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

import wildgs
from demo_generator.photos import SyntheticConfig, find_split, make_landmark, relit_photo
from wildgs.evaluation.metrics import psnr

FOLDER = "truth/relit"


@dataclass(frozen=True)
class Command:
    """Scores relighting against the truth."""

    scene: tyro.conf.Positional[Path]
    """Scene folder; rendered if it does not exist."""
    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Runs that were trained on it."""
    photos: int = 102
    """Number of photos."""
    long_side: int = 480
    """Longer side of the photos, pixels."""
    seed: int = 7
    """Photographers, hours, clocks, cameras and passers-by."""
    test_every: int = 8
    """One photo in so many is held out."""


def main(command: Command) -> None:
    """Renders what is missing, then scores the runs."""
    config = SyntheticConfig(
        photos=command.photos, long_side=command.long_side, seed=command.seed, test_every=command.test_every
    )
    if not command.scene.exists():
        make_landmark(
            command.scene, config, lambda done, total: print(f"rendered {done} of {total}", end="\r")
        )
    render_truth(command.scene, config)
    for run in command.runs:
        print(f"{run}: {score(run, command.scene, config)}", flush=True)


def pairs(config: SyntheticConfig) -> Iterator[tuple[int, int]]:
    """Every held-out viewpoint with one training photo's light; the lights are spread over the collection."""
    split = find_split(config)
    for number, view in enumerate(split["test"]):
        yield view, split["train"][(number * len(split["train"])) // len(split["test"])]


def render_truth(scene: Path, config: SyntheticConfig) -> None:
    """Renders the truth of all pairs, unless it is complete."""
    folder, partial = scene / FOLDER, scene / (FOLDER + ".partial")
    if folder.exists():
        return
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for view, light in pairs(config):
        pixels, place = relit_photo(view, light, config)
        Image.fromarray(pixels).save(partial / f"{view:02d}_under_{light:02d}.png")
        Image.fromarray(np.where(place, 255, 0).astype(np.uint8)).save(partial / f"{view:02d}_place.png")
        print(f"viewpoint {view} in the light of photo {light}", flush=True)
    partial.rename(folder)


def score(run: Path, scene: Path, config: SyntheticConfig) -> str:
    """Mean PSNR of a run: relit views, their place, and training photos at their own viewpoints."""
    session = wildgs.load(run)
    cameras = {view.name: view for view in session.scene.views}
    whole, place, own = [], [], []
    for view, light in pairs(config):
        source = f"landmark_{light:02d}.jpg"
        look = session.appearance(source)
        picture = session.render(cameras[f"landmark_{view:02d}.jpg"].camera, look)
        size = picture.shape[1], picture.shape[0]
        with Image.open(scene / FOLDER / f"{view:02d}_under_{light:02d}.png") as file:
            truth = torch.from_numpy(np.array(file.resize(size, Image.Resampling.LANCZOS)))
        with Image.open(scene / FOLDER / f"{view:02d}_place.png") as file:
            solid = torch.from_numpy(np.array(file.resize(size, Image.Resampling.BOX)) > 127)
        whole.append(psnr(picture, truth))
        place.append(psnr(picture, truth, solid))
        own.append(psnr(session.render(cameras[source].camera, look), cameras[source].read_photo()))
    means = [float(np.mean(values)) for values in (whole, place, own)]
    return "relit {:.2f} dB, without the sky {:.2f}; training photos {:.2f}".format(*means)


if __name__ == "__main__":
    main(tyro.cli(Command))
