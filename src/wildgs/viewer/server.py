"""The viewer's server: where it listens, its addresses, and the empty page."""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np

from wildgs.errors import UserError
from wildgs.files import printable
from wildgs.viewer.config import LOCAL, ServerConfig

if TYPE_CHECKING:
    from wildgs.viewer.guarded import GuardedServer

REMEDY = "the viewer needs viser: pip install 'wildgs[viewer]'"


def open_server(config: ServerConfig, title: str) -> GuardedServer:
    """Starts an empty viewer page.

    Args:
        config: Where it listens.
        title: Stands above the controls.

    Raises:
        UserError: viser is not installed, the address is not one of this machine's, or sharing failed.
    """
    import_viser()
    from wildgs.viewer.guarded import GuardedServer

    _check_address(config)
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets in a box of its own
        server = GuardedServer(config.host, config.port, share=config.share)
    if config.share:
        public = server.request_share_url(verbose=False)
        if public is None:
            server.stop()
            raise UserError(
                "viser's relay gave no public address; leave --share out and use the local address"
            )
        server.access.allow_name(urlsplit(public).hostname or "")
    # viser's own share dialog would show the public address without the token.
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.set_panel_label(printable(title))
    server.scene.set_up_direction("+z")
    # What no Gaussian covers is black, as the rasteriser has it.
    server.scene.set_background_image(np.zeros((2, 2, 3), dtype=np.uint8), format="png")
    return server


def address(server: GuardedServer, config: ServerConfig) -> str:
    """What to type into a browser on this machine: the address with the viewer's token."""
    host = LOCAL if config.host in ("0.0.0.0", "::", "") else config.host
    local = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
    return f"{local}/{server.access.token}/"


def public_address(server: GuardedServer, config: ServerConfig) -> str | None:
    """The address at viser's relay, None unless the viewer is shared."""
    public = server.request_share_url(verbose=False) if config.share else None
    return None if public is None else f"{public.rstrip('/')}/{server.access.token}/"


def import_viser():
    """Imports viser, which is an optional dependency.

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
    """Refuses addresses that viser would try on a thousand ports, one after the other."""
    if not 0 <= config.port <= 65535:
        raise UserError(f"--port {config.port}: ports are 0 to 65535, 0 for any free one")
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(config.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(target)
    except OSError as error:
        raise UserError(
            f"--host {config.host}: this machine has no such address; use {LOCAL} for local access only,"
            " 0.0.0.0 for all interfaces"
        ) from error
