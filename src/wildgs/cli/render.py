"""`wildgs render`: views of a run, or a video through it, in any light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from wildgs.api import LoadedScene, load
from wildgs.cli.lights import LightOptions, find_look, find_looks
from wildgs.cli.progress import Counter, console, counting
from wildgs.errors import UserError
from wildgs.evaluation.pictures import picture_paths, write_picture
from wildgs.export.video import check_output, is_video, write_frames
from wildgs.geometry.camera import Camera
from wildgs.light.look import Look
from wildgs.scene import find_view
from wildgs.scene.trajectories import AROUND, THROUGH, read_path

DEFAULT_PATH = "orbit"
DEFAULT_FPS = 30.0
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class Command:
    """Renders photos' viewpoints, or a video, in the light of any photos.

    Example: wildgs render runs/gate --appearance noon.jpg --to evening.jpg --path orbit --output orbit.mp4

    Without --path, and with a folder as --output, one PNG for every view and appearance.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path
    """A video (.mp4, .mkv, .mov), or a folder: of frames with --path, else of OUTPUT/<appearance>/<view>.png."""
    light: Annotated[LightOptions, tyro.conf.arg(name="")] = field(default_factory=LightOptions)
    to: tuple[str, ...] = ()
    """Appearances to which the light changes during the video, one after the other."""
    view: tuple[str, ...] = ()
    """Photos whose viewpoint is rendered, by name; without any, all that were held out."""
    path: str | None = None
    """orbit, training, spiral, views (through --view), still (at --view), or a camera file (docs/cameras.md)."""
    seconds: float = 5.0
    """Length of the video."""
    fps: float | None = None
    """Frames per second; 30, or a camera file's own."""
    size: tuple[int, int] | None = None
    """Width and height; the photos' own without it."""


def run(command: Command) -> None:
    """Renders stills or a video."""
    if command.path is None and not is_video(command.output):
        if command.to:
            raise UserError("--to changes light over time: add --path, or name a video as --output")
        render_views(command)
    else:
        render_video(command)


def render_views(command: Command) -> None:
    """Every view under every appearance."""
    check_output(command.output)
    if command.output.is_file():
        raise UserError(f"{command.output}: is a file; give a folder for the pictures")
    scene = load(command.run)
    views = [find_view(scene.scene, name) for name in command.view] or list(scene.scene.test_views)
    if not views:
        raise UserError(f"{scene.scene.root} holds out no photo; name photos by --view")
    looks = find_looks(scene, command.light, command.light.appearance)
    cameras = [view.camera if command.size is None else _fit(view.camera, command.size) for view in views]
    paths = picture_paths([view.name for view in views])
    folders = picture_paths([look.name for look in looks])
    total = len(views) * len(looks)
    with counting("rendering") as progress:
        for number, look in enumerate(looks):
            folder = command.output / folders[look.name].with_suffix("")
            for index, (view, camera) in enumerate(zip(views, cameras, strict=True)):
                write_picture(folder / paths[view.name], scene.render(camera, look))
                progress(number * len(views) + index + 1, total)
    console.print(f"{total} pictures -> {command.output}")


def _fit(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera's view on another frame, which may show more or less of it, but nothing stretched."""
    from wildgs.geometry.trajectory import still

    return still(camera, 1, *size)[0]


def render_video(command: Command) -> None:
    """A trajectory in one light, or through several."""
    check_output(command.output)
    scene = load(command.run)
    cameras, fps = find_cameras(scene, command)
    looks = find_looks(scene, command.light, command.light.appearance)
    looks += [find_look(scene, spec, command.light.like) for spec in command.to]
    if is_video(command.output):
        cameras = [even(camera) for camera in cameras]
    size = (cameras[0].width, cameras[0].height)
    with counting("rendering") as progress:
        write_frames(command.output, _rendered(scene, cameras, looks, progress), size, fps)
    console.print(
        f"{len(cameras)} frames, {size[0]} x {size[1]}, {len(cameras) / fps:.1f} s -> {command.output}"
    )


def find_cameras(scene: LoadedScene, command: Command) -> tuple[list[Camera], float]:
    """The video's cameras and its frames per second.

    Raises:
        UserError: The path cannot be had, or is too short or too long.
    """
    kind = command.path or ("views" if len(command.view) > 1 else DEFAULT_PATH)
    fps = command.fps or DEFAULT_FPS
    if kind not in (*AROUND, *THROUGH) and Path(kind).suffix and command.size is None:
        cameras, file_fps = read_path(scene.scene, Path(kind))
        sizes = {(camera.width, camera.height) for camera in cameras}
        if len(sizes) > 1:
            raise UserError(f"{kind}: the pictures of a video must be of one size")
        return cameras, command.fps or file_fps
    if not (fps > 0 and command.seconds > 0 and command.seconds * fps <= MAX_FRAMES):
        raise UserError(
            f"{command.seconds:g} seconds of {fps:g} frames: both must be above 0, and the video {MAX_FRAMES:,}"
            " frames long at most"
        )
    frames = max(1, round(command.seconds * fps))
    return scene.path(kind, frames=frames, size=command.size, views=command.view), fps


def even(camera: Camera) -> Camera:
    """The camera without the last odd column and row, which H.264 cannot have."""
    return camera.cropped(0, 0, max(2, camera.width // 2 * 2), max(2, camera.height // 2 * 2))


def _rendered(
    scene: LoadedScene, cameras: Sequence[Camera], looks: Sequence[Look], progress: Counter
) -> Iterator[np.ndarray]:
    for number, picture in enumerate(scene.frames(cameras, looks), start=1):
        yield picture.numpy()
        progress(number, len(cameras))
