"""Decoded photos within a byte limit."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.errors import UserError
from wildgs.scene import load_scene
from wildgs.scene.config import parse_bytes
from wildgs.scene.image_cache import _WINDOW, AHEAD, ImageCache, available_memory
from wildgs.scene.images import Photo

SIDE = 10
BYTES = SIDE * SIDE * 3


def picture(value: int) -> Photo:
    return Photo(np.full((SIDE, SIDE, 3), value % 256, dtype=np.uint8))


@pytest.mark.parametrize(
    ("text", "count"),
    [("4GB", 4 * 10**9), ("500 MB", 5 * 10**8), ("2GiB", 2 * 2**30), ("1.5k", 1500), ("0", 0), ("7b", 7)],
)
def test_sizes_as_people_write_them(text: str, count: int) -> None:
    assert parse_bytes(text) == count


@given(st.text(max_size=12))
def test_other_text_is_no_size(text: str) -> None:
    with contextlib.suppress(UserError):
        assert parse_bytes(text) >= 0


def test_a_cache_that_is_no_size_is_refused() -> None:
    with pytest.raises(UserError, match="4GB"):
        parse_bytes("plenty")


@given(st.lists(st.integers(0, 29), max_size=80), st.integers(0, 40), st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_order_gives_the_right_photos_within_the_limit(
    order: list[int], photos: int, ahead: bool
) -> None:
    cache = ImageCache(photos * BYTES)
    for index in range(30):
        cache.put(str(index), picture(index))
    for position, index in enumerate(order):
        if ahead:
            for later in order[position + 1 : position + 1 + AHEAD]:
                cache.prefetch(str(later), lambda later=later: picture(later))
        found = cache.get(str(index), lambda index=index: picture(index))
        assert int(found.pixels[0, 0, 0]) == index
        assert cache.num_bytes <= max(photos, _WINDOW) * BYTES


def test_what_fits_is_never_decoded_again() -> None:
    cache = ImageCache(100 * BYTES)
    for index in range(100):
        cache.put(str(index), picture(index))
    for index in range(100):
        cache.get(str(index), lambda: pytest.fail("it is in the cache"))
    assert cache.decoded == 0


def test_rounds_hit_as_often_as_the_limit_allows() -> None:
    cache = ImageCache(60 * BYTES)
    for index in range(100):
        cache.put(str(index), picture(index))
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        for index in torch.randperm(100, generator=generator).tolist():
            cache.get(str(index), lambda index=index: picture(index))
    assert 5 * 40 <= cache.decoded <= 5 * (40 + _WINDOW)


def test_background_threads_decode_ahead() -> None:
    cache = ImageCache(0)
    threads: list[str] = []

    def load() -> Photo:
        threads.append(threading.current_thread().name)
        return picture(3)

    cache.prefetch("a", load)
    assert int(cache.get("a", load).pixels[0, 0, 0]) == 3
    assert len(threads) == 1
    assert threads[0].startswith("decode")


def test_a_photo_that_vanished_is_named(make_scene: Callable[..., Path]) -> None:
    root = make_scene(3)
    scene = load_scene(root, lazy=True, image_cache="0")
    name = scene.views[1].name
    (root / "images" / name).unlink()
    scene.views[1].prefetch()
    for _ in range(2):
        with pytest.raises(UserError, match=rf"{name}: no such file; restore or replace the photo"):
            scene.views[1].read_photo()


def test_a_scene_reads_the_same_through_the_smallest_cache(make_scene: Callable[..., Path]) -> None:
    root = make_scene(12)
    large, small = load_scene(root), load_scene(root, image_cache="1kB")
    for a, b in zip(large.views, small.views, strict=True):
        b.prefetch()
        assert torch.equal(a.read_photo(), b.read_photo())


def test_free_memory_is_known_here() -> None:
    available = available_memory()
    assert available is None or available > 2**20
