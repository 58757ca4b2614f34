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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

import wildgs
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.priors.measured_displacements import scene_covariance
from wildgs.scene import DataConfig, load_scene

SIDE = 320
LARGEST = 2.0
LEAST_PHOTOS = 6


@dataclass(frozen=True)
class Observations:
    """Where photos show points.

    Attributes:
        photo: Row of the training photo.
        point: Id of the point.
        displacement: Displacement of the photo there, pixels.
        residual: Residual of structure from motion, pixels.
        motion: Movement in the photo per movement of the point.
    """

    photo: Int[np.ndarray, " K"]
    point: Int[np.ndarray, " K"]
    displacement: Float[np.ndarray, "K 2"]
    residual: Float[np.ndarray, "K 2"]
    motion: Float[np.ndarray, "K 2 3"]


def observations(scene: Path, run: Path) -> Observations:
    """All observations of points in the training photos of a run."""
    names = [view.name for view in wildgs.load(run).scene.train_views]
    state = load_checkpoint(list_checkpoints(run / "checkpoints")[-1]).state
    if "warps.grids" not in state:
        raise SystemExit(f"{run}: photos were not displaced")
    grids = state["warps.grids"].numpy()
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    images = {image.name: image for image in model.images.values()}
    rows = [
        (photo, *entry)
        for photo, name in enumerate(names)
        for entry in _of(model, images[name], grids[photo])
    ]
    return Observations(*(np.array(column) for column in zip(*rows, strict=True)))


def _of(
    model: pycolmap.Reconstruction, image: pycolmap.Image, grid: Float[np.ndarray, "2 G G"]
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    camera, pose = model.cameras[image.camera_id], image.cam_from_world()
    scale = SIDE / max(camera.width, camera.height)
    for seen in image.points2D:
        if not seen.has_point3D():
            continue
        x, y, z = place = pose * model.points3D[seen.point3D_id].xyz
        pixel = camera.img_from_cam(place) if z > 0 else None
        if pixel is None or not (0 <= pixel[0] < camera.width and 0 <= pixel[1] < camera.height):
            continue
        cell = pixel / (camera.width, camera.height) * grid.shape[1] - 0.5
        found = [map_coordinates(axis, cell[::-1, None], order=1, mode="nearest")[0] for axis in grid]
        projection = np.array([[1, 0, -x / z], [0, 1, -y / z]]) * camera.mean_focal_length() / z
        motion = scale * projection @ pose.rotation.matrix()
        yield seen.point3D_id, SIDE * np.array(found), scale * (seen.xy - pixel), motion


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
        seen = observations(arguments.scene, run)
        near = np.linalg.norm(seen.residual, axis=1) < LARGEST
        moved, measured = seen.displacement[near], seen.residual[near]
        rms = [np.sqrt((values**2).sum(axis=1).mean()) for values in (moved, measured)]
        signs = np.random.default_rng(0).choice([-1, 1], seen.photo.max() + 1)[seen.photo]
        print(
            f"{run}: {len(moved):,} observations, displacements {rms[0]:.2f} px, residuals {rms[1]:.2f} px, "
            f"correlation {np.corrcoef(moved.ravel(), measured.ravel())[0, 1]:.2f}; moved points explain "
            f"{explained(seen, seen.displacement):.2f}, of photos turned around "
            f"{explained(seen, seen.displacement * signs[:, None]):.2f}"
        )


if __name__ == "__main__":
    main()
