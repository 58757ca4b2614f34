"""Photos by name, with or without extension."""

from __future__ import annotations

import pytest
import torch

from tests.memory_views import make_view
from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.scene import match_view


def test_a_name_that_several_photos_have_is_refused() -> None:
    camera = Camera(torch.eye(4), torch.eye(3), 2, 2)
    photo = torch.zeros(2, 2, 3, dtype=torch.uint8)
    names = ["a", "b.jpg", "b.png", "c.jpg", "sub/b.jpg", *(f"d.{ending}" for ending in "wxyz")]
    views = [make_view(name, camera, "train", photo) for name in names]
    for name, found in {"a": "a", "b.png": "b.png", "c": "c.jpg", "sub/b": "sub/b.jpg"}.items():
        view = match_view(views, name)
        assert view is not None
        assert view.name == found
    assert match_view(views, "nobody") is None
    with pytest.raises(
        UserError, match=r"'b' may be any of b\.jpg, b\.png; give the name with its extension"
    ):
        match_view(views, "b")
    with pytest.raises(UserError, match=r"d\.w, d\.x, d\.y, …;"):
        match_view(views, "d")
