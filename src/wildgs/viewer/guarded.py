"""viser's server with access control and validation of messages, neither of which viser has.

viser 1.1 starts its HTTP and WebSocket server by `websockets.asyncio.server.serve` and offers no hook. While a
`GuardedServer` is constructed, that function is replaced by one that adds the hooks documented by websockets:
`process_request` for access control and `create_connection` for incoming messages. If the replacement was not
called, the server is stopped at once.
"""

from __future__ import annotations

import contextlib
import http
import inspect
import logging
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from wildgs.errors import UserError
from wildgs.viewer.access import (
    MAX_MESSAGE_BYTES,
    AccessControl,
    MalformedMessageError,
    decode,
    is_acceptable,
)
from wildgs.viewer.uploads import Upload, Uploads

POLICY_VIOLATION = 1008
"""WebSocket close code."""
PRIVACY_HEADERS = {
    "Referrer-Policy": "no-referrer",  # the URL contains the token
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_hook_lock = threading.Lock()


class GuardedServer(viser.ViserServer):
    """A viser server that answers only requests with its token, and acts only on valid messages."""

    def __init__(self, host: str, port: int, *, share: bool = False) -> None:
        """Starts the server on the first free port from `port` on; `share` allows a public URL by viser's relay.

        Raises:
            UserError: The installed version of viser is not supported.
        """
        self.access = AccessControl(host)
        self.uploads = Uploads(_BrowserReplies(self))
        self._may_share = share
        with _hooks(self.access, self._passes, self.uploads.drop) as calls:
            super().__init__(host=host, port=port, verbose=False)
        if not calls:
            self.stop()
            raise UserError(
                f"viser {viser.__version__} is not supported, because its server cannot be protected: "
                "pip install 'viser>=1.1,<1.2'"
            )

    def request_share_url(self, verbose: bool = True) -> str | None:
        """The public URL of viser's relay; None unless sharing is on, also when a browser requests it."""
        return super().request_share_url(verbose) if self._may_share else None

    def stop(self) -> None:
        """Stops the server."""
        self.uploads.close()
        super().stop()

    def _passes(self, connection: ServerConnection, raw: object) -> bool:
        """Handles a message of an upload; else, whether the message may be passed on to viser.

        Raises:
            MalformedMessageError: The data is not a message.
        """
        message = decode(raw)
        if message["type"] == "FileTransferStartUpload":
            self.uploads.start(connection, message)
        elif message["type"] == "FileTransferPart":
            self.uploads.part(connection, message)
        else:
            return is_acceptable(message, self.gui._gui_input_handle_from_uuid.get)
        return False

    def client_of(self, connection: Hashable) -> viser.ClientHandle | None:
        """The client of a connection; None if it has disconnected."""
        for number, live in list(self._websock_server._live_connections.items()):
            if live is connection:
                return self.get_clients().get(number)
        return None


class _BrowserReplies:
    """Replies to uploads by messages of viser's protocol."""

    def __init__(self, server: GuardedServer) -> None:
        self._server = server

    def progress(self, connection: Hashable, upload: Upload, received: int) -> None:
        client = self._server.client_of(connection)
        if client is not None:
            self._acknowledge(client, upload, received)

    def failed(self, connection: Hashable, upload: Upload, reason: str) -> None:
        client = self._server.client_of(connection)
        if client is None:
            return
        # The page reports success when all bytes are acknowledged, so its notification is removed first.
        queue = client._websock_connection.queue_message
        queue(_messages.RemoveNotificationMessage(uuid=f"upload-{upload.transfer}"))
        client.flush()
        self._acknowledge(client, upload, upload.size)
        client.add_notification(
            "Upload failed", f"{upload.name}: {reason}", color="red", auto_close_seconds=15
        )

    @staticmethod
    def _acknowledge(client: viser.ClientHandle, upload: Upload, received: int) -> None:
        message = _messages.FileTransferPartAck(upload.button, upload.transfer, received, upload.size)
        client._websock_connection.queue_message(message)


@contextlib.contextmanager
def _hooks(
    access: AccessControl,
    passes: Callable[[ServerConnection, object], bool],
    left: Callable[[Hashable], None],
) -> Iterator[list[bool]]:
    """Adds access control and validation of messages to the server that viser starts in the block.

    Yields:
        A list that is not empty if such a server was started.
    """
    module: Any = websockets.asyncio.server
    original, calls = module.serve, []

    def serve(handler: Callable[..., Any], *positional: Any, **options: Any) -> Any:
        if not str(handler.__module__).startswith("viser."):
            return original(handler, *positional, **options)
        options["process_request"] = _with_access_control(access, options.get("process_request"))
        options["create_connection"] = _connection_type(passes, left)
        options["max_size"] = MAX_MESSAGE_BYTES
        options["logger"] = _quiet_logger()
        calls.append(True)
        return original(handler, *positional, **options)

    with _hook_lock:
        module.serve = serve
        try:
            yield calls
        finally:
            module.serve = original


def _with_access_control(access: AccessControl, inner: Callable[..., Any] | None) -> Callable[..., Any]:
    async def process_request(connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        reason = access.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
        if reason is not None:
            return _forbidden(reason)
        request.path = access.without_token(request.path)
        response = None if inner is None else inner(connection, request)
        if inspect.isawaitable(response):
            response = await response
        if response is not None:
            for name, value in PRIVACY_HEADERS.items():
                response.headers[name] = value
        return response

    return process_request


def _forbidden(reason: str) -> Response:
    body = f"403: {reason}\n".encode()
    headers = Headers(
        {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    )
    headers.update(PRIVACY_HEADERS)
    return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", headers, body)


def _connection_type(
    passes: Callable[[ServerConnection, object], bool], left: Callable[[Hashable], None]
) -> type[ServerConnection]:
    class CheckedConnection(ServerConnection):
        """A connection that passes only valid messages on to viser."""

        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                try:
                    raw = await super().recv(decode)
                except ConnectionClosed:
                    left(self)
                    raise
                try:
                    if passes(self, raw):
                        return raw
                except MalformedMessageError:
                    await self.close(POLICY_VIOLATION, "not a message of the viewer's page")

    return CheckedConnection


def _quiet_logger() -> logging.Logger:
    """A logger without tracebacks of failed handshakes, which port scanners cause."""
    logger = logging.getLogger("wildgs.viewer.connections")
    if not logger.filters:
        logger.addFilter(lambda record: record.getMessage() != "opening handshake failed")
    return logger
