import pycolmap
import pytest

from tests.sfm.conftest import LOST
from wildgs.progress import silent
from wildgs.sfm import registration as registration_module
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.mapping import find_registered, map_photos, missing_from
from wildgs.sfm.matching import describe_photos
from wildgs.sfm.pairs import Pair
from wildgs.sfm.registration import Registration
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


def registration(work: Workplace, copies: list[WorkingCopy]) -> Registration:
    return Registration(work, copies, describe_photos(work, copies, 0), SfmConfig(), silent)


def test_a_photo_with_an_implausible_lens_is_placed_with_a_plain_one(
    matched: tuple[Workplace, list[WorkingCopy]],
) -> None:
    work, copies = matched
    name, config = copies[LOST].work_name, SfmConfig()
    rest = [copy.work_name for copy in copies[:LOST]]
    model = map_photos(work, len(copies), config, silent, only=rest)[0]
    photos = registration(work, copies)
    placed = photos.place_with_plain_lens(model, {name})
    assert missing_from(placed, copies) == []
    assert photos.passes == {name: "second"}
    lens = find_registered(placed, copies[LOST]).camera
    assert lens.params[3] == 0
    with pycolmap.Database.open(work.database) as database:
        stored = database.read_camera(lens.camera_id)
    assert list(lens.params) == list(stored.params), "bundle adjustment leaves it as it was estimated"


def test_other_photos_are_not_tried(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    rest = [copy.work_name for copy in copies[:LOST]]
    model = map_photos(work, len(copies), SfmConfig(), silent, only=rest)[0]
    assert registration(work, copies).place_with_plain_lens(model, {"no.jpg"}) is model


def test_a_larger_group_left_out_gets_all_passes(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    main = map_photos(work, len(copies), SfmConfig(), silent)[0]
    kept = {copies[0].work_name, copies[1].work_name}
    for image_id in list(main.reg_image_ids()):
        if main.image(image_id).name not in kept:
            main.deregister_frame(main.image(image_id).frame_id)
    assert main.num_reg_images() == 2
    photos = registration(work, copies)
    models = photos.map_rest(main)
    assert models[0].num_reg_images() > main.num_reg_images()
    assert {2, 3, 4}.isdisjoint(missing_from(models[0], copies))
    joined = {name for name in kept if models[0].find_image_with_name(name) is not None}
    assert joined <= set(photos.passes), "in this model, they were registered by a later pass"


def test_fewer_than_three_photos_are_no_model(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    rest = [copy.work_name for copy in copies[:LOST]]
    main = map_photos(work, len(copies), SfmConfig(), silent, only=rest)[0]
    assert registration(work, copies).map_rest(main) == []


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("better", [True, False])
def test_few_photos_are_matched_and_mapped_again(
    matched: tuple[Workplace, list[WorkingCopy]], monkeypatch: pytest.MonkeyPatch, few: bool, better: bool
) -> None:
    """If some have no pose; the new model is kept if it has a higher score."""
    work, copies = matched
    names = [copy.work_name for copy in copies]
    larger = map_photos(work, len(copies), SfmConfig(), silent, only=names[:LOST])[0]
    smaller = map_photos(work, len(copies), SfmConfig(), silent, only=names[:3])[0]
    first, again = (smaller, larger) if better else (larger, smaller)
    pairs: set[Pair] = set()
    monkeypatch.setattr(registration_module, "AGAIN_LIMIT", len(copies) if few else len(copies) - 1)
    monkeypatch.setattr(registration_module, "ENOUGH_MATCHES", 10_000)
    monkeypatch.setattr(registration_module, "forget_pairs", lambda *_: None)
    monkeypatch.setattr(registration_module, "match_pairs", lambda *a, **_: pairs.update(a[2]))
    monkeypatch.setattr(registration_module, "match_to_points", lambda *_: [])
    monkeypatch.setattr(registration_module, "map_repeatedly", lambda *_: [again])
    monkeypatch.setattr(registration_module, "continue_mapping", lambda work, model, *_, **__: model)
    monkeypatch.setattr(Workplace, "is_done", lambda self, name: False)
    monkeypatch.setattr(Workplace, "set_done", lambda self, name: None)
    photos = registration(work, copies)
    photos.passes[names[0]] = "second"
    models, more = photos.try_again([first])
    assert models[0] is (again if few and better else first)
    assert (photos.passes == {}) == (few and better)
    assert more == pairs
    missing = set(missing_from(first, copies))
    assert few == any(missing.isdisjoint(pair) for pair in more), "photos with a pose are matched again, too"
    assert all(0 not in pair or missing.intersection(pair) for pair in more), (
        "its matches are those to points"
    )
