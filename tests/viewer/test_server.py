"""Who may reach the viewer, and one line for what cannot be."""

from __future__ import annotations

import contextlib
import http.client
import socket
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import pytest

from wildgs.errors import UserError
from wildgs.viewer.access import AccessControl
from wildgs.viewer.serving import ServerConfig, address, open_server, public_address

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from websockets.asyncio.client import connect as connect_async  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402
from websockets.typing import Origin, Subprotocol  # noqa: E402

if TYPE_CHECKING:
    from wildgs.viewer.guarded import GuardedServer


@pytest.fixture
def server() -> Iterator[GuardedServer]:
    server = open_server(ServerConfig(port=0), "title")
    yield server
    server.stop()


def test_listens_on_this_machine_only(server: GuardedServer) -> None:
    assert server.get_host() == "127.0.0.1"
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=20):
        pass
    with pytest.raises(OSError, match=r"refused|unreachable|timed out"):
        socket.create_connection(("127.0.0.2", server.get_port()), timeout=5)


def test_no_browser_can_make_it_public(server: GuardedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser answers a browser's request for a public address by asking its relay."""
    asked: list[bool] = []
    monkeypatch.setattr(
        viser.ViserServer, "request_share_url", lambda *_, **__: asked.append(True) or "https://x"
    )
    assert server.request_share_url() is None
    assert asked == []


def test_sharing_needs_the_flag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: "https://x.example/")
    config = ServerConfig(port=0, share=True)
    server = open_server(config, "title")
    assert public_address(server, config) == f"https://x.example/{server.access.token}/"
    path = f"/{server.access.token}/"
    assert server.access.refusal(path, ["x.example"], ["https://x.example"]) is None
    server.stop()
    assert public_address(server, ServerConfig(port=0)) is None


def test_relay_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: None)
    with pytest.raises(UserError, match="not provide a public URL"):
        open_server(ServerConfig(port=0, share=True), "title")


def test_taken_port_gives_the_next(server: GuardedServer) -> None:
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
    server = Mock()
    server.get_port.return_value = 81
    server.access.token = "secret"
    for host, expected in (("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::1", "[::1]")):
        assert address(server, ServerConfig(host=host)) == f"http://{expected}:81/secret/"


def get(server: GuardedServer, path: str, **headers: str) -> tuple[int, bytes]:
    """Status and body of a request, whose Host header can be any."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=20)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_page_needs_its_token(server: GuardedServer) -> None:
    token = server.access.token
    status, body = get(server, f"/{token}/")
    assert (status, b"<html" in body) == (200, True)
    for path in (
        "/",
        "/index.html",
        f"/{token[:-1]}/",
        f"/{token}x/",
        f"/?token={token}",
        "/%00/",
        f"//{token}/",
    ):
        status, body = get(server, path)
        assert (status, b"<html" in body, b"token" in body) == (403, False, True), path


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1.evil.example:8080"},
        {"Host": "evil.example:80@127.0.0.1"},
        {"Host": "203.0.113.9"},
        {"Host": "[::1"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "http://localhost.evil.example"},
    ],
)
def test_other_sites_get_nothing_even_with_the_token(server: GuardedServer, headers: dict[str, str]) -> None:
    status, body = get(server, f"/{server.access.token}/", **headers)
    assert status == 403
    assert len(body) < 200


def test_machine_is_known_by_its_own_names_only_where_it_listens_to_the_network() -> None:
    own = socket.gethostname().lower()
    network, loopback = AccessControl("0.0.0.0", "t"), AccessControl("127.0.0.1", "t")
    for host in (f"{own}:8080", "203.0.113.9:8080", "[2001:db8::1]:8080", "localhost:9000"):
        assert network.refusal("/t", [host], [f"http://{host}"]) is None, host
    assert network.refusal("/t", ["evil.example:8080"], []) is not None
    assert network.refusal("/", ["203.0.113.9:8080"], []) is not None, "the token is needed there, too"
    for host in ("127.0.0.1:9000", "localhost:9000", "[::1]:9000"):
        assert loopback.refusal("/t", [host], []) is None, "a tunnel may end at another port"
    assert loopback.refusal("/t", [f"{own}.lan:8080"], []) is not None
    assert loopback.refusal("/t", [], []) is not None
    assert loopback.refusal("/t", ["localhost", "localhost"], []) is not None
    assert loopback.refusal("/t", ["localhost"], ["http://localhost", "http://localhost"]) is not None


def test_tokens_are_random_and_long() -> None:
    tokens = {AccessControl("127.0.0.1").token for _ in range(8)}
    assert len(tokens) == 8
    assert min(map(len, tokens)) >= 32


def dial(
    server: GuardedServer, host: str | None = None, origin: str | None = None, token: str | None = None
) -> Any:
    """A WebSocket as viser's page opens it."""
    port = server.get_port()
    peer = socket.create_connection(("127.0.0.1", port), timeout=20)
    return connect(
        f"ws://{host or f'127.0.0.1:{port}'}/{server.access.token if token is None else token}",
        sock=peer,
        origin=Origin(origin) if origin is not None else None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
    )


def test_sockets_need_the_token_and_their_own_origin(server: GuardedServer) -> None:
    own = f"http://127.0.0.1:{server.get_port()}"
    with dial(server, origin=own) as connection:
        assert len(connection.recv(timeout=20)) > 100
    for wrong in (
        {"token": ""},
        {"token": "guess"},
        {"origin": "https://evil.example"},
        {"host": "evil.example"},
    ):
        with pytest.raises(InvalidStatus, match="403"), dial(server, **{"origin": own, **wrong}):
            pass


def test_server_that_cannot_be_guarded_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    from wildgs.viewer import guarded

    monkeypatch.setattr(guarded, "_hooks", lambda *_: contextlib.nullcontext([]))
    with pytest.raises(UserError, match=r"viser>=1\.1,<1\.2"):
        open_server(ServerConfig(port=0), "title")


def test_other_servers_of_the_process_are_left_alone(server: GuardedServer) -> None:
    """The hook goes by the module of the handler."""
    import asyncio

    import websockets.asyncio.server as module

    from wildgs.viewer import guarded

    async def handler(connection: Any) -> None:
        await connection.send("hello")

    async def ask() -> object:
        with guarded._hooks(server.access, lambda *_: False, lambda _: None) as taken:
            async with module.serve(handler, "127.0.0.1", 0) as other:
                port = other.sockets[0].getsockname()[1]
                async with connect_async(f"ws://127.0.0.1:{port}") as connection:
                    return taken, await connection.recv()

    original = module.serve
    with ThreadPoolExecutor(1) as pool:  # the main thread may have a running loop, of a browser's driver
        assert pool.submit(lambda: asyncio.run(ask())).result() == ([], "hello")
    assert module.serve is original


def test_title_may_be_any_folder_s_name() -> None:
    server = open_server(ServerConfig(port=0), "caf\udce9")
    with dial(server) as connection:
        assert b"caf" in _unpacked(connection.recv(timeout=20))
    server.stop()


def _unpacked(batch: bytes) -> bytes:
    """The messages in one of viser's batches: two lengths, then compressed MessagePack."""
    import zstandard

    size = int.from_bytes(batch[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(batch[16 : 16 + size])
