from pathlib import Path

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.incremental import LEAST_GROUP
from wildgs.sfm.lookalike_groups import LEAST_AGAINST
from wildgs.sfm.lookalikes import LEAST_MATCHES, VERIFIED
from wildgs.sfm.mapping import names_of
from wildgs.sfm.placement import NEIGHBOUR_POINTS, PassName, count_neighbours
from wildgs.sfm.unsure_poses import FEW_NEIGHBOURS, drop_unsure
from wildgs.sfm.workplace import Workplace


def synthesized(folder: Path) -> tuple[Workplace, pycolmap.Reconstruction]:
    """A workplace and the model of ten generated photos."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 10, 1
    work = Workplace(folder)
    with pycolmap.Database.open(work.database) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return work, model


def turn(image: pycolmap.Image) -> None:
    wrong = pycolmap.Rigid3d(pycolmap.Rotation3d([0.4, -0.3, 0.5]), [0.5, 0.2, 0.1])
    image.frame.set_cam_from_world(image.camera_id, wrong * image.cam_from_world())


def shorten(work: Workplace, pairs: list[tuple[int, int]], matches: int) -> None:
    """Leaves so many verified matches of some pairs."""
    with pycolmap.Database.open(work.database) as database:
        for pair in pairs:
            geometry = database.read_two_view_geometry(*pair)
            geometry.inlier_matches = geometry.inlier_matches[:matches]
            database.update_two_view_geometry(*pair, geometry)


def drop(
    model: pycolmap.Reconstruction, work: Workplace, passes: dict[str, PassName] | None = None
) -> dict[str, str]:
    return drop_unsure(model, work, passes or {}, {name: name.upper() for name in names_of(model)})


def test_late_photos_without_a_neighbour_are_dropped(tmp_path: Path) -> None:
    work, model = synthesized(tmp_path)
    first, lonely, late = (model.image(i) for i in model.reg_image_ids()[:3])
    for image in (first, lonely):  # a few points are left, each seen by other photos
        rows = image.get_observation_point2D_idxs()
        for row in rows[NEIGHBOUR_POINTS - 1 :]:
            model.delete_observation(image.image_id, row)
        assert count_neighbours(model, image) == 0
    assert count_neighbours(model, late) > 0
    assert drop(model, work, {lonely.name: "third", late.name: "second"}) == {}, "no match contradicts it"
    registered = {model.image(i).name for i in model.reg_image_ids()}
    assert lonely.name not in registered
    assert {first.name, late.name} <= registered, "photos of the first pass are kept"


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("wrong", [True, False])
def test_photos_of_the_first_pass_are_dropped_if_nothing_supports_them(
    tmp_path: Path, alone: bool, wrong: bool
) -> None:
    """Some matches contradict them, and they share hardly any point; one of both is not enough."""
    work, model = synthesized(tmp_path)
    image, *others = (model.image(number) for number in model.reg_image_ids())
    shorten(work, [(image.image_id, other.image_id) for other in others[:3]], LEAST_MATCHES)
    shorten(work, [(image.image_id, other.image_id) for other in others[3:]], 1)
    assert 3 * LEAST_MATCHES < LEAST_AGAINST, "not enough for the rule on groups"
    if alone:
        for row in image.get_observation_point2D_idxs()[NEIGHBOUR_POINTS - 1 :]:
            model.delete_observation(image.image_id, row)
    if wrong:
        turn(image)
    reasons = drop(model, work)
    assert (image.name not in names_of(model)) == (alone and wrong)
    assert set(reasons) == ({image.name} if alone and wrong else set())


def test_a_photo_that_nearly_all_matches_contradict_is_dropped(tmp_path: Path) -> None:
    """Even if it shares points with many photos."""
    work, model = synthesized(tmp_path)
    image, before = model.image(model.reg_image_ids()[4]), names_of(model)
    turn(image)
    assert count_neighbours(model, image) >= FEW_NEIGHBOURS
    reasons = drop(model, work)
    assert before - names_of(model) == set(reasons) == {image.name}
    assert "of its" in reasons[image.name]


@pytest.mark.parametrize("wrong", [True, False])
def test_a_group_that_a_look_alike_joined_is_dropped(tmp_path: Path, wrong: bool) -> None:
    """Three photos turned alike about the centre of the scene, one of which agrees with another photo."""
    work, model = synthesized(tmp_path)
    group, rest = model.reg_image_ids()[:3], model.reg_image_ids()[3:]
    shorten(work, [(a, b) for a in group for b in rest], LEAST_MATCHES)
    if wrong:
        about = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 1.0]), [0.0, 0.0, 0.0])
        for number in group:
            image = model.image(number)
            image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * about)
    before, names = names_of(model), {model.image(number).name for number in group}
    reasons = drop(model, work)
    assert before - names_of(model) == set(reasons) == (names if wrong else set())
    assert all("its group of 3 photos" in reason for reason in reasons.values())


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
    shorten(work, [(image.image_id, number) for number in model.reg_image_ids()[1:]], VERIFIED)
    assert FEW_NEIGHBOURS * VERIFIED < LEAST_AGAINST, "not enough for the rule on groups"
    if wrong:
        turn(image)
    before = names_of(model)
    drop(model, work, {} if passes == "first" else {image.name: passes})
    few = photos - 1 < FEW_NEIGHBOURS
    assert before - names_of(model) == ({image.name} if wrong and few else set())


def test_three_photos_are_left_of_a_model_that_its_matches_contradict(tmp_path: Path) -> None:
    work, model = synthesized(tmp_path)
    for number in model.reg_image_ids()[FEW_NEIGHBOURS:]:
        model.deregister_frame(model.image(number).frame_id)
    rng = np.random.default_rng(0)
    for number in model.reg_image_ids():
        image = model.image(number)
        wrong = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(0.0, 0.5, 3)), rng.normal(0.0, 0.5, 3))
        image.frame.set_cam_from_world(image.camera_id, wrong * image.cam_from_world())
    drop(model, work)
    assert model.num_reg_images() == LEAST_GROUP
