"""What viser may act on of that which browsers send."""

from __future__ import annotations

import math
from typing import Any

import pytest

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

import msgspec  # noqa: E402

from wildgs.viewer.access import MalformedMessageError, decode, is_acceptable  # noqa: E402
from wildgs.viewer.serving import ServerConfig, open_server  # noqa: E402

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0.5, 1, 2],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000,
    "image_height": 700,
    "image_width": 1000,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}
CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage",
    "name": "/photos/3",
    "instance_index": None,
    "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1],
    "screen_pos": [0.5, 0.5],
    "modifier": None,
    "owner": "",
}


@pytest.fixture(scope="module")
def controls():
    server = open_server(ServerConfig(port=0), "title")
    gui = server.gui
    made = {
        "slider": gui.add_slider("a", 1.0, 60.0, 0.5, 6.0),
        "dropdown": gui.add_dropdown("b", ("360", "480")),
        "group": gui.add_button_group("c", ("Left", "Right")),
        "checkbox": gui.add_checkbox("d", False),
        "button": gui.add_button("e"),
        "disabled": gui.add_button("f", disabled=True),
        "upload": gui.add_upload_button("g"),
        "text": gui.add_html("h"),
    }
    yield made
    server.stop()


def update(control: str, value: object, name: str = "value") -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": control, "updates": {name: value}}


@pytest.mark.parametrize(
    "message",
    [
        CAMERA,
        CLICK,
        {name: value for name, value in CLICK.items() if name != "owner"},
        update("slider", 6.5),
        update("slider", 60),
        update("dropdown", "480"),
        update("group", "Right"),
        update("checkbox", True),
        update("button", True),
        {"type": "GetRenderResponseMessage", "payload": b"png", "render_uuid": "x"},
    ],
)
def test_what_the_page_sends_passes(message: dict[str, Any], controls) -> None:
    assert is_acceptable(decode(msgspec.msgpack.encode(message)), controls.get)


@pytest.mark.parametrize(
    "message",
    [
        *(
            update("slider", value)
            for value in (math.nan, math.inf, 1e7, 0.99, True, "6", [6.0], None, 2**70)
        ),
        *(update("dropdown", value) for value in ("30000", "", 480, None, ["480"])),
        *(update("group", value) for value in ("Both", None)),
        *(update("checkbox", value) for value in (1, "yes", None)),
        *(update(control, True) for control in ("disabled", "upload", "text", "none", "")),
        *(
            update("slider", value, name)
            for name, value in (("removed", True), ("update_cb", []), ("max", 1e9))
        ),
        {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"value": 2.0, "removed": True}},
        {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {}},
        {"type": "GuiUpdateMessage", "uuid": ["slider"], "updates": {"value": 2.0}},
        {"type": "GuiUpdateMessage", "uuid": "slider"},
        *(CAMERA | {"fov": value} for value in (0, -1, math.pi, math.nan, "wide", True)),
        *(CAMERA | {"position": value} for value in ([0, 0], [0, 0, math.nan], [1e9, 0, 0], "abc", None)),
        CAMERA | {"wxyz": [0, 0, 0, 0]},
        CAMERA | {"image_width": 10**6},
        CAMERA | {"image_height": 0},
        CAMERA | {"more": 1},
        CLICK | {"name": "x" * 5000},
        CLICK | {"owner": 5},
        CLICK | {"screen_pos": [math.inf, 0]},
        {"type": "ShareUrlRequest"},
        {"type": "GuiFormDirtyMessage", "uuid": "x"},
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": "NotificationShowMessage"},
    ],
)
def test_everything_else_is_dropped(message: dict[str, Any], controls) -> None:
    assert not is_acceptable(message, controls.get)


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"\xc1",
        b"\x93\x01\x02\x03",
        "text",
        msgspec.msgpack.encode({"kind": 1}),
        b"\x91" * 100_000,
        b"\xdf\xff",
    ],
)
def test_what_is_no_message_is_told_apart(raw: object) -> None:
    with pytest.raises(MalformedMessageError):
        decode(raw)
