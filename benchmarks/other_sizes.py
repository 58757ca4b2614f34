"""Are renders of other sizes than the trained one right? PSNR and detail of held-out views, smaller and larger.

    python benchmarks/other_sizes.py RUN OTHER_RUN ... --scene SCENE

Each held-out photo (its clean picture in truth/clean, if the scene has one) is resized to the training size times
each factor, and compared with a render of that size under the photo's own appearance, which the run encodes at the
training size. A low-pass filter that enlarges small Gaussians shows as too little detail (below 1) in small
renders, Gaussians without a filter as too much.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import wildgs
from wildgs.evaluation.metrics import detail, psnr
from wildgs.library.loaded import LoadedScene
from wildgs.scene.scene import View


def truth_of(folder: Path, view: View) -> Image.Image:
    """The clean picture of a held-out photo, or the photo."""
    clean = (folder / "truth" / "clean" / view.name).with_suffix(".png")
    return Image.open(clean if clean.exists() else folder / "images" / view.name).convert("RGB")


def score(run: LoadedScene, folder: Path, factor: float) -> np.ndarray:
    """PSNR, energy and correlation of the detail, averaged over the held-out views."""
    scores = []
    for view in (view for view in run.views if view.split == "test"):
        size = [max(1, round(side * factor)) for side in (view.camera.width, view.camera.height)]
        truth = torch.from_numpy(np.array(truth_of(folder, view).resize(size, Image.Resampling.LANCZOS)))
        render = run.render(view.camera.resized(*size), run.appearance(view.name))
        found = detail(render, truth)
        scores.append((float(psnr(render, truth)), found.energy, found.correlation))
    return np.mean(scores, axis=0)


def main() -> None:
    """Prints a line per run and factor."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--scene", type=Path, required=True, help="scene folder with images/")
    parser.add_argument("--factors", type=float, nargs="+", default=[0.25, 0.5, 1.0, 2.0])
    options = parser.parse_args()
    for path in options.runs:
        run = wildgs.load(path)
        for factor in options.factors:
            decibels, energy, correlation = score(run, options.scene, factor)
            print(f"{path}  x {factor:g}: {decibels:.2f} dB, detail {energy:.2f} at {correlation:.3f}")


if __name__ == "__main__":
    main()
