"""`wildgs.render`: renders images from the photos' viewpoints, or a video along a path, in any light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from wildgs.errors import UserError
from wildgs.evaluation.pictures import distinct_names, picture_paths, write_picture
from wildgs.exporters.outputs import PICTURE_SUFFIXES, VIDEO_SUFFIXES, file_suffix, require_folder
from wildgs.exporters.video import check_output, is_video, write_frames
from wildgs.geometry.camera import Camera
from wildgs.geometry.trajectory import still
from wildgs.library.config import MixOptions, TrajectoryOptions
from wildgs.library.day import day_timeline, find_day
from wildgs.library.loaded import LoadedScene, Spec, find_looks, loaded, without_repeats
from wildgs.light.day import Day
from wildgs.light.look import NEUTRAL, Look, Timeline
from wildgs.progress import Progress, counter
from wildgs.scene import Scene, View, find_view
from wildgs.scene.start import choose_start
from wildgs.scene.trajectories import AROUND, THROUGH, read_path

DEFAULT_PATH = "orbit"
DEFAULT_FPS = 30.0
DEFAULT_SECONDS, DAY_SECONDS = 5.0, 10.0
MAX_FRAMES = 100_000
MAX_FPS = 1000
MAX_SIDE, MAX_PIXELS = 16_384, 2**27


@dataclass(frozen=True)
class Rendered:
    """Results of `render`.

    Attributes:
        output: The file or folder.
        pictures: Number of images or frames.
        size: Width and height of the last one.
        fps: Frames per second of a video; None for images.
        looks: The appearances.
        day: The day shown, with `over="day"`.
    """

    output: Path
    pictures: int
    size: tuple[int, int]
    fps: float | None
    looks: tuple[Look, ...]
    day: Day | None = None


def render(
    run: str | Path | LoadedScene,
    output: str | Path,
    *,
    appearance: Spec | Sequence[Spec] = (NEUTRAL,),
    to: Spec | Sequence[Spec] = (),
    over: Literal["day"] | None = None,
    photos: str | Path | None = None,
    views: Sequence[str] = (),
    trajectory: TrajectoryOptions | None = None,
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> Rendered:
    """Renders images or a video.

    Args:
        run: A run folder, or a loaded scene.
        output: A video (.mp4, .mkv, .mov), an image (.png, .jpg) of one view in one light, or a folder: for the
            frames of a path, else for <appearance>/<view>.png.
        appearance: Anything that `LoadedScene.appearance` accepts.
        to: Appearances to which the light changes during a video, in this order.
        over: `"day"` shows the course of a day (`wildgs.library.day.find_day`) instead of `appearance` and `to`.
        photos: Folder of the original photos with EXIF times, for `over`; None takes the scene folder.
        views: Names of the photos whose viewpoints are rendered. Default: the held-out photos, or all photos if
            there are none.
        trajectory: Camera path, length and size.
        mixing: How appearances are obtained and mixed.
        progress: Called for every image.

    Raises:
        UserError: A photo, appearance or path does not exist, or an image cannot be rendered or written.
    """
    output, trajectory = Path(output), trajectory or TrajectoryOptions()
    if trajectory.size is not None:
        check_size(*trajectory.size)
    if photos is not None and over is None:
        raise UserError("--photos is only used with --over day; leave it out")
    if over is not None:
        return _render_day(loaded(run), output, photos, views, trajectory, progress)
    if trajectory.path is None and not is_video(output):
        _refuse_video_options(trajectory, to)
        return _render_views(loaded(run), output, appearance, views, trajectory.size, mixing, progress)
    check_output(output)
    scene = loaded(run)
    cameras, fps = _find_cameras(scene, trajectory, views, one_size=is_video(output))
    looks = find_looks(scene, appearance, mixing, progress=progress)
    like = MixOptions(like=mixing.like, sky=mixing.sky) if mixing else None
    looks += find_looks(scene, to, like, progress=progress)
    size = _write_path(output, scene, cameras, looks, fps, progress)
    return Rendered(output, len(cameras), size, fps, tuple(looks))


def _refuse_video_options(trajectory: TrajectoryOptions, to: Spec | Sequence[Spec]) -> None:
    """Raises `UserError` if options of a video are given for images."""
    if to:
        raise UserError("--to changes the light during a video: add --path, or give a video file as --output")
    for option, value in (("--seconds", trajectory.seconds), ("--fps", trajectory.fps)):
        if value is not None:
            raise UserError(
                f"{option} is only used for a video: add --path, or give a video file as --output"
            )


def _render_day(
    scene: LoadedScene,
    output: Path,
    photos: str | Path | None,
    views: Sequence[str],
    trajectory: TrajectoryOptions,
    progress: Progress | None,
) -> Rendered:
    """Renders a video over the course of a day."""
    check_output(output)
    if trajectory.path == "still" and not views:
        views = [choose_start(scene.scene)[0].name]
    if trajectory.seconds is None and not _is_camera_file(trajectory.path):
        trajectory = replace(trajectory, seconds=DAY_SECONDS)
    cameras, fps = _find_cameras(scene, trajectory, views, one_size=is_video(output))
    day = find_day(scene, None if photos is None else Path(photos), progress=progress)
    still_camera = cameras[0] if trajectory.path == "still" else None
    timeline = day_timeline(scene, day, still_camera, progress=progress)
    size = _write_path(output, scene, cameras, timeline, fps, progress)
    return Rendered(output, len(cameras), size, fps, timeline.looks, day)


def check_size(width: int, height: int) -> None:
    """Raises `UserError` for images without pixels or with too many."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise UserError(
            f"--size {width} {height}: sides must be from 1 to {MAX_SIDE:,} pixels, and the image at most "
            f"{MAX_PIXELS / 1e6:.0f} megapixels"
        )


def _render_views(
    scene: LoadedScene,
    output: Path,
    appearance: Spec | Sequence[Spec],
    names: Sequence[str],
    size: tuple[int, int] | None,
    mixing: MixOptions | None,
    progress: Progress | None,
) -> Rendered:
    """Renders every view under every appearance."""
    suffix = file_suffix(output)
    single = suffix in PICTURE_SUFFIXES
    if suffix is not None and not single:
        raise UserError(
            f"{output}: unsupported file type; use .png or .jpg for an image, {', '.join(VIDEO_SUFFIXES)} for a "
            "video, or a folder"
        )
    require_folder(output.parent if single else output)
    collection = scene.scene
    appearance = without_repeats(scene, appearance, mixing)
    views = find_views(collection, names) or collection.test_views or collection.train_views
    if not views:
        raise UserError(f"{collection.root} has no photo with a camera")
    looks = find_looks(scene, appearance, mixing, progress=progress)
    if single:
        views = views if names else views[:1]
        if len(views) * len(looks) != 1:
            raise UserError(
                f"{output} is one image; give one --view and one --appearance, or a folder as --output"
            )
    shape = (0, 0)
    for picture in render_each(scene, views, looks, None if single else output, size, progress):
        shape = (picture.shape[1], picture.shape[0])
        if single:
            write_picture(output, picture)
    return Rendered(output, len(views) * len(looks), shape, None, tuple(looks))


def find_views(scene: Scene, names: Sequence[str]) -> list[View]:
    """The views of photos by name, in their order, each once.

    Raises:
        UserError: The scene has no such photo, or several.
    """
    found = [find_view(scene, name) for name in names]
    return list({view.name: view for view in found}.values())


def render_each(
    scene: LoadedScene,
    views: Sequence[View],
    looks: Sequence[Look],
    folder: Path | None,
    size: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> Iterator[UInt8[Tensor, "_ _ 3"]]:
    """Renders every view under every look, one view after the other.

    Args:
        scene: The loaded scene.
        views: Photos whose viewpoints are rendered.
        looks: Their appearances.
        folder: Each image is written to FOLDER/<appearance>/<view>.png; None writes nothing.
        size: Width and height; None takes that of each photo.
        progress: Called for every image.
    """
    paths = picture_paths([view.name for view in views])
    folders = picture_paths(distinct_names([look.name for look in looks])).values()
    show = counter(progress, "rendering")
    for number, (view, (look, place)) in enumerate(product(views, zip(looks, folders, strict=True)), start=1):
        picture = scene.render(view.camera if size is None else still(view.camera, 1, *size)[0], look)
        if folder is not None:
            write_picture(folder / place.with_suffix("") / paths[view.name], picture)
        show(number, len(views) * len(looks))
        yield picture


def _is_camera_file(path: str | None) -> bool:
    return path is not None and path not in (*AROUND, *THROUGH) and bool(Path(path).suffix)


def _find_cameras(
    scene: LoadedScene, trajectory: TrajectoryOptions, views: Sequence[str], *, one_size: bool
) -> tuple[list[Camera], float]:
    """Cameras and frames per second of the video; `one_size` refuses a file with cameras of several sizes."""
    kind = trajectory.path or ("views" if len(views) > 1 else DEFAULT_PATH)
    if views and kind not in THROUGH and (kind in AROUND or _is_camera_file(kind)):
        raise UserError(
            f"--view is not used on the path {kind}; leave it out, or choose --path still or views"
        )
    fps = DEFAULT_FPS if trajectory.fps is None else trajectory.fps
    if not 0 < fps <= MAX_FPS:
        raise UserError(f"--fps {fps:g}: must be above 0 and at most {MAX_FPS:,}")
    if _is_camera_file(kind) and trajectory.size is None:
        if trajectory.seconds is not None:
            raise UserError(f"{kind}: a camera file defines the number of its frames; leave --seconds out")
        cameras, file_fps = read_path(scene.scene, Path(kind))
        sizes = {(camera.width, camera.height) for camera in cameras}
        if one_size and len(sizes) > 1:
            raise UserError(
                f"{kind}: the cameras of a video must all have the same image size; give a folder as --output"
            )
        return cameras, file_fps if trajectory.fps is None else fps
    seconds = DEFAULT_SECONDS if trajectory.seconds is None else trajectory.seconds
    if not (seconds > 0 and seconds * fps <= MAX_FRAMES):
        raise UserError(
            f"{seconds:g} seconds at {fps:g} frames per second: the length must be above 0, and the video at most "
            f"{MAX_FRAMES:,} frames long"
        )
    frames = max(1, round(seconds * fps))
    return scene.path(kind, frames=frames, size=trajectory.size, views=views), fps


def _write_path(
    output: Path,
    scene: LoadedScene,
    cameras: Sequence[Camera],
    looks: Sequence[Look] | Timeline,
    fps: float,
    progress: Progress | None,
) -> tuple[int, int]:
    """Renders the frames of a path into a video or a folder; returns the size of the last one."""
    if is_video(output):
        cameras = [_even(camera) for camera in cameras]
    size = (cameras[-1].width, cameras[-1].height)
    write_frames(output, _frames(scene, cameras, looks, progress), size, fps)
    return size


def _even(camera: Camera) -> Camera:
    """Crops a camera to even width and height, as H.264 requires."""
    return camera.cropped(0, 0, max(2, camera.width // 2 * 2), max(2, camera.height // 2 * 2))


def _frames(
    scene: LoadedScene, cameras: Sequence[Camera], looks: Sequence[Look] | Timeline, progress: Progress | None
) -> Iterator[np.ndarray]:
    show = counter(progress, "rendering")
    for number, picture in enumerate(scene.frames(cameras, looks), start=1):
        yield picture.numpy()
        show(number, len(cameras))
