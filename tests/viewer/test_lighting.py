"""Two lights and a slider; pictures that browsers send."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.errors import UserError
from wildgs.viewer.lighting import SIDES, Light, LightDesk, most_different, store_upload
from wildgs.viewer.subject import Subject

DARK, BRIGHT = Light("0 dark.jpg", "0 dark.jpg"), Light("1 bright.jpg", "1 bright.jpg")


def brightness(subject: Subject, desk: LightDesk) -> float:
    picture, _ = subject.render(subject.views[0].camera, desk.look(subject))
    return float(picture.float().mean())


def test_slider_goes_from_one_light_to_the_other(subject: Subject) -> None:
    seen = [brightness(subject, LightDesk(DARK, BRIGHT, amount)) for amount in (0.0, 0.3, 0.7, 1.0)]
    assert seen == sorted(seen)
    assert seen[-1] > 1.5 * seen[0]


def test_ends_of_the_slider_are_the_lights_themselves(subject: Subject) -> None:
    assert LightDesk(DARK, BRIGHT, 0.0).look(subject) is subject.look(DARK.spec)
    assert LightDesk(DARK, BRIGHT, 1.0).look(subject) is subject.look(BRIGHT.spec)


def test_a_light_that_is_not_needed_is_not_looked_for(subject: Subject) -> None:
    missing = Light("nowhere.jpg", "nowhere.jpg")
    LightDesk(DARK, missing, 0.0).look(subject)
    with pytest.raises(UserError, match=r"nowhere\.jpg"):
        LightDesk(DARK, missing, 0.5).look(subject)


def test_a_day_goes_from_photo_to_photo() -> None:
    day = ("dawn.jpg", "noon.jpg", "dusk.jpg")
    desks = {share: LightDesk.at_hour(day, share) for share in (-1.0, 0.0, 0.25, 0.5, 1.0, 7.0)}
    assert [desks[share].first.spec for share in desks] == ["dawn.jpg"] * 3 + ["noon.jpg"] * 3
    assert [desks[share].amount for share in desks] == [0.0, 0.0, 0.5, 0.0, 1.0, 1.0]


def test_a_chosen_light_is_seen_at_once() -> None:
    desk = LightDesk(DARK, DARK, 0.5)
    assert desk.with_light(BRIGHT, SIDES[0]) == LightDesk(BRIGHT, DARK, 0.0)
    assert desk.with_light(BRIGHT, SIDES[1]) == LightDesk(DARK, BRIGHT, 1.0)


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "C:\\temp\\a.png", "/x", "a\x00b.png", "é" * 300, "", ".."]
)
def test_uploads_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    file = store_upload(tmp_path, 3, name, png(Image.new("RGB", (8, 6), (1, 2, 3))))
    assert list(tmp_path.iterdir()) == [file]
    with Image.open(file) as stored:
        assert (stored.size, stored.getpixel((0, 0))) == ((8, 6), (1, 2, 3))
    assert len(file.name) < 60
    assert file.name.isascii()


def png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return buffer.getvalue()


@pytest.mark.parametrize("content", [b"", b"no picture"])
def test_what_is_no_picture_is_one_line_and_leaves_nothing(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(UserError, match="not a readable image"):
        store_upload(tmp_path, 1, "a.jpg", content)
    assert list(tmp_path.iterdir()) == []


def test_any_picture_can_lend_its_light(subject: Subject, tmp_path: Path) -> None:
    lit = []
    for number, value in enumerate((20, 200)):
        picture = Image.fromarray(np.full((40, 60, 3), value, dtype=np.uint8))
        file = store_upload(tmp_path, number, "mine.png", png(picture))
        light = Light(str(file), "mine.png", subject.views[0].name)
        lit.append(LightDesk(light, DARK).look(subject).sh)
    assert not torch.allclose(lit[0], lit[1])


def test_most_different_photo() -> None:
    colors = {"a": np.array([0.0, 0, 0]), "b": np.array([9.0, 0, 0]), "c": np.array([0, 0, 200.0])}
    assert most_different(colors, "a") == "c"
