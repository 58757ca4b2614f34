"""Photos of a corner with features and matches."""

import pytest
from PIL import Image

from wildgs.progress import silent
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.matching import describe_photos, extract, forget_pairs, match
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

LOST = 5
"""The photo that matches no photo but one."""


@pytest.fixture(scope="module")
def matched(corner, tmp_path_factory: pytest.TempPathFactory) -> tuple[Workplace, list[WorkingCopy]]:
    work = Workplace(tmp_path_factory.mktemp("work"))
    work.images.mkdir()
    copies = []
    for number, pixels in enumerate(corner[0]):
        copies.append(WorkingCopy(f"{number}.jpg", f"{number:06d}.jpg", f"{number}.jpg", False))
        Image.fromarray(pixels).save(work.images / copies[-1].work_name, quality=95)
    extract(work, copies, SfmConfig(), silent)
    match(work, copies, describe_photos(work, copies, 0), SfmConfig(), silent)
    forget_pairs(work, copies, [(other, LOST) for other in range(LOST) if other != 2])
    return work, copies
