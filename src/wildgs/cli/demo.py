"""`wildgs demo`: trains on the built-in landmark and writes web pages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wildgs.cli.screen import print_finished, progress_shown


@dataclass(frozen=True)
class Command:
    """Trains Wild-GS and plain 3DGS on 40 photos of the built-in landmark, scores both and writes two web pages.

    Example: wildgs demo --output wildgs-demo
    """

    output: Path = Path("wildgs-demo")
    """Folder for the scene, both runs, report.html and scene.html."""
    steps: int = 1500
    """Training steps of each method."""


def run(command: Command) -> None:
    """Trains, scores and writes the pages."""
    import wildgs

    with progress_shown() as screen:
        finished = wildgs.demo(command.output, steps=command.steps, progress=screen, observers=[screen.step])
    print_finished(finished)
