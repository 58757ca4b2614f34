from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from wildgs.progress import silent
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.enlarged import enlarge_small
from wildgs.sfm.matching import extract, match_pairs, verified_pairs
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

SMALL, LARGE, MASKED = range(3)


@pytest.fixture
def extracted(tmp_path: Path) -> tuple[Workplace, list[WorkingCopy]]:
    """One picture three times: as a thumbnail, large, and as a thumbnail with a mask."""
    noise = np.random.default_rng(0)
    coarse = Image.fromarray(noise.integers(0, 255, (60, 80)).astype(np.uint8))
    picture = coarse.resize((800, 600), Image.Resampling.BICUBIC)
    work = Workplace(tmp_path)
    work.images.mkdir()
    work.masks.mkdir()
    copies = [WorkingCopy(f"{i}.png", f"{i}.png", f"{i}.jpg", i == MASKED) for i in range(3)]
    for copy, side in zip(copies, (200, 800, 200), strict=True):
        picture.resize((side, side * 3 // 4), Image.Resampling.LANCZOS).save(work.images / copy.work_name)
    Image.new("L", (200, 150), 255).save(work.masks / f"{copies[MASKED].work_name}.png")
    extract(work, copies, SfmConfig(), silent)
    return work, copies


def test_thumbnails_get_more_features_that_match(extracted: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = extracted
    match_pairs(work, copies, {(SMALL, LARGE)}, SfmConfig(), lambda done, total: None)
    with closing(pycolmap.Database.open(work.database)) as database:
        before = [database.num_keypoints_for_image(i + 1) for i in range(3)]
        matches = verified_pairs(database, copies)[SMALL, LARGE]
    assert enlarge_small(work, copies, [SMALL, LARGE, MASKED], 8192) == [SMALL]
    with closing(pycolmap.Database.open(work.database)) as database:
        after = [database.num_keypoints_for_image(i + 1) for i in range(3)]
        keypoints = database.read_keypoints(SMALL + 1)
        assert len(database.read_descriptors(SMALL + 1).data) == len(keypoints)
        assert verified_pairs(database, copies) == {}, "matches of the old features are deleted"
    assert after[SMALL] > 1.2 * before[SMALL]
    assert after[LARGE:] == before[LARGE:]
    assert keypoints.shape[1] == 6
    assert (keypoints[:, :2] > 0).all()
    assert (keypoints[:, :2] < [200, 150]).all()
    match_pairs(work, copies, {(SMALL, LARGE)}, SfmConfig(), lambda done, total: None)
    with closing(pycolmap.Database.open(work.database)) as database:
        assert verified_pairs(database, copies)[SMALL, LARGE] > matches


def test_only_the_photos_asked_for_are_enlarged(extracted: tuple[Workplace, list[WorkingCopy]]) -> None:
    work, copies = extracted
    assert enlarge_small(work, copies, [LARGE], 8192) == []
