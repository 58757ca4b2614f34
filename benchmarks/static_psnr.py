"""PSNR over the pixels of held-out photos that show something static, and over those that show passers-by.

    python benchmarks/static_psnr.py RUN_WITH_MASKS OTHER_RUN ...

Held-out photos of real collections show passers-by, too, and renders from which they have disappeared lose PSNR by
that. The mask M of the first run tells static pixels (M > 0.5) for all runs, which must have been scored by
`wildgs eval` with the same split and size. In protocol half only the right halves count.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image

import wildgs
from wildgs.library.loaded import LoadedScene

FEWEST = 20
"""Photos with fewer pixels of passers-by do not count for these."""


def psnr(
    render: Float[np.ndarray, "H W 3"], photo: Float[np.ndarray, "H W 3"], where: Bool[np.ndarray, "H W"]
) -> float:
    """Decibels over the pixels of `where`."""
    return float(-10 * np.log10(((render - photo)[where] ** 2).mean()))


def score(
    run: Path, protocol: str, judge: LoadedScene, photos: dict[str, Path]
) -> tuple[list[float], list[float]]:
    """PSNR of static pixels and of passers-by, by photo."""
    static, transient = [], []
    for path in sorted((run / "eval" / protocol).glob("*.png")):
        if path.stem not in photos:
            continue
        render = np.asarray(Image.open(path).convert("RGB"), np.float32) / 255
        height, width = render.shape[:2]
        resized = (
            Image.open(photos[path.stem]).convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
        )
        photo = np.asarray(resized, np.float32) / 255
        visibility = judge.run.method.visibility(torch.from_numpy(photo))
        if visibility is None:
            raise SystemExit("the first run has no masks")
        shown = visibility.detach().numpy() > 0.5
        counts = np.ones_like(shown)
        if protocol == "half":
            counts[:, : width // 2] = False
        static.append(psnr(render, photo, shown & counts))
        if (~shown & counts).sum() >= FEWEST:
            transient.append(psnr(render, photo, ~shown & counts))
    return static, transient


def main() -> None:
    """Prints a line per protocol and run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders, first the one whose masks are used")
    parser.add_argument("--scene", type=Path, required=True, help="scene folder with images/")
    options = parser.parse_args()
    judge = wildgs.load(options.runs[0])
    photos = {path.stem: path for path in (options.scene / "images").iterdir()}
    for protocol in ("full", "half"):
        for run in options.runs:
            static, transient = score(run, protocol, judge, photos)
            rest = f"{np.mean(transient):.2f} dB ({len(transient)} photos)" if transient else "none"
            print(
                f"{protocol}  {run}: static {np.mean(static):.2f} dB ({len(static)} photos), passers-by {rest}"
            )


if __name__ == "__main__":
    main()
