"""Uploads from browsers: bounded in size and number, and reported as done only once they are usable."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from wildgs.errors import UserError

MAX_BYTES = 64 * 2**20
"""Of one upload."""
MAX_OPEN = 4
"""Unfinished uploads of all browsers together."""
MAX_PARTS = 4096
IDLE_SECONDS = 60.0
"""After so long without a new part, an unfinished upload makes room for another."""
MAX_NAME = 255


@runtime_checkable
class Replies(Protocol):
    """Notifies a browser of the state of its upload."""

    def progress(self, connection: Hashable, upload: Upload, received: int) -> None:
        """So many bytes were received; all of them means that the upload has succeeded."""
        ...

    def failed(self, connection: Hashable, upload: Upload, reason: str) -> None:
        """The upload has failed."""
        ...


@dataclass(eq=False)
class Upload:
    """A transfer that has begun.

    Attributes:
        button: Id of the control it belongs to.
        transfer: Its id, chosen by the browser.
        name: File name, as the browser has it.
        size: Bytes in all.
        parts: Parts in all; they come in order.
        content: What was received.
        received_parts: How many parts that is.
        last: When the last part came, in seconds of the monotonic clock.
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
    """Collects the parts of uploads, and passes finished ones to the control that they are for.

    `start`, `part` and `drop` are called on the server's own thread only; finished uploads are used one after the
    other on a thread of their own, so that no two large pictures are decoded at once. `replies` notifies browsers.
    """

    def __init__(self, replies: Replies) -> None:
        self._replies = replies
        self._receivers: dict[str, Callable[[str, bytes], None]] = {}
        self._open: dict[tuple[Hashable, str], Upload] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="wildgs-upload")
        self._finishing: set[Upload] = set()

    def receive(self, button: str, receiver: Callable[[str, bytes], None]) -> None:
        """Sets the receiver of a control's uploads (name, content); it raises `UserError` for unusable ones."""
        self._receivers[button] = receiver

    def start(self, connection: Hashable, message: Mapping[str, Any]) -> None:
        """Begins an upload, or refuses it."""
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
                connection, upload, f"pictures may have up to {MAX_BYTES // 2**20} MB; send a smaller one"
            )
        if upload.size == 0 or upload.parts == 0:
            return self._replies.failed(connection, upload, "the picture is empty")
        self._forget_idle()
        if len(self._open) + len(self._finishing) >= MAX_OPEN:
            return self._replies.failed(connection, upload, "too many uploads at once; try again in a minute")
        self._open[connection, upload.transfer] = upload
        return None

    def part(self, connection: Hashable, message: Mapping[str, Any]) -> None:
        """Takes the next part of an upload."""
        key = connection, str(message.get("transfer_uuid"))[:100]
        upload, content = self._open.get(key), message.get("content")
        if upload is None:
            return
        expected = message.get("part_index") == upload.received_parts
        if not expected or not isinstance(content, bytes) or len(content) > upload.size - len(upload.content):
            del self._open[key]
            return self._replies.failed(connection, upload, "the upload was damaged on its way; try again")
        upload.content += content
        upload.received_parts += 1
        upload.last = time.monotonic()
        if upload.received_parts < upload.parts:
            # All bytes would mean success to the browser, and the picture has not been looked at.
            return self._replies.progress(connection, upload, min(len(upload.content), upload.size - 1))
        del self._open[key]
        self._finishing.add(upload)
        self._pool.submit(self._finish, connection, upload)
        return None

    def drop(self, connection: Hashable) -> None:
        """Forgets the unfinished uploads of a browser that has left."""
        for key in [key for key in self._open if key[0] == connection]:
            del self._open[key]

    def close(self) -> None:
        """Ends the thread that uses finished uploads."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _finish(self, connection: Hashable, upload: Upload) -> None:
        try:
            if len(upload.content) != upload.size:
                raise UserError("the upload was damaged on its way; try again")
            self._receivers[upload.button](upload.name, bytes(upload.content))
        except UserError as error:
            self._replies.failed(connection, upload, str(error))
        except Exception as error:  # a fault must reach the person who waits for the upload
            self._replies.failed(connection, upload, f"the upload failed ({type(error).__name__})")
        else:
            self._replies.progress(connection, upload, upload.size)
        finally:
            self._finishing.discard(upload)

    def _forget_idle(self) -> None:
        limit = time.monotonic() - IDLE_SECONDS
        for key in [key for key, upload in self._open.items() if upload.last < limit]:
            del self._open[key]
