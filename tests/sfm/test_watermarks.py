from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from wildgs.progress import silent
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.matching import extract, match_pairs, verified_pairs
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.watermarks import LEAST_CAPTION, find_caption
from wildgs.sfm.workplace import Workplace

SIZES = ((400, 300), (400, 340))


def texture(noise: np.random.Generator, height: int, width: int) -> np.ndarray:
    cells = noise.integers(0, 255, (-(-height // 8), -(-width // 8)))
    return np.kron(cells, np.ones((8, 8)))[:height, :width].astype(np.uint8)


def test_photos_of_different_heights_do_not_match_by_the_banner_at_their_bottom(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    banner, common = texture(noise, 40, 400), texture(noise, 160, 240)
    photos = [texture(noise, height, width) for width, height in SIZES]
    seen = [texture(noise, height, width) for width, height in SIZES]
    for photo in (*photos, *seen):
        photo[-40:] = banner
    seen[0][20:180, 20:260] = common
    seen[1][90:250, 140:380] = common
    everything = [*photos, *seen]
    work = Workplace(tmp_path)
    work.images.mkdir()
    copies = [WorkingCopy(str(i), f"{i}.png", f"{i}.png", False) for i in range(4)]
    for copy, photo in zip(copies, everything, strict=True):
        Image.fromarray(photo).save(work.images / copy.work_name)
    extract(work, copies, SfmConfig(), silent)
    match_pairs(work, copies, {(0, 1), (2, 3)}, SfmConfig(), lambda done, total: None)
    with closing(pycolmap.Database.open(work.database)) as database:
        found = verified_pairs(database, copies)
        geometry = database.read_two_view_geometry(3, 4)
        heights = database.read_keypoints(3)[geometry.inlier_matches[:, 0], 1]
    assert (0, 1) not in found
    assert found[2, 3] > 20, "what both show is matched in spite of the banner"
    assert (heights < 200).mean() > 0.9, "few of the banner, whose edge reaches out of the margin"


def points(count: int, size: tuple[int, int], noise: np.random.Generator) -> np.ndarray:
    return noise.uniform((0, 0.9 * size[1]), size, (count, 2))


def test_captions_are_found_from_any_corner_and_with_the_width() -> None:
    noise = np.random.default_rng(1)
    first = points(20, SIZES[0], noise)
    lower = first + (0, SIZES[1][1] - SIZES[0][1])
    assert find_caption(first, lower, *SIZES).all()
    assert find_caption(first, 2 * first, SIZES[0], (800, 600)).all()
    right = first + (100, 0)
    assert find_caption(first, right, SIZES[0], (500, 300)).all(), "from the lower right corner"


def test_few_matches_or_matches_of_the_scene_are_no_caption() -> None:
    noise = np.random.default_rng(2)
    few = points(LEAST_CAPTION - 1, SIZES[0], noise)
    assert not find_caption(few, few, SIZES[0], SIZES[0]).any()
    middle = noise.uniform((0, 60), (400, 240), (50, 2))
    assert not find_caption(middle, middle, SIZES[0], SIZES[0]).any(), "the same view again"
    moved = points(50, SIZES[0], noise)
    assert not find_caption(moved, moved + (9, 0), SIZES[0], SIZES[0]).any()
    nothing = np.zeros((0, 2))
    assert find_caption(nothing, nothing, *SIZES).shape == (0,)
