"""Matches to points, on the photos of a corner: a photo whose matches to photos were lost gets its pose back."""

import numpy as np
import pycolmap
from PIL import Image

from tests.sfm.conftest import LOST
from wildgs.progress import silent
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.mapping import continue_mapping, map_photos, missing_from
from wildgs.sfm.match_pictures import SIDE, draw_matches, write_match_pictures
from wildgs.sfm.matching import describe_photos, image_ids, verified_pairs
from wildgs.sfm.placement import Findings, failures, other_places
from wildgs.sfm.point_matching import match_to_points
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


def test_photos_are_numbered_in_order_by_any_number_of_threads(
    matched: tuple[Workplace, list[WorkingCopy]],
) -> None:
    work, copies = matched
    with pycolmap.Database.open(work.database) as database:
        assert image_ids(database, copies) == [1, 2, 3, 4, 5, 6]


def test_a_photo_finds_its_pose_by_points(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    config = SfmConfig()
    model = map_photos(work, len(copies), config, silent, only=[copy.work_name for copy in copies[:LOST]])[0]
    assert missing_from(model, copies) == [LOST]
    with pycolmap.Database.open(work.database) as database:
        before = verified_pairs(database, copies)
    assert (0, LOST) not in before
    vlads = describe_photos(work, copies, 0)
    assert match_to_points(work, copies, vlads, model, 0, lambda done, total: None) == [
        copies[LOST].work_name
    ]
    with pycolmap.Database.open(work.database) as database:
        after = verified_pairs(database, copies)
    assert after[0, LOST] >= 15
    assert after[2, LOST] >= before[2, LOST]  # what pairs of photos found stays
    assert missing_from(continue_mapping(work, model, len(copies), config, silent), copies) == []


def test_a_model_without_points_places_no_photo(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    names = [copy.work_name for copy in copies[:LOST]]
    model = map_photos(work, len(copies), SfmConfig(), silent, only=names)[0]
    for point in list(model.point3D_ids()):
        model.delete_point3D(point)
    vlads = describe_photos(work, copies, 0)
    assert match_to_points(work, copies, vlads, model, 0, lambda done, total: None) == []


def test_photos_left_out_are_drawn_beside_their_partner(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    model = map_photos(
        work, len(copies), SfmConfig(), silent, only=[copy.work_name for copy in copies[:LOST]]
    )[0]
    without = failures(work, copies, [model], Findings())
    assert list(without) == [f"{LOST}.jpg"]
    assert without[f"{LOST}.jpg"].partner in {copy.name for copy in copies[:LOST]}
    work.fresh("scene")
    pictures = write_match_pictures(work, copies, without)
    with Image.open(work.scene / pictures[f"{LOST}.jpg"]) as picture:
        assert picture.width == 2 * SIDE


def test_photos_that_only_match_each_other_are_named_as_a_group(
    matched: tuple[Workplace, list[WorkingCopy]],
) -> None:
    work, copies = matched
    reasons = failures(work, copies, [pycolmap.Reconstruction()], Findings())
    assert "separate group of 6 photos (with 1.jpg, 2.jpg, 3.jpg)" in reasons["0.jpg"].reason
    assert other_places(reasons.values()) == (tuple(f"{number}.jpg" for number in range(6)),)


def test_photos_that_their_matches_contradict_are_told_from_those_without_matches(
    matched: tuple[Workplace, list[WorkingCopy]],
) -> None:
    work, copies = matched
    model = map_photos(
        work, len(copies), SfmConfig(), silent, only=[copy.work_name for copy in copies[:LOST]]
    )[0]
    lost = Findings(contradicted={copies[LOST].work_name: "9 of its 10 matches", copies[0].work_name: "some"})
    without = failures(work, copies, [model], lost)
    assert list(without) == [f"{LOST}.jpg"], "a photo that has another pose is not left out"
    assert without[f"{LOST}.jpg"].reason.startswith("lost its pose: 9 of its 10 matches; places or sides")


def test_lines_end_where_the_matches_are() -> None:
    photos = [Image.new("RGB", (640, 320)), Image.new("RGB", (160, 320))]
    picture = np.asarray(draw_matches(photos, [np.array([[100.0, 200.0]]), np.array([[80.0, 40.0]])]))
    assert picture.shape == (320, 320 + 160, 3)
    ys, xs = np.nonzero(picture[:160].sum(axis=2))
    drawn = np.flatnonzero(xs < 480)
    assert (xs[drawn].min(), ys[drawn].max()) == (50, 100)
    assert (xs[drawn].max(), ys[drawn].min()) == (400, 40)
