"""Looks: shaded once, mixed by weights that add up to one, globally and locally apart."""

from __future__ import annotations

import pytest
import torch

from wildgs.errors import UserError
from wildgs.light.look import Look, look_of, mix, own_look, with_sky
from wildgs.light.photos import encode_view
from wildgs.light.saved import load_look, save_look


@pytest.fixture
def looks(method, wall) -> list[Look]:
    return [look_of(method, encode_view(method, view), view.name) for view in wall.views[:3]]


def test_harmonics_are_shaded_once(method, looks, monkeypatch) -> None:
    look = looks[0]
    first = look.sh
    monkeypatch.setattr(type(method), "fuse", lambda *_: pytest.fail("shaded again"))
    assert look.sh is first
    assert not first.requires_grad


def test_a_photo_shaded_through_a_look_is_the_photo_shaded(method, looks, wall) -> None:
    with torch.no_grad():
        expected = method.shade(encode_view(method, wall.views[0]))
    torch.testing.assert_close(looks[0].sh, expected)


def test_mix_weighs_embeddings(looks) -> None:
    a, b, c = (look.embeddings for look in looks)
    mixed = mix(looks, [0.2, 0.3, 0.5]).embeddings
    expected = 0.2 * a.global_embedding + 0.3 * b.global_embedding + 0.5 * c.global_embedding
    torch.testing.assert_close(mixed.global_embedding, expected)
    expected = 0.2 * a.local_embeddings + 0.3 * b.local_embeddings + 0.5 * c.local_embeddings
    torch.testing.assert_close(mixed.local_embeddings, expected)


def test_global_and_local_mix_apart(looks) -> None:
    a, b = looks[:2]
    mixed = mix([a, b], [1, 0], local_weights=[0, 1])
    assert torch.equal(mixed.embeddings.global_embedding, a.embeddings.global_embedding)
    assert torch.equal(mixed.embeddings.local_embeddings, b.embeddings.local_embeddings)
    assert mixed.name == "global 0.jpg, local 1.jpg"


def test_a_mix_with_all_weight_on_one_is_that_one(looks) -> None:
    assert torch.equal(mix(looks[:2], [0, 1]).sh, looks[1].sh)


def test_rounded_weights_are_no_mistake(looks) -> None:
    mixed = mix(looks, [0.333, 0.333, 0.333]).embeddings
    mean = torch.stack([look.embeddings.global_embedding for look in looks]).mean(dim=0)
    torch.testing.assert_close(mixed.global_embedding, mean)


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ([0.5], "2 appearances need 2 weights"),
        ([0.5, 0.6], "not to 1.1"),
        ([float("nan"), 1], "add up"),
    ],
)
def test_bad_weights_are_said(looks, weights, words) -> None:
    with pytest.raises(UserError, match=words):
        mix(looks[:2], weights)


def test_looks_of_different_scenes_do_not_mix(looks, other_method, wall) -> None:
    stranger = look_of(other_method, encode_view(other_method, wall.views[0]), "x")
    with pytest.raises(UserError, match="different scenes"):
        mix([looks[0], stranger], [0.5, 0.5])


def test_plain_3dgs_has_one_look(vanilla) -> None:
    look = own_look(vanilla)
    assert look.sh.shape == (vanilla.num_gaussians, 16, 3)
    assert mix([look, look], [0.5, 0.5]) is look


def test_the_sky_of_another_look(method, looks, tmp_path) -> None:
    own, other = looks[:2]
    which = method.sky()
    assert 0 < int(which.sum()) < len(which)
    swapped = with_sky(own, other)
    assert torch.equal(swapped.sh[which], other.sh[which])
    assert torch.equal(swapped.sh[~which], own.sh[~which])
    assert swapped.name == "0.jpg under the sky of 1.jpg"
    back = load_look(method, save_look(swapped, tmp_path / "swapped.safetensors"))
    torch.testing.assert_close(back.sh, swapped.sh, atol=0.01, rtol=0.01)
    assert torch.equal(mix([swapped, own], [0, 1]).sh, own.sh)
    assert torch.equal(mix([swapped, own], [1, 0]).sh, swapped.sh)
    assert torch.equal(with_sky(other, swapped).sh, other.sh), "the sky that is shown, not the scene below it"


def test_no_sky_to_swap_is_one_line(vanilla) -> None:
    look = own_look(vanilla)
    with pytest.raises(UserError, match="not separate the sky"):
        with_sky(look, look)
