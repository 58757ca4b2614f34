"""Who may reach the viewer, and one line for what cannot be."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from unittest.mock import Mock

import pytest

from wildgs.errors import UserError
from wildgs.viewer.server import ServerConfig, address, open_server

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = open_server(ServerConfig(port=0), "title")
    yield server
    server.stop()


def test_listens_on_this_machine_only(server: viser.ViserServer) -> None:
    assert server.get_host() == "127.0.0.1"
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=20):
        pass
    with pytest.raises(OSError, match=r"refused|unreachable|timed out"):
        socket.create_connection(("127.0.0.2", server.get_port()), timeout=5)


def test_no_browser_can_make_it_public(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser answers a browser's request for a public address by asking its relay."""
    asked: list[bool] = []
    monkeypatch.setattr(
        viser.ViserServer, "request_share_url", lambda *_, **__: asked.append(True) or "https://x"
    )
    assert server.request_share_url() is None
    assert asked == []


def test_sharing_needs_the_flag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: "https://x")
    server = open_server(ServerConfig(port=0, share=True), "title")
    assert server.request_share_url() == "https://x"
    server.stop()


def test_relay_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: None)
    with pytest.raises(UserError, match="no public address"):
        open_server(ServerConfig(port=0, share=True), "title")


def test_taken_port_gives_the_next(server: viser.ViserServer) -> None:
    other = open_server(ServerConfig(port=server.get_port()), "title")
    assert other.get_port() > server.get_port()
    other.stop()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ServerConfig(host="192.0.2.1"), "--host 192.0.2.1"),
        (ServerConfig(host="no.such.name.invalid"), "--host no.such.name.invalid"),
        (ServerConfig(port=70000), "--port 70000"),
    ],
)
def test_impossible_addresses_are_one_line(config: ServerConfig, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        open_server(config, "title")
    assert "\n" not in str(caught.value)


def test_without_viser_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=r"pip install 'wildgs\[viewer\]'"):
        open_server(ServerConfig(port=0), "title")


def test_address_is_one_to_type() -> None:
    server = Mock(spec=viser.ViserServer)
    server.get_port.return_value = 81
    for host, expected in (("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::1", "[::1]")):
        assert address(server, ServerConfig(host=host)) == f"http://{expected}:81"
