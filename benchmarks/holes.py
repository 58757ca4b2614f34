"""How much of the picture is transparent along a path through a scene, so that the black background shows.

    python benchmarks/holes.py RUN RUN ... --path training

For each run: the mean over the frames of the path, and the largest, of the share of pixels whose accumulated alpha
is below a limit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from wildgs.rasterize import blend
from wildgs.runs import load_run
from wildgs.scene.trajectories import AROUND, make_path, usual_size

LEAST_ALPHA = 0.8


@torch.no_grad()
def transparent_shares(folder: Path, path: str, frames: int) -> list[float]:
    """Share of transparent pixels in each frame."""
    run = load_run(folder)
    scene = run.read_scene()
    cameras = make_path(scene, path, frames=frames, size=usual_size(scene.views))
    gaussians = run.method.gaussians
    device = gaussians.means.device
    alphas = (blend(gaussians.project(camera.to(device)), None).alpha for camera in cameras)
    return [float((alpha < LEAST_ALPHA).float().mean()) for alpha in alphas]


def main() -> None:
    """Prints a line per run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--path", choices=[*AROUND], default="training")
    parser.add_argument("--frames", type=int, default=24)
    given = parser.parse_args()
    for folder in given.runs:
        shares = transparent_shares(folder, given.path, given.frames)
        print(
            f"{folder}: {100 * sum(shares) / len(shares):.2f}% of the pixels, {100 * max(shares):.1f}% at most"
        )


if __name__ == "__main__":
    main()
