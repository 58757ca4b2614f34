"""Upper bound of the detail measures that the noise of the ground truth leaves.

    python benchmarks/detail_bound.py SCENE [RUN ...]

A held-out photo and its clean ground truth show the same static scene with noise of their own (path tracing,
sensor, compression). Where neither shows a passer-by, their correlation is the product of how well each of them
correlates with the noiseless scene. If both are equally noisy, a render without any error reaches its square root,
both as its correlation with the ground truth and as the share of the ground truth's detail that it has. Runs must
have been scored by `wildgs eval --protocol full`; the measures of their renders are of the same pixels, and are
divided by the bound to compare them with the noiseless scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from scipy.ndimage import binary_erosion
from torch import Tensor

from wildgs.evaluation.metrics import detail
from wildgs.scene.split import find_split_file, read_split

MARGIN = 5
"""Pixels around passers-by that do not count; the high-pass filter reaches as far."""


def picture(path: Path, size: tuple[int, int]) -> UInt8[Tensor, "H W 3"]:
    """An image at (width, height)."""
    resized = Image.open(path).convert("RGB").resize(size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(resized))


def static_pixels(path: Path, size: tuple[int, int]) -> Bool[Tensor, "H W"]:
    """Pixels of the static scene away from passers-by."""
    mask = np.asarray(Image.open(path).convert("L").resize(size, Image.Resampling.NEAREST)) > 127
    return torch.from_numpy(binary_erosion(mask, iterations=MARGIN, border_value=1))


def held_out(scene: Path) -> list[str]:
    """Names of the photos that the scene's split file holds out."""
    split = find_split_file(scene)
    if split is None:
        raise SystemExit(f"{scene}: no split file")
    return [name for name, part in read_split(split).items() if part == "test"]


def compare(scene: Path, names: list[str], renders: Path | None, width: int) -> tuple[float, float]:
    """Mean energy and correlation of the photos' detail, or of renders', against the clean ground truth."""
    found = []
    for name in names:
        stem = Path(name).stem
        clean = scene / "truth" / "clean" / f"{stem}.png"
        full = Image.open(clean).size
        longest = max(full)
        size = (round(full[0] * width / longest), round(full[1] * width / longest))
        shown = scene / "images" / name if renders is None else renders / f"{stem}.png"
        keep = static_pixels(scene / "truth" / "masks" / f"{stem}.png", size)
        found.append(detail(picture(shown, size), picture(clean, size), keep))
    energies, correlations = zip(*found, strict=True)
    return float(np.mean(energies)), float(np.mean(correlations))


def main() -> None:
    """Prints the bound, and each run against it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene folder with truth/clean and truth/masks")
    parser.add_argument("runs", type=Path, nargs="*", help="run folders")
    parser.add_argument("--width", type=int, default=480, help="length of the longer side (pixels)")
    options = parser.parse_args()
    names = held_out(options.scene)
    energy, correlation = compare(options.scene, names, None, options.width)
    bound = correlation**0.5
    print(
        f"photo against ground truth: energy {energy:.3f}, correlation {correlation:.3f}; bound {bound:.3f}"
    )
    for run in options.runs:
        energy, correlation = compare(options.scene, names, run / "eval" / "full", options.width)
        print(
            f"{run}: energy {energy:.3f} ({energy / bound:.3f} of the bound), "
            f"correlation {correlation:.3f} ({correlation / bound:.3f})"
        )


if __name__ == "__main__":
    main()
