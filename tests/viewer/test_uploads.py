"""Pictures in parts: bounded, and done only when they are usable."""

from __future__ import annotations

import threading
from collections.abc import Hashable
from typing import Any

import pytest

from wildgs.errors import UserError
from wildgs.viewer.uploads import MAX_BYTES, MAX_OPEN, Upload, Uploads

PART = 512 * 1024


class Replies:
    def __init__(self) -> None:
        self.said: list[tuple[str, Any]] = []
        self.done = threading.Event()

    def progress(self, connection: Hashable, upload: Upload, received: int) -> None:
        self.said.append((upload.transfer, received))
        if received == upload.size:
            self.done.set()

    def failed(self, connection: Hashable, upload: Upload, reason: str) -> None:
        self.said.append((upload.transfer, reason))
        self.done.set()


@pytest.fixture
def replies() -> Replies:
    return Replies()


@pytest.fixture
def taken() -> list[tuple[str, bytes]]:
    return []


@pytest.fixture
def uploads(replies: Replies, taken: list[tuple[str, bytes]]):
    uploads = Uploads(replies)

    def take(name: str, content: bytes) -> None:
        if name == "bad":
            raise UserError("not a readable image")
        if name == "fault":
            raise RuntimeError("a fault")
        taken.append((name, content))

    uploads.receive("button", take)
    yield uploads
    uploads.close()


def begin(
    name: str = "a.png", size: int = 10, parts: int = 2, transfer: str = "t", button: str = "button"
) -> dict:
    return {
        "source_component_uuid": button,
        "transfer_uuid": transfer,
        "filename": name,
        "mime_type": "image/png",
        "part_count": parts,
        "size_bytes": size,
    }


def part(index: int, content: object, transfer: str = "t") -> dict:
    return {
        "source_component_uuid": "button",
        "transfer_uuid": transfer,
        "part_index": index,
        "content": content,
    }


def test_parts_become_a_picture(uploads: Uploads, replies: Replies, taken) -> None:
    uploads.start("me", begin())
    uploads.part("me", part(0, b"01234"))
    assert replies.said == [("t", 5)]
    uploads.part("me", part(1, b"56789"))
    assert replies.done.wait(20)
    assert taken == [("a.png", b"0123456789")]
    assert replies.said[-1] == ("t", 10)


@pytest.mark.parametrize("name", ["bad", "fault"])
def test_a_picture_that_cannot_be_used_never_reaches_all_of_its_bytes(
    uploads: Uploads, replies: Replies, name: str
) -> None:
    """All bytes received is what the page calls a success."""
    uploads.start("me", begin(name, parts=1))
    uploads.part("me", part(0, b"0123456789"))
    assert replies.done.wait(20)
    ((_, reason),) = replies.said
    assert "not a readable" in reason or "RuntimeError" in reason


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (begin(size=MAX_BYTES + 1), "limited to 64 MB"),
        (begin(parts=10**9), "limited to 64 MB"),
        (begin(size=0, parts=0), "empty"),
        (begin(size=5, parts=0), "empty"),
    ],
)
def test_impossible_uploads_are_refused_at_once(
    uploads: Uploads, replies: Replies, message, reason: str
) -> None:
    uploads.start("me", message)
    uploads.part("me", part(0, b"x"))
    ((_, said),) = replies.said
    assert reason in said


@pytest.mark.parametrize(
    "message",
    [
        begin(button="other"),
        begin() | {"size_bytes": 1.5},
        begin() | {"size_bytes": -1},
        begin() | {"part_count": True},
        begin() | {"filename": 7},
        {},
    ],
)
def test_nonsense_is_ignored(uploads: Uploads, replies: Replies, message) -> None:
    uploads.start("me", message)
    uploads.part("me", part(0, b"x"))
    assert (replies.said, uploads._open) == ([], {})


@pytest.mark.parametrize("wrong", [part(1, b"0"), part(0, b"x" * 11), part(0, "text"), part(0, None)])
def test_parts_that_do_not_fit_end_the_upload(uploads: Uploads, replies: Replies, wrong) -> None:
    uploads.start("me", begin())
    uploads.part("me", wrong)
    assert "corrupted" in replies.said[-1][1]
    assert uploads._open == {}


def test_too_few_bytes_are_a_failure(uploads: Uploads, replies: Replies, taken) -> None:
    uploads.start("me", begin(parts=1))
    uploads.part("me", part(0, b"0"))
    assert replies.done.wait(20)
    assert "corrupted" in replies.said[-1][1]
    assert taken == []


def test_unfinished_uploads_are_few(
    uploads: Uploads, replies: Replies, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(MAX_OPEN + 3):
        uploads.start(f"browser {number % 2}", begin(size=MAX_BYTES, parts=128, transfer=str(number)))
    assert len(uploads._open) == MAX_OPEN
    assert [reason for _, reason in replies.said] == ["too many uploads at once; try again in a minute"] * 3
    uploads.drop("browser 0")
    assert len(uploads._open) == MAX_OPEN // 2, "who leaves takes theirs along"
    monkeypatch.setattr("wildgs.viewer.uploads.IDLE_SECONDS", -1.0)
    uploads.start("me", begin())
    assert list(uploads._open) == [("me", "t")], "what rests makes room"


def test_others_cannot_add_parts(uploads: Uploads, replies: Replies) -> None:
    uploads.start("me", begin())
    uploads.part("somebody else", part(0, b"01234"))
    assert replies.said == []
