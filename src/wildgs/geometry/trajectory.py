"""Camera trajectories for videos, in the aligned frame of a scene (+z up)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from wildgs.geometry.camera import Camera
from wildgs.geometry.lens import Lens, Vector, focal_of, focus, forwards_of, positions_of, unit, usual_lens

FULL_CIRCLE_GAP = 75.0
"""An orbit is a full circle if no gap between the cameras is wider than this, in degrees."""

TOUR_STOPS = 16
"""Number of photos that a training path passes."""


def still(camera: Camera, frames: int, width: int, height: int) -> list[Camera]:
    """One camera for all frames, with its focal length relative to the longer side: only the appearance changes."""
    return interpolate([camera], frames, width, height)


def interpolate(cameras: Sequence[Camera], frames: int, width: int, height: int) -> list[Camera]:
    """A smooth path from the first to the last of the given cameras at constant speed, with ease-in and ease-out.

    Positions and rotations follow splines (twice differentiable); focal lengths are interpolated logarithmically.
    """
    focal = np.log([focal_of(camera) for camera in cameras])
    kept = [cameras[0]]
    knots, logs = [0.0], [focal[0]]
    for camera, log_focal in zip(cameras[1:], focal[1:], strict=True):
        length = _distance(kept[-1], camera) + abs(log_focal - logs[-1])
        if length > 1e-9:  # consecutive identical cameras are merged
            kept.append(camera)
            knots.append(knots[-1] + length)
            logs.append(log_focal)
    axes = np.stack([camera.viewmat[:3, :3].double().cpu().numpy() for camera in kept])
    if len(kept) == 1:
        lens = Lens(float(np.exp(logs[0])), width, height)
        return [lens.posed(axes[0], positions_of(kept)[0])] * frames
    times = knots[-1] * _gentle(frames)
    positions = CubicSpline(knots, positions_of(kept), bc_type="natural")(times)
    rotations = RotationSpline(knots, Rotation.from_matrix(axes))(times).as_matrix()
    lenses = np.exp(PchipInterpolator(knots, logs)(times))
    return [
        Lens(float(lens), width, height).posed(rotation, position)
        for lens, rotation, position in zip(lenses, rotations, positions, strict=True)
    ]


def _distance(first: Camera, second: Camera) -> float:
    """Distance between two cameras: translation in world units (the median depth is 1) plus rotation in radians."""
    moved = float((first.position - second.position).norm())
    turned = Rotation.from_matrix((first.viewmat[:3, :3] @ second.viewmat[:3, :3].T).double().cpu().numpy())
    return moved + float(turned.magnitude())


def _gentle(frames: int, ramp: float = 0.15) -> Float64[np.ndarray, " F"]:
    """Path parameter from 0 to 1 with ease-in and ease-out."""
    time = np.linspace(0, 1, frames) if frames > 1 else np.zeros(1)
    full = 1 / (1 - ramp)
    start = full * time**2 / (2 * ramp)
    middle = full * (time - ramp / 2)
    end = 1 - full * (1 - time) ** 2 / (2 * ramp)
    return np.where(time < ramp, start, np.where(time > 1 - ramp, end, middle))


def training_path(
    cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], frames: int, width: int, height: int
) -> list[Camera]:
    """A smooth path past the camera positions of the photos, with their viewing directions.

    Since photo collections are unordered, photos are chosen by farthest-point sampling and connected by a short
    tour. Photos from far away and photos that look elsewhere are ignored.
    """
    target = focus(cameras, np.median(points, axis=0).astype(np.float64))
    usual = _usual_cameras(cameras, target)
    positions, forwards = positions_of(usual), forwards_of(usual)
    reach = np.linalg.norm(target - positions, axis=1)
    seen = positions + forwards * reach[:, None]
    stops = spread_out(np.concatenate([positions, 0.5 * seen], axis=1), TOUR_STOPS)
    order = [stops[i] for i in open_tour(positions[stops])]
    walked, looked = _smooth(positions[order], frames), _smooth(seen[order], frames)
    lens = usual_lens(usual, width, height)
    return [lens.camera(place, at - place) for place, at in zip(walked, looked, strict=True)]


def _usual_cameras(cameras: Sequence[Camera], target: Vector) -> list[Camera]:
    """Cameras at a typical distance that look at the target; all cameras if there are none."""
    distance = np.linalg.norm(positions_of(cameras) - target, axis=1)
    usual = float(np.median(distance))
    chosen = []
    for camera, away in zip(cameras, distance, strict=True):
        ahead = target - camera.position.double().cpu().numpy()
        facing = float(camera.forward.double().cpu().numpy() @ ahead) > 0.8 * np.linalg.norm(ahead)
        if 0.4 * usual <= away <= 1.8 * usual and facing:
            chosen.append(camera)
    return chosen or list(cameras)


def _smooth(stops: Float64[np.ndarray, "S 3"], frames: int) -> Float64[np.ndarray, "F 3"]:
    """A smooth curve past the stops, uniform in time between them."""
    if len(stops) == 1:
        return np.repeat(stops, frames, axis=0)
    fine = 40 * len(stops)
    curve = PchipInterpolator(np.arange(len(stops)), stops)(np.linspace(0, len(stops) - 1, fine))
    curve = gaussian_filter1d(curve, sigma=40, axis=0, mode="nearest")
    return PchipInterpolator(np.linspace(0, 1, fine), curve)(_gentle(frames))


def orbit(
    cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], frames: int, width: int, height: int
) -> list[Camera]:
    """An orbit around the landmark, at the distance and height of the photos in each direction.

    A full circle if there are photos from all around; otherwise an arc over the photographed side (the facade),
    back and forth. The video loops in both cases.
    """
    target = focus(cameras, np.median(points, axis=0).astype(np.float64))
    usual = _usual_cameras(cameras, target)
    offsets = positions_of(usual) - target
    azimuths = np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0]))
    distances = np.linalg.norm(offsets[:, :2], axis=1)
    lens = usual_lens(usual, width, height)
    path = []
    for azimuth in _sweep(azimuths, frames):
        near = _nearby(azimuth, azimuths)
        radius = np.exp(float(near @ np.log(np.maximum(distances, 1e-6))))
        angle = np.radians(azimuth)
        place = target + [radius * np.cos(angle), radius * np.sin(angle), float(near @ offsets[:, 2])]
        path.append(lens.camera(place, target - place))
    return path


def _sweep(azimuths: Float64[np.ndarray, " V"], frames: int) -> Float64[np.ndarray, " F"]:
    """Azimuths of the frames of an orbit in degrees."""
    ordered = np.sort(azimuths)
    gaps = np.diff(np.append(ordered, ordered[0] + 360))
    after = int(gaps.argmax())
    start = ordered[(after + 1) % len(ordered)]
    phase = np.arange(frames) / max(frames, 1)
    if gaps[after] < FULL_CIRCLE_GAP:
        return start + 360 * phase
    turned = np.sort((azimuths - start) % 360)
    low, high = np.quantile(turned, [0.05, 0.95])
    half = max((high - low) / 2, 8.0)
    return start + (low + high) / 2 - half * np.cos(2 * np.pi * phase)


def _nearby(
    azimuth: float, azimuths: Float64[np.ndarray, " V"], width: float = 20.0
) -> Float64[np.ndarray, " V"]:
    """Weights of cameras by their azimuth in degrees; they sum to 1."""
    apart = (azimuths - azimuth + 180) % 360 - 180
    weights = np.exp(-0.5 * (apart / width) ** 2) + 1e-3
    return weights / weights.sum()


def spiral(
    cameras: Sequence[Camera],
    points: Float[np.ndarray, "P 3"],
    frames: int,
    width: int,
    height: int,
    *,
    turns: int = 2,
    radius: float = 0.12,
) -> list[Camera]:
    """Circles (radius relative to the landmark's distance) around the most central photo; the video loops."""
    target = focus(cameras, np.median(points, axis=0).astype(np.float64))
    usual = _usual_cameras(cameras, target)
    positions = positions_of(usual)
    home = positions[int(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).argmin())]
    lens = usual_lens(usual, width, height)
    forward = unit(target - home)
    right, down, _ = lens.camera(home, forward).viewmat[:3, :3].double().numpy()
    size = radius * float(np.linalg.norm(target - home))
    path = []
    for phase in 2 * np.pi * np.arange(frames) / max(frames, 1):
        sideways = np.cos(turns * phase) * right - 0.5 * np.sin(turns * phase) * down
        place = home + size * (sideways + np.sin(phase) * forward)
        path.append(lens.camera(place, target - place))
    return path


def spread_out(features: Float64[np.ndarray, "V D"], count: int) -> list[int]:
    """Farthest-point sampling: indices of at most `count` rows, each the farthest from those before.

    The first is the row nearest to the median, which is robust to outliers.
    """
    chosen = [int(np.linalg.norm(features - np.median(features, axis=0), axis=1).argmin())]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < min(count, len(features)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return chosen


def open_tour(places: Float64[np.ndarray, "S D"]) -> list[int]:
    """A short open tour through all places: the leaves of their cluster tree, ordered for short steps."""
    if len(places) < 3:
        return list(range(len(places)))
    return leaves_list(linkage(places, "average", optimal_ordering=True)).tolist()
