"""`wildgs render`: views of a run, or a video through it, in any light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from wildgs.cli.options import UNNAMED, LightOptions
from wildgs.cli.screen import console, print_notes, progress_shown
from wildgs.errors import UserError
from wildgs.library.config import TrajectoryOptions


@dataclass(frozen=True)
class Command:
    """Renders photos' viewpoints, or a video, in the light of any photos.

    Example: wildgs render runs/gate --appearance noon.jpg --to evening.jpg --path orbit --output orbit.mp4

    Without --path, and with a folder as --output, one PNG for every view and appearance.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path
    """A video (.mp4, .mkv, .mov), a picture (.png, .jpg) of one view in one light, or a folder: of frames with
    --path, else of OUTPUT/<appearance>/<view>.png."""
    light: Annotated[LightOptions, UNNAMED] = field(default_factory=LightOptions)
    to: tuple[str, ...] = ()
    """Appearances to which the light changes during the video, one after the other."""
    over: Literal["day"] | None = None
    """day: the light of the photos from night over morning and noon to evening, instead of --appearance and --to.
    Photos are ordered by their EXIF time if most of them fit it, and by their light otherwise."""
    photos: Path | None = None
    """Folder of the original photos, whose EXIF blocks tell the hour; by default the scene's images. For --over."""
    view: tuple[str, ...] = ()
    """Photos whose viewpoint is rendered, by name. By default all that were held out, or all where none was."""
    trajectory: Annotated[TrajectoryOptions, UNNAMED] = field(default_factory=TrajectoryOptions)


def run(command: Command) -> None:
    """Renders stills or a video."""
    import wildgs

    light = command.light
    if command.over and (command.to or light != LightOptions()):
        raise UserError(
            "--over takes its light from all photos; leave --appearance, --to and mixing options out"
        )
    with progress_shown() as screen:
        done = wildgs.render(
            command.run,
            command.output,
            appearance=command.light.appearance,
            to=command.to,
            over=command.over,
            photos=command.photos,
            views=command.view,
            trajectory=command.trajectory,
            mixing=command.light.mixing,
            progress=screen,
        )
    print_notes(done.looks)
    if done.day is not None:
        order = "time" if done.day.by_time else "light (their times are unknown, or do not fit it)"
        console.print(f"{len(done.day.phases)} photos ordered by {order}; shown: {', '.join(done.day.keys)}")
        for name, reason in done.day.left_out.items():
            console.print(f"{name} is left out: {reason}")
    if done.fps is None:
        console.print(f"{done.pictures} pictures -> {done.output}")
    else:
        width, height = done.size
        console.print(
            f"{done.pictures} frames, {width} x {height}, {done.pictures / done.fps:.1f} s -> {done.output}"
        )
