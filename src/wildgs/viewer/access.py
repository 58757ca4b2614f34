"""Access control: a random token, checks of the Host and Origin headers, and validation of messages.

Only browsers with the token in their URL are served. The Host header is checked against DNS rebinding (a foreign
host name that resolves to this machine), the Origin header against connections from pages of other sites. viser
assigns any value in a message to any attribute that it names, so only messages that the viewer's page sends are
passed on, with finite numbers and values that the control allows. Other messages are dropped; a connection that
sends invalid data is closed.
"""

from __future__ import annotations

import ipaddress
import math
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

TOKEN_BYTES = 24


class AccessControl:
    """Decides which requests the viewer answers; `token` is the first segment of every served path."""

    def __init__(self, host: str, token: str | None = None) -> None:
        """Creates the access control of a server that listens on `host`; the default token is random."""
        self.token = token or secrets.token_urlsafe(TOKEN_BYTES)
        self._loopback_only = is_loopback(host)
        self._names = {"localhost", *(() if self._loopback_only else own_names(host))}

    def allow_name(self, name: str) -> None:
        """Accepts one more host name, such as that of a relay."""
        self._names.add(name.lower())

    def refusal(self, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
        """The reason why a request is refused; None if it is accepted.

        Args:
            path: Path of the request, with the token as its first segment.
            hosts: All values of the Host header.
            origins: All values of the Origin header, which browsers send with every WebSocket handshake.
        """
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return "the Host header does not name this machine; use its IP address or its own name"
        if len(origins) > 1 or (origins and not self._same_origin(origins[0], hosts[0])):
            return "requests from pages of other sites are not accepted"
        given = _first_segment(path).encode("utf-8", "surrogatepass")  # paths may contain any bytes
        if not secrets.compare_digest(given, self.token.encode()):
            return "the viewer's token is missing or wrong; copy the complete URL from the terminal"
        return None

    def without_token(self, path: str) -> str:
        """The path of an accepted request without the token, for viser's server."""
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
        # DNS rebinding needs a name, so any IP address is accepted if the server listens on the network.
        return is_loopback(name) if self._loopback_only else _is_address(name)

    @staticmethod
    def _same_origin(origin: str, host: str) -> bool:
        return origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


def is_loopback(host: str) -> bool:
    """Whether a host name or address reaches this machine only."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def own_names(host: str) -> set[str]:
    """Host names by which browsers in the network may address this machine."""
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


MAX_MESSAGE_BYTES = 4 * 2**20
"""Largest message; parts of uploads have 512 KiB."""
MAX_COORDINATE = 1e6
"""Largest coordinate of cameras and clicks, in scene units."""
MAX_WINDOW = 16_384
"""Largest width and height of a browser's window in pixels."""
MAX_TEXT = 1000

FindControl = Callable[[str], Any]
"""Returns the handle of the control with an id, or None."""


class MalformedMessageError(Exception):
    """Data that is not a message of viser's protocol."""


def decode(raw: object) -> dict[str, Any]:
    """Decodes a message.

    Raises:
        MalformedMessageError: The data is not a MessagePack map with a type.
    """
    import msgspec

    if not isinstance(raw, bytes):
        raise MalformedMessageError("messages are binary")
    try:
        message = msgspec.msgpack.decode(raw)
    except (msgspec.DecodeError, RecursionError, ValueError, MemoryError) as error:
        raise MalformedMessageError(str(error)) from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise MalformedMessageError("messages are maps with a type")
    return message


def is_acceptable(message: Mapping[str, Any], find_control: FindControl) -> bool:
    """Whether a message may be passed on to viser."""
    fields = {name: value for name, value in message.items() if name != "type"}
    match message["type"]:
        case "GuiUpdateMessage":
            return _good_update(fields, find_control)
        case "ViewerCameraMessage":
            return _good_camera(fields)
        case "SceneNodeClickMessage":
            return _good_click(fields)
        case "GetRenderResponseMessage":
            return _has(fields, {"payload": bytes, "render_uuid": str})
        case _:
            return False


def _good_update(fields: Mapping[str, Any], find_control: FindControl) -> bool:
    if not _has(fields, {"uuid": str, "updates": dict}) or list(fields["updates"]) != ["value"]:
        return False
    control = find_control(fields["uuid"])
    return control is not None and _fits(fields["updates"]["value"], control)


def _fits(value: Any, control: Any) -> bool:
    """Whether a control allows a value; False for other types of controls."""
    import viser

    if getattr(control, "disabled", False):
        return False
    if isinstance(control, viser.GuiSliderHandle):
        return _is_number(value, MAX_COORDINATE) and control.min <= value <= control.max
    if isinstance(control, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
        return isinstance(value, str) and value in control.options
    return isinstance(control, viser.GuiCheckboxHandle | viser.GuiButtonHandle) and isinstance(value, bool)


def _good_camera(fields: Mapping[str, Any]) -> bool:
    vectors = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
    numbers = {"fov", "near", "far", "image_height", "image_width"}
    if set(fields) != {*vectors, *numbers} or not _are_vectors(fields, vectors):
        return False
    if not all(_is_number(fields[name], 1e9) and fields[name] > 0 for name in numbers):
        return False
    sizes = fields["image_height"], fields["image_width"]
    return fields["fov"] < math.pi and max(sizes) <= MAX_WINDOW and math.hypot(*fields["wxyz"]) > 1e-6


def _good_click(fields: Mapping[str, Any]) -> bool:
    optional = {"instance_index": int | None, "modifier": str | None}
    vectors = {"ray_origin": 3, "ray_direction": 3, "screen_pos": 2}
    rest = {"owner": "", **{name: value for name, value in fields.items() if name not in vectors}}
    return _has(rest, {"name": str, "owner": str, **optional}) and _are_vectors(fields, vectors)


def _has(fields: Mapping[str, Any], kinds: Mapping[str, Any]) -> bool:
    """Whether a message has exactly these fields with these types, and no long text."""
    if set(fields) != set(kinds) or not all(isinstance(fields[name], kind) for name, kind in kinds.items()):
        return False
    return all(len(value) <= MAX_TEXT for value in fields.values() if isinstance(value, str))


def _are_vectors(fields: Mapping[str, Any], lengths: Mapping[str, int]) -> bool:
    return all(
        isinstance(fields.get(name), list)
        and len(fields[name]) == length
        and all(_is_number(value, MAX_COORDINATE) for value in fields[name])
        for name, length in lengths.items()
    )


def _is_number(value: object, limit: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= limit
