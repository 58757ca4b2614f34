import pycolmap

from tests.sfm.conftest import LOST
from wildgs.progress import silent
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.mapping import find_registered, map_photos, missing_from
from wildgs.sfm.matching import describe_photos
from wildgs.sfm.passes import place_with_plain_lens
from wildgs.sfm.placement import PassName
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


def test_a_photo_with_an_implausible_lens_is_placed_with_a_plain_one(
    matched: tuple[Workplace, list[WorkingCopy]],
) -> None:
    work, copies = matched
    name, config = copies[LOST].work_name, SfmConfig()
    rest = [copy.work_name for copy in copies[:LOST]]
    model = map_photos(work, len(copies), config, silent, only=rest)[0]
    vlads = describe_photos(work, copies, 0)
    passes: dict[str, PassName] = {}
    placed = place_with_plain_lens(work, copies, vlads, model, {name}, passes, config, silent)
    assert missing_from(placed, copies) == []
    assert passes == {name: "second"}
    lens = find_registered(placed, copies[LOST]).camera
    assert lens.params[3] == 0
    with pycolmap.Database.open(work.database) as database:
        stored = database.read_camera(lens.camera_id)
    assert list(lens.params) == list(stored.params), "bundle adjustment leaves it as it was estimated"


def test_other_photos_are_not_tried(matched: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = matched
    rest = [copy.work_name for copy in copies[:LOST]]
    model = map_photos(work, len(copies), SfmConfig(), silent, only=rest)[0]
    vlads = describe_photos(work, copies, 0)
    assert place_with_plain_lens(work, copies, vlads, model, {"no.jpg"}, {}, SfmConfig(), silent) is model
