"""Which lenses are implausible (stitched panoramas, little planets, wrong poses), and which photos stretched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

FOCAL_RANGE = (0.3, 30.0)
"""Plausible focal lengths relative to the longer side: fields of view from 118 to 2 degrees."""

MAX_DISTORTION = 0.3
"""Largest displacement of a photo's corners by distortion, relative to their distance from the centre."""

MAX_ERROR = 0.008
"""Largest reprojection error of an inlier without distortion, relative to the longer side."""
LEAST_POINTS, LEAST_SHARE = 15, 0.6
"""Smallest number and fraction of inliers among a photo's points."""


def stretched_lenses(model: Any) -> set[int]:
    """Ids of the cameras of stretched photos, which only `wildgs.sfm.edited_photos` fits.

    Bundle adjustment would free distortion coefficients of theirs that are 0.
    """
    return {number for number, camera in model.cameras.items() if camera.model_name == "OPENCV"}


def lens_fault(camera: Any) -> str | None:
    """The reason why a camera is implausible, or None.

    Args:
        camera: pycolmap's camera, SIMPLE_RADIAL or OPENCV.
    """
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    if not FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1]:
        degrees = 2 * np.degrees(np.arctan(0.5 / focal))
        return f"implausible field of view ({degrees:.0f} degrees): a stitched panorama or a wrong pose"
    shift = corner_shift(camera)
    # If 1 + 3 k r^2 is negative, the distortion is not injective.
    if abs(shift) > MAX_DISTORTION or 1 + 3 * shift < 0:
        amount = f"{abs(shift):.0%} at the corners"
        return f"implausible distortion ({amount}): a panorama, a little planet or a wrong pose"
    return None


def corner_shift(camera: Any) -> float:
    """Displacement of a photo's corners by distortion, relative to their distance from the centre.

    Args:
        camera: pycolmap's camera; 0 for models other than SIMPLE_RADIAL and that of stretched photos, OPENCV.
    """
    if camera.model_name not in ("SIMPLE_RADIAL", "OPENCV"):
        return 0.0
    focal, radial = (
        camera.mean_focal_length(),
        camera.params[3 if camera.model_name == "SIMPLE_RADIAL" else 4],
    )
    return float(radial * (np.hypot(camera.width, camera.height) / 2 / focal) ** 2)


def drop_impossible(model: Any) -> dict[str, str]:
    """Removes photos with an implausible lens from a model, unless a lens without distortion explains their points.

    If features are only in the centre of a photo, the distortion of a real lens may be estimated badly.

    Returns:
        The reasons by the names of the removed photos.
    """
    faults = {}
    for image_id in list(model.reg_image_ids()):
        image = model.image(image_id)
        fault = lens_fault(image.camera)
        if fault is not None and not _straighten(model, image):
            faults[image.name] = fault
            model.deregister_frame(image.frame_id)
    return faults


def _straighten(model: Any, image: Any) -> bool:
    """Replaces a photo's lens by one without distortion if most of its points agree; returns whether they do."""
    rows = [row for row, point in enumerate(image.points2D) if point.has_point3D()]
    pixels = np.array([image.points2D[row].xy for row in rows], dtype=np.float64)
    points = np.array([model.point3D(image.points2D[row].point3D_id).xyz for row in rows], dtype=np.float64)
    camera = pycolmap.Camera(image.camera.todict())
    if camera.model_name != "SIMPLE_RADIAL" or len(rows) < LEAST_POINTS:
        return False
    camera.params = [*camera.params[:3], 0.0]
    estimation, refinement = (
        pycolmap.AbsolutePoseEstimationOptions(),
        pycolmap.AbsolutePoseRefinementOptions(),
    )
    estimation.estimate_focal_length = True
    estimation.ransac.max_error = MAX_ERROR * max(camera.width, camera.height)
    refinement.refine_focal_length = True
    answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, estimation, refinement)
    if answer is None or answer["num_inliers"] < max(LEAST_POINTS, LEAST_SHARE * len(rows)):
        return False
    if lens_fault(camera) is not None:
        return False
    image.camera.params = camera.params
    image.frame.set_cam_from_world(image.camera_id, answer["cam_from_world"])
    for row, agrees in zip(rows, answer["inlier_mask"], strict=True):
        if not agrees and image.points2D[row].has_point3D():
            model.delete_observation(image.image_id, row)
    return True
