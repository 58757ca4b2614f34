"""Appearance files: what goes in comes out, for the same checkpoint only, and nothing else is read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from wildgs.errors import UserError
from wildgs.light.look import look_of, mix, own_look
from wildgs.light.photos import encode_picture, encode_view
from wildgs.light.saved import load_look, save_look
from wildgs.model.config import CameraResponseConfig


@pytest.fixture
def look(method, wall):
    parts = [look_of(method, encode_view(method, view), view.name) for view in wall.views[:2]]
    return mix(parts, [0.25, 0.75])


def test_round_trip(method, look, tmp_path: Path) -> None:
    file = save_look(look, tmp_path / "sub" / "evening.safetensors")
    back = load_look(method, file)
    assert back.name == look.name
    assert torch.equal(back.embeddings.global_embedding, look.embeddings.global_embedding)
    torch.testing.assert_close(
        back.embeddings.local_embeddings, look.embeddings.local_embeddings, atol=2e-3, rtol=2e-3
    )
    assert look.embeddings.color_map.any()
    assert torch.equal(back.embeddings.color_map, look.embeddings.color_map)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_cameras_response_is_mixed_and_saved_and_neutral_has_none(
    method, wall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted = CameraResponseConfig(vignetting=True, curve=True)
    monkeypatch.setattr(method, "config", replace(method.config, camera_response=fitted))
    monkeypatch.setattr(method.photo_match, "config", method.config)
    looks = [look_of(method, encode_view(method, view), view.name) for view in wall.views[:2]]
    responses = [look.embeddings.response for look in looks]
    mixed = mix(looks, [0.25, 0.75])
    torch.testing.assert_close(mixed.embeddings.response, 0.25 * responses[0] + 0.75 * responses[1])
    assert mixed.embeddings.response.any()
    back = load_look(method, save_look(mixed, tmp_path / "a.safetensors"))
    assert torch.equal(back.embeddings.response, mixed.embeddings.response)
    assert method.mean([look.embeddings for look in looks], 2).response is None
    monkeypatch.setattr(method, "config", replace(method.config, camera_response=CameraResponseConfig()))
    with pytest.raises(UserError):
        load_look(method, tmp_path / "a.safetensors")


def test_only_gaussians_inside_the_box_are_stored(method, look, tmp_path: Path) -> None:
    stored = load_file(save_look(look, tmp_path / "a.safetensors"))
    inside = int(method.wrapping.box.contains(method.gaussians.means).sum())
    assert 0 < inside < method.num_gaussians
    assert len(stored["rows"]) == inside
    assert stored["local_embeddings"].dtype == torch.float16


def test_another_run_is_refused(other_method, look, tmp_path: Path) -> None:
    file = save_look(look, tmp_path / "a.safetensors")
    with pytest.raises(UserError, match="another run"):
        load_look(other_method, file)


def test_plain_3dgs_has_nothing_to_save(vanilla, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be relit"):
        save_look(own_look(vanilla), tmp_path / "a.safetensors")


def _strange_tensors(file: Path, look) -> None:
    save_file({"x": torch.zeros(2)}, file, metadata={"wildgs": '{"format": "wildgs-appearance-2"}'})


def _rewrite(file: Path, look, change) -> None:
    """An appearance file of `look`, after `change` has had its tensors."""
    tensors = load_file(save_look(look, file))
    with safe_open(file, framework="pt") as opened:
        metadata = opened.metadata()
    change(tensors)
    save_file(tensors, file, metadata=metadata)


def _rows_out_of_range(file: Path, look) -> None:
    def change(tensors) -> None:
        tensors["rows"][-1] = 10**6

    _rewrite(file, look, change)


def _long_color_map(file: Path, look) -> None:
    _rewrite(file, look, lambda tensors: tensors.update(color_map=torch.zeros(4, 4)))


def _color_map_of_no_numbers(file: Path, look) -> None:
    _rewrite(file, look, lambda tensors: tensors.update(color_map=torch.full((3, 4), torch.nan)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda file, look: None, "no such file"),
        (lambda file, look: file.write_bytes(b"PK no"), "not an appearance file"),
        (lambda file, look: save_file({"x": torch.zeros(2)}, file), "not an appearance file"),
        (_strange_tensors, "not an appearance file"),
        (_rows_out_of_range, "not an appearance file"),
        (_long_color_map, "not an appearance file"),
        (_color_map_of_no_numbers, "not an appearance file"),
    ],
)
def test_other_files_are_refused(method, look, tmp_path: Path, spoil, words) -> None:
    file = tmp_path / "a.safetensors"
    spoil(file, look)
    with pytest.raises(UserError, match=words):
        load_look(method, file)


def test_the_name_must_end_as_it_is_found_again(look, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"end in \.safetensors"):
        save_look(look, tmp_path / "evening.pt")


def test_a_saved_picture_without_a_colour_map_mixes_with_a_photo(method, look, wall, tmp_path: Path) -> None:
    """Pictures of other places are not matched; files of earlier versions say so by a map of zeros."""
    photo = wall.views[0]
    unmatched = look_of(method, encode_picture(method, photo.read_photo(), photo.camera), "picture")
    assert unmatched.embeddings.color_map is None
    file = tmp_path / "picture.safetensors"
    save_look(unmatched, file)
    for change in (lambda tensors: None, lambda tensors: tensors.update(color_map=torch.zeros(3, 4))):
        _rewrite(file, unmatched, change)
        back = load_look(method, file)
        assert back.embeddings.color_map is None
        mixed = mix([back, look], [0.5, 0.5])
        torch.testing.assert_close(mixed.embeddings.color_map, 0.5 * look.embeddings.color_map)
        assert mixed.sh.isfinite().all()


def test_only_an_appearance_is_replaced(method, look, tmp_path: Path) -> None:
    file = save_look(look, tmp_path / "a.safetensors")
    save_look(look, file)
    for name, content in (("other", None), ("text", b"no tensors")):
        other = tmp_path / f"{name}.safetensors"
        if content is None:
            save_file({"values": torch.zeros(3)}, other)
        else:
            other.write_bytes(content)
        before = other.read_bytes()
        with pytest.raises(UserError, match="not an appearance file"):
            save_look(look, other)
        assert other.read_bytes() == before


def test_a_sky_profile_is_saved(method, look, tmp_path: Path) -> None:
    """A file without one, of an earlier version, has none."""
    plain = replace(look.embeddings, sky_profile=None)
    with_sky = replace(plain, sky_profile=torch.rand(3, 9))
    for number, embeddings in enumerate((plain, with_sky)):
        file = save_look(replace(look, embeddings=embeddings), tmp_path / f"{number}.safetensors")
        found = load_look(method, file).embeddings.sky_profile
        expected = embeddings.sky_profile
        assert found is None if expected is None else torch.equal(found, expected)
    tensors, metadata = load_file(file), safe_open(file, "pt").metadata()
    earlier = torch.rand(3, 5)
    save_file(tensors | {"sky_profile": earlier}, file, metadata)
    found = load_look(method, file).embeddings.sky_profile
    assert found is not None
    assert torch.equal(found[:, :5], earlier)
    assert not found[:, 5:].any(), "a palette of one colour"
    save_file(tensors | {"sky_profile": torch.rand(3, 6)}, file, metadata)
    with pytest.raises(UserError, match="not an appearance file"):
        load_look(method, file)
