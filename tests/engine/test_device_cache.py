"""The GPU's cache of photos, on the CPU with a capacity of its own."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from wildgs.engine.device_cache import DeviceCache
from wildgs.engine.feed import PhotoFeed, ViewSampler
from wildgs.engine.team import Team
from wildgs.errors import UserError
from wildgs.scene import Scene

CPU = torch.device("cpu")


class Reader:
    def __init__(self, value: Tensor | None) -> None:
        self.value, self.calls = value, 0

    def __call__(self) -> Tensor | None:
        self.calls += 1
        return self.value


def test_what_fits_is_read_once_and_the_rest_every_time():
    cache = DeviceCache(CPU, capacity=25)
    readers = [Reader(torch.full((size,), float(size))) for size in (4, 3, 2)]  # 16, 12 and 8 bytes
    for _ in range(3):
        for name, reader in zip("abc", readers, strict=True):
            assert torch.equal(cache.get("photo", name, reader), reader.value)
    assert [reader.calls for reader in readers] == [1, 3, 1]
    assert [("photo", name) in cache for name in "abc"] == [True, False, True]


def test_photos_without_a_tensor_are_asked_once():
    cache, reader = DeviceCache(CPU, capacity=1), Reader(None)
    assert [cache.get("depth", "a", reader) for _ in range(2)] == [None, None]
    assert reader.calls == 1


def test_kinds_are_kept_apart():
    cache = DeviceCache(CPU, capacity=100)
    one, other = Reader(torch.zeros(1)), Reader(torch.ones(1))
    cache.get("disparity", "a", one)
    assert torch.equal(cache.get("depth", "a", other), torch.ones(1))


def test_nothing_is_kept_on_the_cpu():
    cache, reader = DeviceCache(CPU), Reader(torch.zeros(1))
    for _ in range(2):
        cache.get("photo", "a", reader)
    assert reader.calls == 2


def test_training_reads_kept_photos_no_more(wall_scene: Scene, monkeypatch: pytest.MonkeyPatch):
    views = wall_scene.train_views
    feed = PhotoFeed(views, ViewSampler(len(views), torch.Generator().manual_seed(0)), Team(), CPU)
    expected = {view.name: view.load(CPU)[0] for view in views}
    feed._kept = DeviceCache(CPU, capacity=10**9)
    for view in views:
        feed.photo(view)

    def fails(*_: object) -> Tensor:
        raise UserError("gone")

    monkeypatch.setattr(type(views[0]), "read_photo", fails)
    for _ in views:
        view = feed.next_view()
        photo, keep = feed.photo(view)
        assert torch.equal(photo, expected[view.name])
        assert keep is None
