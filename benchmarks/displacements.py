"""Are photos where their cameras say, and do displacements found in training agree with structure from motion?

    python benchmarks/displacements.py SCENE [RUN ...]

Residuals of structure from motion, where a photo shows a point less where its camera projects it, are partly noise
of the detector and partly displacements of the photo, which neighbours have in common. Printed are the share of the
variance that they have in common, its root mean square in pixels of photos whose longer side has 320, and the
distance at which it falls to exp(-1/2). Photos are displaced if the share is at least `--warp.least-share`.

For each run, whose photos must have been displaced: the numbers of observations, root mean squares of displacements
and residuals (at most 2 pixels) there, and their correlation. With `--warp.no-residuals`, registration with renders
knows nothing of residuals, so that the two agree only if the photos really are there. Then, over points that six
photos or more observe, the share of the displacements that moving the points explains, and the same after those of
photos chosen at random have been turned around. Were scene and photos to drift together, the first share would be
larger.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from torch import Tensor

from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.priors.measured_displacements import scene_covariance
from wildgs.scene import DataConfig, Scene, View, load_scene

SIDE = 320
LEAST_PHOTOS = 6


@dataclass(frozen=True)
class Observations:
    """Points in photos.

    Attributes:
        photo: Row of the training photo.
        point: Row of the point.
        displacement: Displacement of the photo there, pixels.
        motion: Movement in the photo per movement of the point.
    """

    photo: Int[np.ndarray, " K"]
    point: Int[np.ndarray, " K"]
    displacement: Float[np.ndarray, "K 2"]
    motion: Float[np.ndarray, "K 2 3"]


def read_grids(scene: Scene, run: Path) -> Float[np.ndarray, "V 2 G G"]:
    """Displacements of the training photos at the end of a run, pixels."""
    state = load_checkpoint(list_checkpoints(run / "checkpoints")[-1]).state
    if "warps.grids" not in state:
        raise SystemExit(f"{run}: photos were not displaced")
    if len(state["warps.grids"]) != len(scene.train_views):
        raise SystemExit(f"{run} was trained on other photos than those of {scene.root}")
    return SIDE * state["warps.grids"].numpy()


def sampled(grid: Float[np.ndarray, "2 G G"], view: View, places: Float[Tensor, "K 2"]) -> np.ndarray:
    """Displacements at places (x, y) in units of the photo's longer side."""
    camera = view.camera
    size = torch.tensor([camera.width, camera.height]) / max(camera.width, camera.height)
    cells = (places / size * grid.shape[1] - 0.5).numpy().T[::-1]
    return np.stack([map_coordinates(axis, cells, order=1, mode="nearest") for axis in grid], axis=1)


def at_residuals(scene: Scene, grids: Float[np.ndarray, "V 2 G G"]) -> tuple[np.ndarray, np.ndarray]:
    """Displacements and residuals of all observations with a residual, pixels."""
    found = [
        (sampled(grid, view, residuals.places), SIDE * residuals.offsets.numpy())
        for view, grid in zip(scene.train_views, grids, strict=True)
        if len((residuals := scene.residuals[view.name]).places)
    ]
    moved, measured = (np.concatenate(part) for part in zip(*found, strict=True))
    return moved, measured


def observations(scene: Scene, grids: Float[np.ndarray, "V 2 G G"]) -> Observations:
    """All points that training photos observe, inside the photos."""
    rows = {view.name: row for row, view in enumerate(scene.train_views)}
    parts = []
    for number, view in enumerate(scene.views):
        points = scene.observations[scene.observations[:, 0] == number, 1].long()
        pixels, depth = view.camera.project(scene.points[points])
        size = torch.tensor([view.camera.width, view.camera.height])
        inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
        if view.name not in rows or not inside.any():
            continue
        points, pixels, depth = points[inside], pixels[inside], depth[inside]
        side, row = max(view.camera.width, view.camera.height), rows[view.name]
        x, y = ((pixels - view.camera.K[:2, 2]) / view.camera.K.diagonal()[:2]).unbind(dim=1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        slopes = torch.stack([one, zero, -x, zero, one, -y], dim=1).view(-1, 2, 3)
        scale = SIDE / side * view.camera.K.diagonal()[:2, None] / depth[:, None, None]
        motion = scale * slopes @ view.camera.viewmat[:3, :3]
        displacement = sampled(grids[row], view, pixels / side)
        parts.append((np.full(len(points), row), points.numpy(), displacement, motion.numpy()))
    return Observations(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def explained(seen: Observations, displacement: Float[np.ndarray, "K 2"]) -> float:
    """Share of the squares of displacements that the best movement of each point explains."""
    order = np.argsort(seen.point, kind="stable")
    total, left = 0.0, 0.0
    for rows in np.split(order, np.unique(seen.point[order], return_index=True)[1][1:]):
        if len(rows) >= LEAST_PHOTOS:
            design, target = seen.motion[rows].reshape(-1, 3), displacement[rows].reshape(-1)
            error = target - design @ np.linalg.lstsq(design, target)[0]
            total, left = total + float(target @ target), left + float(error @ error)
    return 1 - left / total


def main() -> None:
    """Prints a line for each run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scene", type=Path, help="COLMAP scene")
    parser.add_argument("runs", type=Path, nargs="*", help="runs trained on it with displaced photos")
    arguments = parser.parse_args()
    scene = load_scene(arguments.scene, DataConfig(max_side=SIDE))
    found = scene_covariance(scene.train_views, scene.residuals)
    if found is None:
        print(f"{arguments.scene}: too few residuals")
    else:
        common = SIDE * (2 * found.common) ** 0.5
        print(
            f"{arguments.scene}: share in common {found.share:.3f}, {common:.2f} px within "
            f"{SIDE * found.length:.0f} px"
        )
    for run in arguments.runs:
        grids = read_grids(scene, run)
        moved, measured = at_residuals(scene, grids)
        rms = [np.sqrt((values**2).sum(axis=1).mean()) for values in (moved, measured)]
        seen = observations(scene, grids)
        signs = np.random.default_rng(0).choice([-1, 1], seen.photo.max() + 1)[seen.photo]
        print(
            f"{run}: {len(moved):,} observations, displacements {rms[0]:.2f} px, residuals {rms[1]:.2f} px, "
            f"correlation {np.corrcoef(moved.ravel(), measured.ravel())[0, 1]:.2f}; moved points explain "
            f"{explained(seen, seen.displacement):.2f}, of photos turned around "
            f"{explained(seen, seen.displacement * signs[:, None]):.2f}"
        )


if __name__ == "__main__":
    main()
