"""What a run owes to its seed: errors of the mean of several runs' renders against those of the runs.

    python benchmarks/seeds.py SCENE RUN RUN ...

The runs must differ in nothing but their seed, and must have been scored by `wildgs eval --protocol full`. What
their renders have in common is left in the mean; what differs between them is divided by their number. Then the
detail of the mean, if every block of the renders is moved to where it correlates best with the photo: an upper
bound of what better cameras and lenses of the held-out photos would gain. Errors are against the clean ground
truth where there is one, else the photo.
"""

from __future__ import annotations

import argparse
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import gaussian_filter, shift
from torch import Tensor

from detail_bound import held_out
from wildgs.evaluation.metrics import DETAIL_SIGMA, detail

BLOCK = 48
"""Side of a block that is moved, in pixels."""
SHIFTS = np.arange(-1.5, 1.51, 0.5)
"""Tried shifts along each axis, in pixels."""
SCALES = (0.7, 1.5, 3.0, 6.0, 12.0, 24.0)
"""Standard deviations of the Gaussian filters that separate the scales, in pixels."""

Picture = Float[np.ndarray, "H W 3"]


def read(path: Path, size: tuple[int, int] | None = None) -> Picture:
    """An image in [0, 1], at (width, height)."""
    image = Image.open(path).convert("RGB")
    if size is not None:
        image = image.resize(size, Image.Resampling.LANCZOS)
    return np.asarray(image, np.float64) / 255


def as_bytes(picture: Picture) -> Tensor:
    """The image as it is stored."""
    return torch.from_numpy((picture * 255).round().clip(0, 255).astype(np.uint8))


def score(render: Picture, truth: Picture) -> tuple[float, float, float]:
    """PSNR, and energy and correlation of detail."""
    found = detail(as_bytes(render), as_bytes(truth))
    psnr = -10 * np.log10(((render - truth) ** 2).mean())
    return float(psnr), found.energy or 0.0, found.correlation or 0.0


def by_scale(error: Picture) -> Float[np.ndarray, " S"]:
    """Mean square of an error at each scale, from the finest to the coarsest."""
    levels = [error, *(gaussian_filter(error, (sigma, sigma, 0)) for sigma in SCALES)]
    differences = [fine - coarse for fine, coarse in pairwise(levels)]
    return np.array([(part**2).mean() for part in (*differences, levels[-1])])


def aligned(render: Picture, truth: Picture) -> Picture:
    """The render with every block moved to where its high frequencies correlate best with the ground truth's."""
    fine, true = (
        picture.mean(axis=2) - gaussian_filter(picture.mean(axis=2), DETAIL_SIGMA)
        for picture in (render, truth)
    )
    moves = list(product(SHIFTS, SHIFTS))
    details = [shift(fine, move, order=3, mode="nearest") for move in moves]
    pictures = [shift(render, (*move, 0), order=3, mode="nearest") for move in moves]
    result = render.copy()
    for top, left in product(range(0, render.shape[0], BLOCK), range(0, render.shape[1], BLOCK)):
        block = (slice(top, top + BLOCK), slice(left, left + BLOCK))
        fits = [(d[block] * true[block]).sum() / max(np.linalg.norm(d[block]), 1e-9) for d in details]
        result[block] = pictures[int(np.argmax(fits))][block]
    return result


def main() -> None:
    """Prints scores, and error and variance by scale."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene folder with images/ and a split file")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    options = parser.parse_args()
    if len(options.runs) < 2:
        parser.error("two runs or more are needed")
    rows: dict[str, list[tuple[float, float, float]]] = {"one run": [], "their mean": [], "aligned": []}
    errors, variances = [], []
    for name in held_out(options.scene):
        stem = Path(name).stem
        renders = np.stack([read(run / "eval" / "full" / f"{stem}.png") for run in options.runs])
        clean = options.scene / "truth" / "clean" / f"{stem}.png"
        path = clean if clean.exists() else options.scene / "images" / name
        truth, mean = read(path, (renders.shape[2], renders.shape[1])), renders.mean(axis=0)
        singles = np.mean([score(render, truth) for render in renders], axis=0)
        rows["one run"].append((float(singles[0]), float(singles[1]), float(singles[2])))
        rows["their mean"].append(score(mean, truth))
        rows["aligned"].append(score(aligned(mean, truth), truth))
        errors.append(np.mean([by_scale(render - truth) for render in renders], axis=0))
        parts = np.sum([by_scale(render - mean) for render in renders], axis=0)
        variances.append(parts / (len(renders) - 1))
    for label, scores in rows.items():
        psnr, energy, correlation = np.mean(scores, axis=0)
        print(f"{label:10s}  PSNR {psnr:.2f}  detail {energy:.2f} at {correlation:.3f}")
    limits = pairwise((0, *SCALES, "inf"))
    print("scale     " + " ".join(f"{low:>4}-{high:<4}" for low, high in limits))
    for label, values in (("error", errors), ("variance", variances)):
        print(f"{label:10s}" + " ".join(f"{1e5 * value:9.1f}" for value in np.mean(values, axis=0)))


if __name__ == "__main__":
    main()
