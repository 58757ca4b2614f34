"""Uploads from browsers: limited in size and number, and reported as successful only if they can be used."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from wildgs.errors import UserError

MAX_BYTES = 64 * 2**20
"""Largest upload."""
MAX_OPEN = 4
"""Largest number of unfinished uploads of all browsers."""
MAX_PARTS = 4096
IDLE_SECONDS = 60.0
"""Time after which an unfinished upload without new parts is discarded."""
MAX_NAME = 255


@runtime_checkable
class Replies(Protocol):
    """Notifies a browser of the state of its upload."""

    def progress(self, connection: Hashable, upload: Upload, received: int) -> None:
        """Reports the number of bytes received; the full size means success."""
        ...

    def failed(self, connection: Hashable, upload: Upload, reason: str) -> None:
        """Reports that the upload failed."""
        ...


@dataclass(eq=False)
class Upload:
    """An upload in progress.

    Attributes:
        button: Id of the upload control.
        transfer: Id of the upload, chosen by the browser.
        name: File name sent by the browser.
        size: Total number of bytes.
        parts: Total number of parts, which arrive in order.
        content: Received bytes.
        received_parts: Number of received parts.
        last: Time of the last part, in seconds of the monotonic clock.
    """

    button: str
    transfer: str
    name: str
    size: int
    parts: int
    content: bytearray = field(default_factory=bytearray)
    received_parts: int = 0
    last: float = field(default_factory=time.monotonic)


class Uploads:
    """Collects the parts of uploads and passes finished ones to their control's receiver.

    `start`, `part` and `drop` are called on the server's thread only. Finished uploads are processed one at a time
    on another thread, to limit memory. `replies` notifies browsers.
    """

    def __init__(self, replies: Replies) -> None:
        self._replies = replies
        self._receivers: dict[str, Callable[[str, bytes], None]] = {}
        self._open: dict[tuple[Hashable, str], Upload] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="wildgs-upload")
        self._finishing: set[Upload] = set()

    def receive(self, button: str, receiver: Callable[[str, bytes], None]) -> None:
        """Sets the receiver of a control's uploads, called with (name, content); it may raise `UserError`."""
        self._receivers[button] = receiver

    def start(self, connection: Hashable, message: Mapping[str, Any]) -> None:
        """Starts or rejects an upload."""
        values = [message.get(name) for name in ("source_component_uuid", "transfer_uuid", "filename")]
        counts = [message.get(name) for name in ("size_bytes", "part_count")]
        button, transfer, name = values
        size, parts = counts
        if not all(isinstance(value, str) for value in values) or button not in self._receivers:
            return
        if not all(type(value) is int and value >= 0 for value in counts):
            return
        upload = Upload(
            str(button), str(transfer)[:100], str(name)[:MAX_NAME], int(size or 0), int(parts or 0)
        )
        if upload.size > MAX_BYTES or upload.parts > MAX_PARTS:
            return self._replies.failed(
                connection, upload, f"images are limited to {MAX_BYTES // 2**20} MB; upload a smaller one"
            )
        if upload.size == 0 or upload.parts == 0:
            return self._replies.failed(connection, upload, "the image is empty")
        self._forget_idle()
        if len(self._open) + len(self._finishing) >= MAX_OPEN:
            return self._replies.failed(connection, upload, "too many uploads at once; try again in a minute")
        self._open[connection, upload.transfer] = upload
        return None

    def part(self, connection: Hashable, message: Mapping[str, Any]) -> None:
        """Receives the next part of an upload."""
        key = connection, str(message.get("transfer_uuid"))[:100]
        upload, content = self._open.get(key), message.get("content")
        if upload is None:
            return
        expected = message.get("part_index") == upload.received_parts
        if not expected or not isinstance(content, bytes) or len(content) > upload.size - len(upload.content):
            del self._open[key]
            return self._replies.failed(connection, upload, "the upload was corrupted; try again")
        upload.content += content
        upload.received_parts += 1
        upload.last = time.monotonic()
        if upload.received_parts < upload.parts:
            # Less than the full size, which would mean success before the image is decoded.
            return self._replies.progress(connection, upload, min(len(upload.content), upload.size - 1))
        del self._open[key]
        self._finishing.add(upload)
        self._pool.submit(self._finish, connection, upload)
        return None

    def drop(self, connection: Hashable) -> None:
        """Discards the unfinished uploads of a closed connection."""
        for key in [key for key in self._open if key[0] == connection]:
            del self._open[key]

    def close(self) -> None:
        """Stops the thread that processes finished uploads."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _finish(self, connection: Hashable, upload: Upload) -> None:
        try:
            if len(upload.content) != upload.size:
                raise UserError("the upload was corrupted; try again")
            self._receivers[upload.button](upload.name, bytes(upload.content))
        except UserError as error:
            self._replies.failed(connection, upload, str(error))
        except Exception as error:  # any error is reported to the browser
            self._replies.failed(connection, upload, f"the upload failed ({type(error).__name__})")
        else:
            self._replies.progress(connection, upload, upload.size)
        finally:
            self._finishing.discard(upload)

    def _forget_idle(self) -> None:
        limit = time.monotonic() - IDLE_SECONDS
        for key in [key for key, upload in self._open.items() if upload.last < limit]:
            del self._open[key]
