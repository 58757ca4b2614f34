"""Access control for the viewer: a random token in the address, and checks of the Host and Origin headers.

The token keeps out everyone who was not given the address. Host is checked against DNS rebinding (a name of
another site that resolves to this machine), Origin against pages of other sites that connect from a user's browser.
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

TOKEN_BYTES = 24


class AccessControl:
    """Decides which requests the viewer answers.

    Attributes:
        token: First segment of every path that is served.
    """

    def __init__(self, host: str, token: str | None = None) -> None:
        """Sets up the access control.

        Args:
            host: Address that the server listens on.
            token: None makes a random one.
        """
        self.token = token or secrets.token_urlsafe(TOKEN_BYTES)
        self._loopback_only = is_loopback(host)
        self._names = {"localhost", *(() if self._loopback_only else own_names(host))}

    def allow_name(self, name: str) -> None:
        """Accepts one more host name, such as that of a relay."""
        self._names.add(name.lower())

    def refusal(self, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
        """Why a request is refused, None if it is accepted.

        Args:
            path: Of the request, with the token as its first segment.
            hosts: All values of the Host header.
            origins: All values of the Origin header; browsers send one with every WebSocket handshake.
        """
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return "the Host header does not name this machine; use its IP address or its own name"
        if len(origins) > 1 or (origins and not self._same_origin(origins[0], hosts[0])):
            return "requests from pages of other sites are not accepted"
        given = _first_segment(path).encode("utf-8", "surrogatepass")  # paths may hold any bytes
        if not secrets.compare_digest(given, self.token.encode()):
            return "the address needs the viewer's token; copy it whole from the terminal that shows it"
        return None

    def without_token(self, path: str) -> str:
        """The path of an accepted request as the server behind it knows it."""
        return path[1 + len(self.token) :] or "/"

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname
        except ValueError:
            return False
        if not name or "@" in host:
            return False
        if name in self._names:
            return True
        # An address cannot be rebound, so any will do where the server listens to the network.
        return is_loopback(name) if self._loopback_only else _is_address(name)

    @staticmethod
    def _same_origin(origin: str, host: str) -> bool:
        return origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


def is_loopback(host: str) -> bool:
    """Whether a host name or address reaches this machine only."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def own_names(host: str) -> set[str]:
    """Names under which browsers in the network may know this machine."""
    name = socket.gethostname().lower()
    return {name, f"{name}.local", socket.getfqdn().lower(), host.lower()} - {""}


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _first_segment(path: str) -> str:
    return path.partition("?")[0].removeprefix("/").partition("/")[0]
