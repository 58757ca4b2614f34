"""`wildgs appearance`: saves the light of a photo, or a mix of several, as a small file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.options import Mix
from wildgs.cli.screen import console, print_notes, progress_shown
from wildgs.library.config import MixOptions


@dataclass(frozen=True)
class Command:
    """Saves an appearance, which --appearance of render, gallery, export and view accepts.

    The safetensors file contains no code. It is valid for this run at its current step.

    Example: wildgs appearance runs/gate evening.jpg --output evening.safetensors
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    photo: tyro.conf.Positional[tuple[str, ...]]
    """Name of a photo of the scene, file of a new photo or any image, or neutral; several with --weights."""
    output: Path
    """File to write (.safetensors)."""
    mix: Mix = field(default_factory=MixOptions)


def run(command: Command) -> None:
    """Embeds the photos and saves the appearance."""
    import wildgs

    with progress_shown() as screen:
        saved = wildgs.appearance(
            command.run, command.photo, command.output, mixing=command.mix, progress=screen
        )
    print_notes([saved.look])
    console.print(f"{saved.look.name} -> {saved.file} ({saved.file.stat().st_size / 1e6:.1f} MB)")
