"""`wildgs view`: opens a run in the browser."""

from __future__ import annotations

import atexit
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.screen import console
from wildgs.files import printable
from wildgs.processes import TerminatedError, signals_as_interrupts
from wildgs.viewer.config import ServerConfig, ViewerConfig


@dataclass(frozen=True)
class Command:
    """Opens a run in the browser: navigate, change the light, jump to the photos' viewpoints, record a camera path.

    Example: wildgs view runs/gate
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    appearance: tuple[str, ...] = ()
    """One or two initial appearances: names of photos of the scene, or files."""
    server: tyro.conf.OmitArgPrefixes[ServerConfig] = field(default_factory=ServerConfig)
    viewer: tyro.conf.OmitArgPrefixes[ViewerConfig] = field(default_factory=ViewerConfig)


def run(command: Command) -> None:
    """Serves the page until interrupted."""
    import wildgs
    import wildgs.viewer.serving

    try:
        with signals_as_interrupts():
            opened = wildgs.view(
                command.run, appearance=command.appearance, server=command.server, viewer=command.viewer
            )
            for url in opened.urls:
                console.print(f"{printable(str(command.run))}: {url}", markup=False)
            console.print("Ctrl-C ends the viewer")
            opened.stay()
        console.print("closed")
    except TerminatedError as ended:
        print(ended, file=sys.stderr, flush=True)
        atexit._run_exitfuncs()  # temporary folders
        os._exit(ended.code)  # the server's threads may crash a normal interpreter shutdown
