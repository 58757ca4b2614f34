"""Localisation: estimates the camera of a new photo in the scene's SfM model.

SIFT features are matched to the model's points, and pycolmap estimates the pose by RANSAC and refinement. The focal
length is taken from EXIF data or estimated with the pose.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Float64, UInt8
from PIL import Image
from torch import Tensor

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.scene.images import UnreadableImageError, open_image, read_photo
from wildgs.scene.undistort import PixelGrid, sample_colors
from wildgs.sfm.feature_index import FeatureIndex, find_features, match_features
from wildgs.sfm.lenses import FOCAL_RANGE
from wildgs.sfm.mapping import quiet
from wildgs.sfm.upright import save_jpeg

MIN_INLIERS = 15
"""Smallest number of inliers of a pose; photos of other places have up to 5."""

MATCH_RATIO = 0.85
MAX_ERROR = 0.008
"""Largest reprojection error of an inlier, relative to the photo's longer side (8 pixels of 1,000)."""

MAX_TRIALS = 10_000
"""Upper bound on RANSAC trials, COLMAP's default."""

REFINE_LENS = 60
"""Number of inliers from which distortion is estimated as well."""

EXIF_SIDE = 256
"""Longest side of the temporary image for reading EXIF data; focal lengths are relative to the image size."""

MAX_DISTORTION = 0.2
"""Largest displacement of a photo's corners by distortion, relative to their distance from the centre."""


class LocalizationError(UserError):
    """The photo could not be localised; the message gives inliers and matches."""


@dataclass(frozen=True)
class LocalizedPhoto:
    """A new photo with its camera.

    Attributes:
        photo: The undistorted photo, at the size of the scene's photos.
        camera: Its pinhole camera in the aligned frame.
        inliers: Number of inliers of the pose.
        matches: Number of matches between features and points.
        focal: Focal length, relative to the longer side.
        focal_from_exif: Whether the initial focal length is from EXIF data.
    """

    photo: UInt8[Tensor, "H W 3"]
    camera: Camera
    inliers: int
    matches: int
    focal: float
    focal_from_exif: bool

    def describe(self) -> str:
        """Describes the result in one line."""
        origin = "from EXIF, refined" if self.focal_from_exif else "estimated"
        return (
            f"localised with {self.inliers} inliers of {self.matches} matches, focal length"
            f" {self.focal:.2f} of the long side ({origin})"
        )


def localize(file: Path, index: FeatureIndex, long_side: int, *, seed: int = 0) -> LocalizedPhoto:
    """Estimates the camera of a new photo of the scene.

    Args:
        file: The photo; any size, upright or with an EXIF orientation.
        index: Feature index of the scene.
        long_side: Longest side, in pixels, of the resulting photo.
        seed: Random seed of RANSAC.

    Raises:
        UserError: The file cannot be read.
        LocalizationError: There are too few inliers.
    """
    try:
        pixels = read_photo(file).pixels
    except UnreadableImageError as error:
        raise UserError(f"{file}: {error}; give a readable image") from error
    camera, focal_known = guess_camera(file, pixels.shape[1], pixels.shape[0])
    features, descriptors = find_features(pixels)
    matched, seen = (np.zeros(0, np.int64),) * 2
    if len(features):
        matched, seen = match_features(descriptors, index, MATCH_RATIO)
    answer = solve_pose(features[matched], index.points[seen], camera, focal_known, seed)
    inliers = 0 if answer is None else int(answer["num_inliers"])
    if answer is None or inliers < MIN_INLIERS:
        raise LocalizationError(
            f"{file}: could not be localised ({inliers} inliers of {len(matched)} matches with the scene's"
            f" points; at least {MIN_INLIERS} are needed)"
        )
    return _as_view(pixels, camera, answer["cam_from_world"], long_side, inliers, len(matched), focal_known)


def guess_camera(file: Path, width: int, height: int) -> tuple[Any, bool]:
    """An initial camera, and whether its focal length is from EXIF data.

    For safety, COLMAP does not read the file but a small blank image of the same aspect ratio with those EXIF
    entries that Pillow could read.
    """
    try:
        with tempfile.TemporaryDirectory() as folder, open_image(file) as image, quiet():
            blank = Image.new("RGB", (width, height))
            blank.thumbnail((EXIF_SIDE, EXIF_SIDE))
            save_jpeg(blank, image, Path(folder) / "exif.jpg")
            read = pycolmap.infer_camera_from_image(Path(folder) / "exif.jpg")
        focal_known = bool(read.has_prior_focal_length)
        focal = read.mean_focal_length() / max(read.width, read.height)
    except Exception:  # missing or invalid EXIF data
        focal_known, focal = False, 1.2
    long_side = max(width, height)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=[focal * long_side, width / 2, height / 2, 0.0],
    )
    return camera, focal_known


def solve_pose(
    pixels: Float64[np.ndarray, "M 2"],
    points: Float64[np.ndarray, "M 3"],
    camera: Any,
    focal_known: bool,
    seed: int,
    *,
    max_trials: int = MAX_TRIALS,
) -> dict[str, Any] | None:
    """Estimates a pose; None if there is no plausible one.

    The camera's focal length and, with enough points, its distortion are refined in place.
    """
    if len(pixels) < 4:
        return None
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = not focal_known
    estimation.ransac.max_error = MAX_ERROR * max(camera.width, camera.height)
    estimation.ransac.random_seed = seed
    estimation.ransac.min_inlier_ratio = 0.02
    estimation.ransac.max_num_trials = max_trials
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = True
    with quiet():
        answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, estimation, refinement)
        if answer is None or not _plausible(camera):
            return None
        if answer["num_inliers"] >= REFINE_LENS:
            refinement.refine_extra_params = True
            bent = pycolmap.Camera(camera.todict())
            pose, inliers = answer["cam_from_world"], answer["inlier_mask"]
            refined = pycolmap.refine_absolute_pose(pose, pixels, points, inliers, bent, refinement)
            if refined is not None and _plausible(bent):
                answer["cam_from_world"] = refined["cam_from_world"]
                camera.params = bent.params
    return answer


def _plausible(camera: Any) -> bool:
    focal, radial = camera.params[0], camera.params[3]
    corner = np.hypot(camera.width, camera.height) / 2 / focal
    in_range = FOCAL_RANGE[0] <= focal / max(camera.width, camera.height) <= FOCAL_RANGE[1]
    return bool(in_range and abs(radial) * corner**2 <= MAX_DISTORTION)


def _as_view(
    pixels: UInt8[np.ndarray, "H W 3"],
    camera: Any,
    pose: Any,
    long_side: int,
    inliers: int,
    matches: int,
    focal_known: bool,
) -> LocalizedPhoto:
    """Undistorts and resizes the photo and converts its camera."""
    longest = max(camera.width, camera.height)
    grid = PixelGrid.from_colmap(camera, max_side=long_side)
    image = Image.fromarray(pixels).resize(grid.resized, Image.Resampling.LANCZOS)
    source = grid.source()
    photo = np.array(image) if source is None else sample_colors(np.asarray(image), source)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(pose.matrix())
    return LocalizedPhoto(
        photo=torch.from_numpy(photo),
        camera=Camera(viewmat.float(), grid.K.float(), grid.width, grid.height),
        inliers=inliers,
        matches=matches,
        focal=float(camera.params[0]) / longest,
        focal_from_exif=focal_known,
    )
