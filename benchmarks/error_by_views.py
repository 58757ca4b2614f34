"""Error of held-out renders by the number of training photos that see what a pixel shows.

    python benchmarks/error_by_views.py SCENE RUN ...

The number of photos of a Gaussian is the effective one, (sum w)^2 / sum w^2 over its blending weights w in the
training photos; that of a pixel is the mean over the Gaussians blended there. Each column has the share of pixels
and the part of the mean squared error (times 1e5) that they contribute. Runs must have been scored by
`wildgs eval --protocol full`. Errors are against the clean ground truth where there is one, else the photo.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

import wildgs
from wildgs.engine.photo_counts import blending_weights
from wildgs.geometry.camera import Camera
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import blend

LIMITS = (0.0, 1.0, 3.0, 6.0, 12.0, 24.0, float("inf"))
LEAST_WEIGHT = 1.0
"""Sum of blending weights over all training photos, below which a Gaussian counts as seen by none."""


def number_of_views(gaussians: Gaussians, cameras: Iterable[Camera]) -> Float[Tensor, " N"]:
    """Effective number of views of each Gaussian."""
    total, squares = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    for camera in cameras:
        weights = blending_weights(gaussians, camera)
        total += weights
        squares += weights.square()
    return torch.where(total < LEAST_WEIGHT, 0.0, total.square() / squares.clamp_min(1e-9))


def squared_error(render: Path, truth: Path) -> Float[np.ndarray, "H W"]:
    """Squared error of a render, mean over colour channels."""
    drawn = Image.open(render).convert("RGB")
    true = Image.open(truth).convert("RGB").resize(drawn.size, Image.Resampling.LANCZOS)
    return ((np.asarray(drawn, np.float64) - np.asarray(true, np.float64)) ** 2).mean(axis=2) / 255**2


@torch.no_grad()
def by_views(run: Path, scene: Path) -> list[tuple[float, float]]:
    """Share of pixels and contribution to the mean squared error for each interval of `LIMITS`."""
    loaded = wildgs.load(run)
    gaussians, photos = loaded.gaussians, loaded.scene
    seen = number_of_views(gaussians, (view.camera for view in photos.train_views))
    columns: list[list[tuple[float, float]]] = [[] for _ in LIMITS[1:]]
    for view in photos.test_views:
        render = run / "eval" / "full" / f"{Path(view.name).stem}.png"
        clean = scene / "truth" / "clean" / render.name
        error = squared_error(render, clean if clean.exists() else scene / "images" / view.name)
        views = blend(gaussians.project(view.camera), seen[:, None].expand(-1, 3)).colors[..., 0].numpy()
        for column, low, high in zip(columns, LIMITS, LIMITS[1:], strict=False):
            inside = (views >= low) & (views < high)
            column.append((float(inside.mean()), float((error * inside).mean())))
    return [(share, error) for share, error in np.mean(columns, axis=1).tolist()]


def main() -> None:
    """Prints two lines per run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene folder with images/")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    options = parser.parse_args()
    print("views      " + " ".join(f"{low:>4.0f}-{high:<4.0f}" for low, high in pairwise(LIMITS)))
    for run in options.runs:
        table = by_views(run, options.scene)
        print(run)
        print("  pixels   " + " ".join(f"{share:9.3f}" for share, _ in table))
        print("  error    " + " ".join(f"{1e5 * error:9.2f}" for _, error in table))


if __name__ == "__main__":
    main()
