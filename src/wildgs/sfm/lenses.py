"""Lenses that no photograph has: stitched panoramas, little planets, and poses that only such a lens explains."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

FOCAL_RANGE = (0.3, 30.0)
"""Focal lengths of photographs, relative to the long side: fields of view from 118 to 2 degrees."""

MAX_DISTORTION = 0.3
"""Largest shift of a photo's corners by its lens, relative to their distance from the middle."""

MAX_ERROR = 0.008
"""Largest reprojection error of a point that agrees with a plain lens, as a share of the long side."""
LEAST_POINTS, LEAST_SHARE = 15, 0.6
"""Of a photo's points, that must agree."""


def lens_fault(camera: Any) -> str | None:
    """Why a camera cannot be that of a photo, None where it can.

    Args:
        camera: pycolmap's; SIMPLE_RADIAL's distortion is judged, of other models only the focal length.
    """
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    if not FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1]:
        degrees = 2 * np.degrees(np.arctan(0.5 / focal))
        return f"no lens has its field of view ({degrees:.0f} degrees): a stitched panorama or a wrong pose"
    if camera.model_name != "SIMPLE_RADIAL":
        return None
    corner = np.hypot(camera.width, camera.height) / 2 / camera.params[0]
    shift = float(camera.params[3]) * corner**2
    # Where 1 + 3 k r^2 is negative, two places of the scene fall on one pixel.
    if abs(shift) > MAX_DISTORTION or 1 + 3 * shift < 0:
        bent = f"{abs(shift):.0%} at the corners"
        return f"no lens bends so much ({bent}): a panorama, a little planet or a wrong pose"
    return None


def drop_impossible(model: Any) -> dict[str, str]:
    """Takes photos with an impossible lens out of a model, where no plain lens explains their points as well.

    Features in the middle of a photo say little about its corners, so that many a real lens comes out bent.

    Returns:
        From the names of the photos taken out to what is wrong with them.
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
    """Gives a photo a lens without distortion if most of its points agree with one; whether they do."""
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
