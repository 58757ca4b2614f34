from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from wildgs.progress import silent
from wildgs.sfm import matching
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.matching import chunks_of_pairs, extract, match_pairs, verified_pairs
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


def test_watermarks_are_no_matches_but_copies_are(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)

    def texture(rows: int, columns: int) -> np.ndarray:
        return np.kron(noise.integers(0, 255, (rows, columns)), np.ones((8, 8))).astype(np.uint8)

    photos = [texture(30, 40) for _ in range(3)]
    mark = texture(12, 20)
    for photo in photos:  # an agency's, at the same pixels of all photos
        photo[72:168, 80:240] = mark
    photos[2] = photos[1]
    work = Workplace(tmp_path)
    work.images.mkdir()
    copies = [WorkingCopy(str(i), f"{i}.png", f"{i}.png", False) for i in range(3)]
    for copy, photo in zip(copies, photos, strict=True):
        Image.fromarray(photo).save(work.images / copy.work_name)
    extract(work, copies, SfmConfig(), silent)
    match_pairs(work, copies, {(0, 1)}, SfmConfig(), lambda done, total: None)
    match_pairs(work, copies, {(0, 2), (1, 2)}, SfmConfig(), lambda done, total: None, keep_stationary=True)
    with closing(pycolmap.Database.open(work.database)) as database:
        found = verified_pairs(database, copies)
    assert (0, 1) not in found
    assert found[0, 2] > 20
    assert found[1, 2] > 5 * found[0, 2], "a copy"


@given(
    st.lists(st.tuples(st.integers(0, 19), st.integers(0, 19)), max_size=60),
    st.lists(st.integers(0, 50), min_size=20, max_size=20),
    st.integers(1, 30),
)
def test_chunks_hold_few_features_and_every_pair_once(pairs, features, most) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "MATCHING_FEATURES", 90)
        chunks = list(chunks_of_pairs(pairs, features, most))
    assert [pair for chunk in chunks for pair in chunk] == pairs
    for chunk in chunks:
        assert 1 <= len(chunk) <= most
        photos = {photo for pair in chunk for photo in pair}
        assert len(chunk) == 1 or sum(features[photo] for photo in photos) <= 90
