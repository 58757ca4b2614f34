"""`wildgs view`: fly through a run in the browser, under any light."""

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
    """Opens a run in the browser: fly, change the light, stand where photos were taken, record a path.

    Example: wildgs view runs/gate
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    appearance: tuple[str, ...] = ()
    """One or two lights to begin with: photos of the scene by name, or files."""
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
        os._exit(ended.code)  # the page is closed; the server's threads may abort the interpreter's own end
