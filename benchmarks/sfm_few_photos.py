"""Structure from motion of a few photos of a collection, compared with the collection's own poses and points.

    python benchmarks/sfm_few_photos.py ../shared/data/longchamp --photos 16 --choices 1 2 3 --seeds 0 10

`--choices` are seeds of the random choice of photos, `--seeds` those of structure from motion. For every run: the
photos with a pose, the points, and, after the similarity that fits the points of the collection best to those of
the run,

- error: distance between where a photo shows the collection's points and where its camera in the run projects them,
  in percent of the longer side; median over points, then over photos, and the 90th percentile over photos;
- cameras: the same between where its camera in the collection projects them and where that in the run does, which
  has no error of features;
- focal: absolute logarithm of the ratio of the focal lengths, median and largest.

The last line has means over the runs, of logarithms for the errors.
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import tyro

import wildgs
from wildgs.errors import UserError, WildGSWarning
from wildgs.sfm import reconstruction
from wildgs.sfm.config import SfmConfig

NEAR = 1.5
"""Largest distance between keypoints of the two models that are taken for the same, pixels."""

LEAST_COMMON = 20
"""Smallest number of points in common for a comparison."""


@dataclass(frozen=True)
class Command:
    """Compares structure from motion of few photos with that of many."""

    scene: tyro.conf.Positional[Path]
    """Scene with images/ and sparse/0/ (undistorted)."""
    photos: int = 16
    """Number of photos."""
    choices: tuple[int, ...] = (1, 2, 3)
    """Seeds of the choice of photos."""
    seeds: tuple[int, ...] = (0, 10)
    """Seeds of structure from motion."""


@dataclass(frozen=True)
class Score:
    """Result of a run; see the module's text."""

    registered: int
    points: int
    error: float
    worst_error: float
    cameras: float
    worst_cameras: float
    focal: float
    worst_focal: float

    def __str__(self) -> str:
        return (
            f"{self.registered} photos, {self.points} points, error {self.error:.2f}% ({self.worst_error:.2f}%),"
            f" cameras {self.cameras:.3f}% ({self.worst_cameras:.3f}%),"
            f" focal {self.focal:.2f} ({self.worst_focal:.2f})"
        )


class Kept:
    """Keeps the model of `wildgs.reconstruct` as it is before the photos are undistorted."""

    def __init__(self) -> None:
        self.model: Any = None
        self._write = reconstruction._write_scene
        reconstruction._write_scene = self._keep

    def _keep(self, work: Any, copies: Any, model: Any) -> None:
        self.model = pycolmap.Reconstruction(model)
        names = {copy.work_name: copy.scene_name for copy in copies}
        for image in self.model.images.values():
            image.name = names.get(image.name, image.name)
        self._write(work, copies, model)


def side(camera: Any) -> int:
    """Longer side, pixels."""
    return max(camera.width, camera.height)


def seen(model: Any, image: Any) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and positions of an image's points."""
    points = [point for point in image.points2D if point.has_point3D()]
    places = np.array([point.xy for point in points]).reshape(-1, 2)
    return places, np.array([model.point3D(point.point3D_id).xyz for point in points]).reshape(-1, 3)


def common_photos(truth: Any, found: Any) -> Iterator[tuple[Any, Any]]:
    """Photos with a pose in both models."""
    ours = {Path(image.name).stem: image for image in found.images.values() if image.has_pose}
    for image in truth.images.values():
        other = ours.get(Path(image.name).stem)
        if image.has_pose and other is not None:
            yield image, other


def common_points(truth: Any, found: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions in both models of points with nearly the same keypoint in a photo."""
    pairs = []
    for image, other in common_photos(truth, found):
        (places, points), (our_places, our_points) = seen(truth, image), seen(found, other)
        if not len(places) or not len(our_places):
            continue
        scaled = places * side(other.camera) / side(image.camera)
        distances = np.linalg.norm(scaled[:, None] - our_places[None], axis=2)
        rows = np.flatnonzero(distances.min(axis=1) < NEAR)
        pairs.append((points[rows], our_points[distances[rows].argmin(axis=1)]))
    if not pairs:
        return np.zeros((0, 3)), np.zeros((0, 3))
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])


def moved(similarity: Any, points: np.ndarray) -> np.ndarray:
    """Points after a similarity."""
    return similarity.scale * points @ similarity.rotation.matrix().T + similarity.translation


def fit(source: np.ndarray, target: np.ndarray) -> Any:
    """The similarity with the smallest median distance (least median of squares), refined on its inliers."""
    random = np.random.default_rng(0)
    samples = (random.choice(len(source), 3, replace=False) for _ in range(400))
    trials = [pycolmap.estimate_sim3d(source[rows], target[rows]) for rows in samples]
    errors = [np.linalg.norm(moved(t, source) - target, axis=1) for t in trials if t is not None]
    best = min(errors, key=lambda error: float(np.median(error)))
    inliers = best < 3 * np.median(best) + 1e-9
    return pycolmap.estimate_sim3d(source[inliers], target[inliers])


def compare(truth: Any, found: Any) -> Score | None:
    """Compares two models; None if they have hardly any points in common."""
    common = common_points(truth, found)
    if len(common[0]) < LEAST_COMMON:
        print(f"only {len(common[0])} points in common")
        return None
    similarity = fit(*common)
    errors, between, focals = [], [], []
    for image, other in common_photos(truth, found):
        places, points = seen(truth, image)
        if not len(points):
            continue
        inside = other.cam_from_world() * moved(similarity, points)
        pixels = np.where(inside[:, 2:] > 0, other.camera.img_from_cam(inside), 1e6)
        scaled = places * side(other.camera) / side(image.camera)
        error = np.median(np.linalg.norm(pixels - scaled, axis=1)) / side(other.camera)
        errors.append(100 * min(float(error), 1.0))
        exact = image.camera.img_from_cam(image.cam_from_world() * points)
        exact *= side(other.camera) / side(image.camera)
        distance = np.median(np.linalg.norm(pixels - exact, axis=1)) / side(other.camera)
        between.append(100 * min(float(distance), 1.0))
        lengths = [each.camera.mean_focal_length() / side(each.camera) for each in (image, other)]
        focals.append(abs(float(np.log(lengths[1] / lengths[0]))))
    return Score(
        len(errors),
        found.num_points3D(),
        float(np.median(errors)),
        float(np.quantile(errors, 0.9)),
        float(np.median(between)),
        float(np.quantile(between, 0.9)),
        float(np.median(focals)),
        max(focals),
    )


def run(files: list[Path], truth: Any, seed: int, kept: Kept) -> Score | None:
    """Reconstructs some photos; None if they do not match."""
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        photos.mkdir()
        for file in files:
            shutil.copy(file, photos)
        try:
            wildgs.reconstruct(photos, Path(folder) / "scene", SfmConfig(seed=seed))
        except UserError as error:
            print(error)
            return None
    return compare(truth, kept.model)


def main(command: Command) -> None:
    """Prints a line per run and their means."""
    warnings.simplefilter("ignore", WildGSWarning)
    truth, kept = pycolmap.Reconstruction(command.scene / "sparse" / "0"), Kept()
    names = {image.name for image in truth.images.values() if image.has_pose}
    files = sorted(file for file in (command.scene / "images").iterdir() if file.name in names)
    scores = []
    for choice in command.choices:
        rows = np.random.default_rng(choice).choice(
            len(files), min(command.photos, len(files)), replace=False
        )
        for seed in command.seeds:
            score = run([files[row] for row in sorted(rows)], truth, seed, kept)
            print(f"{command.scene.name}, choice {choice}, seed {seed}: {score}", flush=True)
            if score is not None:
                scores.append(score)
    if scores:

        def mean(name: str) -> float:
            return float(np.exp(np.mean([np.log(max(getattr(score, name), 1e-3)) for score in scores])))

        print(
            f"mean of {len(scores)} runs: {np.mean([s.registered for s in scores]):.1f} photos,"
            f" {np.mean([s.points for s in scores]):.0f} points,"
            f" error {mean('error'):.2f}% ({mean('worst_error'):.2f}%),"
            f" cameras {mean('cameras'):.3f}% ({mean('worst_cameras'):.3f}%),"
            f" focal {np.mean([s.focal for s in scores]):.2f} ({np.mean([s.worst_focal for s in scores]):.2f})"
        )


if __name__ == "__main__":
    main(tyro.cli(Command))
