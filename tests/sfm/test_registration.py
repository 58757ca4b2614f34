from pathlib import Path

import numpy as np
import pycolmap
import pytest

from tests.sfm.conftest import LOST
from wildgs.progress import silent
from wildgs.sfm import registration as registration_module
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.incremental import LEAST_GROUP
from wildgs.sfm.lookalikes import LEAST_MATCHES
from wildgs.sfm.mapping import find_registered, map_photos, missing_from
from wildgs.sfm.matching import describe_photos
from wildgs.sfm.pairs import Pair
from wildgs.sfm.placement import NEIGHBOUR_POINTS, PassName, count_neighbours
from wildgs.sfm.registration import FEW_NEIGHBOURS, Registration, drop_unsure, names_of
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


def registration(work: Workplace, copies: list[WorkingCopy]) -> Registration:
    return Registration(work, copies, describe_photos(work, copies, 0), SfmConfig(), silent)


def synthesized(folder: Path) -> tuple[Workplace, pycolmap.Reconstruction]:
    """A workplace and the model of ten generated photos."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 10, 1
    work = Workplace(folder)
    with pycolmap.Database.open(work.database) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return work, model


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


def test_late_photos_without_a_neighbour_are_dropped(tmp_path: Path) -> None:
    work, model = synthesized(tmp_path)
    first, lonely, late = (model.image(i) for i in model.reg_image_ids()[:3])
    for image in (first, lonely):  # a few points are left, each seen by other photos
        rows = image.get_observation_point2D_idxs()
        for row in rows[NEIGHBOUR_POINTS - 1 :]:
            model.delete_observation(image.image_id, row)
        assert count_neighbours(model, image) == 0
    assert count_neighbours(model, late) > 0
    drop_unsure(model, work, {lonely.name: "third", late.name: "second"})
    registered = {model.image(i).name for i in model.reg_image_ids()}
    assert lonely.name not in registered
    assert {first.name, late.name} <= registered, "photos of the first pass are kept"


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("wrong", [True, False])
def test_photos_of_the_first_pass_are_dropped_if_nothing_supports_them(
    tmp_path: Path, alone: bool, wrong: bool
) -> None:
    """Their matches contradict them, and they share hardly any point; one of both is not enough."""
    work, model = synthesized(tmp_path)
    image = model.image(model.reg_image_ids()[0])
    if alone:
        for row in image.get_observation_point2D_idxs()[NEIGHBOUR_POINTS - 1 :]:
            model.delete_observation(image.image_id, row)
    if wrong:
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0.4, -0.3, 0.5]), [0.5, 0.2, 0.1])
        image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    drop_unsure(model, work, {})
    dropped = image.name not in {model.image(number).name for number in model.reg_image_ids()}
    assert dropped == (alone and wrong)


@pytest.mark.parametrize("photos", [FEW_NEIGHBOURS, FEW_NEIGHBOURS + 1])
@pytest.mark.parametrize("wrong", [True, False])
@pytest.mark.parametrize("passes", ["first", "second"])
def test_pairs_with_few_matches_count_against_photos_with_few_neighbours(
    tmp_path: Path, photos: int, wrong: bool, passes: PassName
) -> None:
    """A look-alike shares points with some photos, and no pair of it has many matches."""
    work, model = synthesized(tmp_path)
    for number in model.reg_image_ids()[photos:]:
        model.deregister_frame(model.image(number).frame_id)
    image = model.image(model.reg_image_ids()[0])
    assert count_neighbours(model, image) == photos - 1
    with pycolmap.Database.open(work.database) as database:
        for number in model.reg_image_ids()[1:]:
            geometry = database.read_two_view_geometry(image.image_id, number)
            geometry.inlier_matches = geometry.inlier_matches[: LEAST_MATCHES - 1]
            database.update_two_view_geometry(image.image_id, number, geometry)
    if wrong:
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0.4, -0.3, 0.5]), [0.5, 0.2, 0.1])
        image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    before = names_of(model)
    drop_unsure(model, work, {} if passes == "first" else {image.name: passes})
    few = photos - 1 < FEW_NEIGHBOURS
    assert before - names_of(model) == ({image.name} if wrong and few else set())


def test_three_photos_are_left_of_a_model_that_its_matches_contradict(tmp_path: Path) -> None:
    work, model = synthesized(tmp_path)
    for number in model.reg_image_ids()[FEW_NEIGHBOURS:]:
        model.deregister_frame(model.image(number).frame_id)
    rng = np.random.default_rng(0)
    for number in model.reg_image_ids():
        image = model.image(number)
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(0.0, 0.5, 3)), rng.normal(0.0, 0.5, 3))
        image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    drop_unsure(model, work, {})
    assert model.num_reg_images() == LEAST_GROUP


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
