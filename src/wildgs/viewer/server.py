"""The viser server: where it listens, who may reach it, and how its page looks before there is anything on it."""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
from typing import TYPE_CHECKING

import numpy as np

from wildgs.errors import UserError
from wildgs.viewer.config import LOCAL, ServerConfig

if TYPE_CHECKING:
    import viser

REMEDY = "the viewer needs viser: pip install 'wildgs[viewer]'"


def open_server(config: ServerConfig, title: str) -> viser.ViserServer:
    """Starts an empty viewer page.

    Args:
        config: Where it listens.
        title: Stands above the controls.

    Raises:
        UserError: viser is not installed, the address is none of this machine's, or sharing failed.
    """
    viser = import_viser()
    _check_address(config)

    class Server(viser.ViserServer):
        """A server that no browser can tell to open a public address: viser itself lets every one of them."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return super().request_share_url(verbose) if config.share else None

    with contextlib.redirect_stdout(io.StringIO()):  # viser greets in a box of its own
        server = Server(host=config.host, port=config.port, verbose=False)
    if config.share and server.request_share_url(verbose=False) is None:
        server.stop()
        raise UserError("viser's relay gave no public address; leave --share out and look from this machine")
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=config.share)
    server.gui.set_panel_label(title)
    server.scene.set_up_direction("+z")
    # What no Gaussian covers is black, as the rasteriser has it.
    server.scene.set_background_image(np.zeros((2, 2, 3), dtype=np.uint8), format="png")
    return server


def address(server: viser.ViserServer, config: ServerConfig) -> str:
    """What to type into a browser on this machine."""
    host = LOCAL if config.host in ("0.0.0.0", "::", "") else config.host
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def import_viser():
    """The library, which is an extra.

    Raises:
        UserError: It is not installed; the message says how to get it.
    """
    try:
        return importlib.import_module("viser")
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise UserError(REMEDY) from error


def _check_address(config: ServerConfig) -> None:
    """Refuses what viser would try on one port after the other, for ever."""
    if not 0 <= config.port <= 65535:
        raise UserError(f"--port {config.port}: ports are 0 to 65535, and 0 takes any free one")
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(config.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(target)
    except OSError as error:
        raise UserError(
            f"--host {config.host}: this machine has no such address; {LOCAL} lets this machine in, 0.0.0.0 all"
        ) from error
