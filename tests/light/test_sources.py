"""Where light comes from: names, files, the mean; each finds what it says, and mistakes are said."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.light import photos
from wildgs.light import sources as module
from wildgs.light.look import NEUTRAL
from wildgs.light.photos import cover, encode_picture, encode_view
from wildgs.light.saved import save_look
from wildgs.light.sources import LightSources
from wildgs.sfm.localization import LocalizationError, LocalizedPhoto


@pytest.fixture
def sources(method, wall) -> LightSources:
    return LightSources(method, lambda: wall)


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    file = tmp_path / "painting.png"
    pixels = np.random.default_rng(0).integers(0, 255, (40, 70, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(file)
    return file


@pytest.fixture
def unknown_place(monkeypatch) -> None:
    """Nothing can be localised."""

    def fail(file, *_):
        raise LocalizationError(f"{file}: could not be localised (3 inliers of 9 matches)")

    monkeypatch.setattr(module, "load_feature_index", lambda *_: None)
    monkeypatch.setattr(module, "localize", fail)


def global_of(look) -> torch.Tensor:
    return look.embeddings.global_embedding


def test_a_photo_by_name_with_or_without_ending(sources, method, wall) -> None:
    expected = encode_view(method, wall.views[7]).global_embedding
    assert torch.equal(global_of(sources.find("7.jpg")), expected)
    assert torch.equal(global_of(sources.find("7")), expected)


def test_a_look_is_kept(sources, monkeypatch) -> None:
    first = sources.find("0.jpg")
    monkeypatch.setattr(photos, "encode_view", lambda *_: pytest.fail("encoded again"))
    assert sources.find("0.jpg") is first


def test_looks_beyond_the_limit_are_let_go(sources, monkeypatch) -> None:
    monkeypatch.setattr(module, "KEPT_LOOKS", 2)
    first = sources.find("0.jpg")
    for name in ("1.jpg", "2.jpg"):
        sources.find(name)
    assert sources.find("0.jpg") is not first


def test_neutral_is_the_mean_over_training_photos(sources, method, wall) -> None:
    told = []
    look = sources.find(NEUTRAL, progress=lambda *done: told.append(done))
    with torch.no_grad():
        all_of_them = [method.embed(encode_view(method, view)) for view in wall.train_views]
    mean = torch.stack([e.global_embedding for e in all_of_them]).mean(dim=0)
    torch.testing.assert_close(global_of(look), mean)
    mean = torch.stack([e.local_embeddings for e in all_of_them]).mean(dim=0)
    torch.testing.assert_close(look.embeddings.local_embeddings, mean)
    assert told[-1][1:] == (7, 7)


def test_any_picture_borrows_the_camera_it_is_told(sources, method, wall, picture) -> None:
    look = sources.find(picture, like="3.jpg")
    pixels = torch.from_numpy(np.array(Image.open(picture)))
    expected = method.embed(encode_picture(method, pixels, wall.views[3].camera))
    assert torch.equal(look.embeddings.local_embeddings, expected.local_embeddings)
    assert "3.jpg" in look.note


def test_auto_takes_the_training_photo_most_alike(sources, tmp_path, wall) -> None:
    file = tmp_path / "dark.png"
    Image.fromarray(wall.views[2].read_photo().numpy()).save(file)
    look = sources.find(file, like="auto")
    assert "2.jpg" in look.note


def test_a_picture_that_cannot_be_localised_says_so_and_is_used(sources, picture, unknown_place) -> None:
    with pytest.warns(WildGSWarning, match=r"3 inliers.*uses camera and depth of .*--like"):
        look = sources.find(picture)
    assert torch.isfinite(look.sh).all()


def test_with_like_nothing_is_localised(sources, picture, monkeypatch) -> None:
    monkeypatch.setattr(module, "load_feature_index", lambda *_: pytest.fail("localised"))
    assert "0.jpg" in sources.find(picture, like="0.jpg").note


def test_a_new_photo_of_the_place_is_encoded_from_its_camera(
    sources, method, wall, picture, monkeypatch
) -> None:
    view = wall.views[5]
    found = LocalizedPhoto(view.read_photo(), view.camera, 77, 99, 0.94, False)
    monkeypatch.setattr(module, "load_feature_index", lambda *_: None)
    monkeypatch.setattr(module, "localize", lambda *_: found)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        look = sources.find(picture)
    expected = method.embed(encode_view(method, view))
    assert torch.equal(look.embeddings.local_embeddings, expected.local_embeddings)
    assert "77 inliers of 99" in look.note


def test_a_saved_appearance_needs_no_scene(method, wall, sources, tmp_path) -> None:
    file = save_look(sources.find("0.jpg"), tmp_path / "a.safetensors")
    alone = LightSources(method, lambda: pytest.fail("the scene was read"))
    assert torch.equal(global_of(alone.find(file)), global_of(sources.find("0.jpg")))


@pytest.mark.parametrize(
    ("spec", "like", "words"),
    [
        ("nope.jpg", None, "neither a photo"),
        ("{picture}", "nope", "no photo 'nope'"),
        ("{text}", "0", "picture"),
    ],
)
def test_mistakes(sources, picture, tmp_path, spec, like, words) -> None:
    text = tmp_path / "notes.jpg"
    text.write_text("not a picture")
    with pytest.raises(UserError, match=words):
        sources.find(spec.format(picture=picture, text=text), like=like)


def test_plain_3dgs_gives_its_own_light_and_says_so(vanilla, wall) -> None:
    sources = LightSources(vanilla, lambda: wall)
    with pytest.warns(WildGSWarning, match="cannot be relit"):
        look = sources.find("0.jpg")
    assert look is sources.find(NEUTRAL)
    assert look.embeddings.global_embedding.numel() == 0


@pytest.mark.parametrize("size", [(10, 30), (30, 10), (12, 9)])
def test_cover_fills_the_frame_and_stretches_nothing(size) -> None:
    width, height = size
    y, x = np.mgrid[0:height, 0:width]
    ramp = np.stack([x * 8, y * 8, np.zeros_like(x)], axis=-1).astype(np.uint8)
    filled = cover(torch.from_numpy(ramp), 24, 16)
    assert filled.shape == (16, 24, 3)
    across = filled[8, 12:20, 0].float().diff().mean()
    down = filled[6:14, 12, 1].float().diff().mean()
    assert float(across) == pytest.approx(float(down), rel=0.25)


def test_a_picture_of_nothing_usual_is_still_lifted(method, wall, monkeypatch) -> None:
    """What the mask thinks of a painting plays no part."""
    monkeypatch.setattr(method, "mask_threshold", 2.0)  # a mask that hides everything
    camera = wall.views[0].camera
    pixels = torch.randint(0, 255, (32, 32, 3), dtype=torch.uint8)
    first = method.embed(encode_picture(method, pixels, camera)).local_embeddings
    second = method.embed(encode_picture(method, 255 - pixels, camera)).local_embeddings
    assert not torch.allclose(first, second)
