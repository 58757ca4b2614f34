"""`wildgs render`: renders images or a video of a run in any light."""

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
    """Renders the viewpoints of photos, or a video along a camera path, in the light of any photos.

    Without --path, and with a folder as --output, one PNG is written for every view and appearance.

    Example: wildgs render runs/gate --appearance noon.jpg --to evening.jpg --path orbit --output orbit.mp4
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path
    """A video (.mp4, .mkv, .mov), an image (.png, .jpg) of one view in one light, or a folder: for the frames of
    --path, else for <appearance>/<view>.png."""
    light: Annotated[LightOptions, UNNAMED] = field(default_factory=LightOptions)
    to: tuple[str, ...] = ()
    """Appearances to which the light changes during the video, in this order."""
    over: Literal["day"] | None = None
    """day: the course of a day, from night through morning and noon to evening, instead of --appearance and --to.
    Photos are ordered by EXIF time if it fits the light of most, those without a time by their light."""
    photos: Path | None = None
    """For --over: folder of the original photos, whose EXIF data holds the time. Default: the scene's images."""
    view: tuple[str, ...] = ()
    """Names of the photos whose viewpoints are rendered. Default: all held-out photos, or all photos if there are
    none."""
    trajectory: Annotated[TrajectoryOptions, UNNAMED] = field(default_factory=TrajectoryOptions)


def run(command: Command) -> None:
    """Renders images or a video."""
    import wildgs

    light = command.light
    if command.over and (command.to or light != LightOptions()):
        raise UserError(
            "--over uses the light of all photos; leave out --appearance, --to and the mixing options"
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
        count = len(done.day.phases)
        order = f"{count} photos ordered by light (EXIF times are missing or contradict it)"
        if done.day.by_time:
            order = f"{count - len(done.day.untimed)} photos ordered by EXIF time"
        if done.day.untimed:
            order += f", {len(done.day.untimed)} without a time by their light"
        console.print(f"{order}; shown: {', '.join(done.day.keys)}")
        for name, reason in done.day.left_out.items():
            console.print(f"{name} is left out: {reason}")
    if done.fps is None:
        console.print(f"{done.pictures} images -> {done.output}")
    else:
        width, height = done.size
        console.print(
            f"{done.pictures} frames, {width} x {height}, {done.pictures / done.fps:.1f} s -> {done.output}"
        )
