"""Camera trajectories through a scene, in its aligned frame (+z up): where a video goes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from wildgs.geometry.camera import Camera
from wildgs.geometry.lens import Lens, Vector, focal_of, focus, forwards_of, positions_of, unit, usual_lens
from wildgs.geometry.tour import open_tour, spread_out

FULL_CIRCLE_GAP = 75.0
"""Degrees: an orbit closes where cameras stand all around, with no gap wider than this."""

TOUR_STOPS = 16
"""Photos that a training path passes by."""


def still(camera: Camera, frames: int, width: int, height: int) -> list[Camera]:
    """One camera for all frames: for videos in which only the light changes.

    Args:
        camera: The camera; its focal length is kept relative to the long side.
        frames: How many.
        width: Of the pictures.
        height: Of the pictures.
    """
    return interpolate([camera], frames, width, height)


def interpolate(cameras: Sequence[Camera], frames: int, width: int, height: int) -> list[Camera]:
    """A smooth way through given cameras, at even speed, starting and ending gently.

    Positions and rotations follow splines (twice differentiable), the focal length its logarithm.

    Args:
        cameras: At least one; the first and last frame show the first and last camera's view.
        frames: How many.
        width: Of the pictures.
        height: Of the pictures.
    """
    focal = np.log([focal_of(camera) for camera in cameras])
    kept = [cameras[0]]
    knots, logs = [0.0], [focal[0]]
    for camera, log_focal in zip(cameras[1:], focal[1:], strict=True):
        length = _distance(kept[-1], camera) + abs(log_focal - logs[-1])
        if length > 1e-9:  # the same camera twice is one stop
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
    """Way between two cameras: world units (the usual depth is 1) and radians count alike."""
    moved = float((first.position - second.position).norm())
    turned = Rotation.from_matrix((first.viewmat[:3, :3] @ second.viewmat[:3, :3].T).double().cpu().numpy())
    return moved + float(turned.magnitude())


def _gentle(frames: int, ramp: float = 0.15) -> Float64[np.ndarray, " F"]:
    """Shares of a way from 0 to 1: speeding up over the first part, slowing down over the last."""
    time = np.linspace(0, 1, frames) if frames > 1 else np.zeros(1)
    full = 1 / (1 - ramp)
    start = full * time**2 / (2 * ramp)
    middle = full * (time - ramp / 2)
    end = 1 - full * (1 - time) ** 2 / (2 * ramp)
    return np.where(time < ramp, start, np.where(time > 1 - ramp, end, middle))


def training_path(
    cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], frames: int, width: int, height: int
) -> list[Camera]:
    """A smooth walk past the places where photos were taken, looking where the photographers looked.

    Photo collections have no order, so a short tour through well spread photos gives one. Photos taken from far
    away or looking elsewhere are passed over.

    Args:
        cameras: Of the training photos.
        points: Sparse points of the scene.
        frames: How many.
        width: Of the pictures.
        height: Of the pictures.
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
    """Cameras at a usual distance that look at the target, all of them where none do."""
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
    """A soft curve past the stops, evenly timed between them, without their corners."""
    if len(stops) == 1:
        return np.repeat(stops, frames, axis=0)
    fine = 40 * len(stops)
    curve = PchipInterpolator(np.arange(len(stops)), stops)(np.linspace(0, len(stops) - 1, fine))
    curve = gaussian_filter1d(curve, sigma=40, axis=0, mode="nearest")
    return PchipInterpolator(np.linspace(0, 1, fine), curve)(_gentle(frames))


def orbit(
    cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], frames: int, width: int, height: int
) -> list[Camera]:
    """Around the landmark, as far and as high as photos were taken in each direction, looking at what they show.

    A full circle where photos were taken all around. Else an arc over the side that they show (the facade), there
    and back, so that the video can loop in both cases.

    Args:
        cameras: Of the training photos.
        points: Sparse points of the scene.
        frames: How many.
        width: Of the pictures.
        height: Of the pictures.
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
    """Directions of an orbit's frames, degrees."""
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
    """Weights of cameras by their direction, degrees; they add up to one, and are never all zero."""
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
    """Small circles about the most central photo, to and fro, always looking at the landmark; it loops.

    Args:
        cameras: Of the training photos.
        points: Sparse points of the scene.
        frames: How many.
        width: Of the pictures.
        height: Of the pictures.
        turns: Circles.
        radius: Of the circles, as a share of the distance to the landmark.
    """
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
