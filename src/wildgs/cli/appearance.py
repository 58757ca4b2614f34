"""`wildgs appearance`: the light of a photo, or a mix of several, as a small file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from wildgs.api import load
from wildgs.cli.lights import MixOptions, find_looks
from wildgs.cli.progress import console
from wildgs.errors import UserError
from wildgs.light.saved import save_look


@dataclass(frozen=True)
class Command:
    """Saves an appearance, to be used wherever --appearance is: render, export, view.

    Example: wildgs appearance runs/gate evening.jpg --output evening.safetensors

    The file belongs to the run at its present step, and holds no code (safetensors).
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    photo: tyro.conf.Positional[tuple[str, ...]]
    """Photo of the scene by name, file of a new photo or any picture, or neutral; several with --weights."""
    output: Path
    """File to write, ending in .safetensors."""
    mix: Annotated[MixOptions, tyro.conf.arg(name="")] = field(default_factory=MixOptions)


def run(command: Command) -> None:
    """Finds the look and saves it."""
    scene = load(command.run)
    looks = find_looks(scene, command.mix, command.photo)
    if len(looks) != 1:
        raise UserError(
            f"{len(looks)} appearances do not go into one file; give one, or mix them by --weights"
        )
    file = save_look(looks[0], command.output)
    console.print(f"{looks[0].name} -> {file} ({file.stat().st_size / 1e6:.1f} MB)")
