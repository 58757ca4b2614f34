"""`wildgs.light.photos.KeptAppearances`: each photo is encoded once, within a limit."""

from __future__ import annotations

import pytest
import torch

from wildgs.light import photos
from wildgs.light.photos import KeptAppearances, encode_view
from wildgs.model.wildgs import WildGS
from wildgs.scene import Scene


def test_a_photo_is_encoded_once(wall: Scene, method: WildGS, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, expected = KeptAppearances(), encode_view(method, wall.views[3])
    first = kept.of(method, wall.views[3])
    assert first.global_embedding is not None
    assert expected.global_embedding is not None
    assert torch.equal(first.global_embedding, expected.global_embedding)
    monkeypatch.setattr(photos, "encode_view", lambda *_: pytest.fail("encoded again"))
    assert kept.of(method, wall.views[3]) is first


def test_what_does_not_fit_is_encoded_again(wall: Scene, method: WildGS) -> None:
    room = KeptAppearances()
    room.of(method, wall.views[0])
    kept = KeptAppearances(limit=room.num_bytes)
    first = kept.of(method, wall.views[0])
    second = kept.of(method, wall.views[1])
    assert kept.num_bytes == room.num_bytes > 0
    assert kept.of(method, wall.views[0]) is first
    assert kept.of(method, wall.views[1]) is not second
