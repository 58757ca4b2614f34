"""Feature extraction, pair selection and matching with pycolmap."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float
from torch import Tensor

from wildgs.progress import Progress
from wildgs.scene.images import DECODING_PIXELS, open_image
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.crops import CANDIDATE_LIKENESS, find_crops
from wildgs.sfm.database import open_database
from wildgs.sfm.pairs import Pair, Pairing, alike_pairs, choose_pairs, vlad_descriptors
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.watermarks import remove_captions
from wildgs.sfm.workplace import Workplace

EXTRACTION_BATCH = 16
MATCHING_BLOCK = 50
"""Photos per block of pairs, in which pairs are sorted so that few photos' features are needed at a time."""
MATCHING_FEATURES = 1_500_000
"""Upper bound on the features of all photos in one call of COLMAP, which keeps them and their search structures in
memory: about 700 bytes per feature."""

TOLERANT_RATIO = 0.85
"""Lowe's ratio in later passes; 0.8 in the first."""
TOLERANT_INLIER_RATIO = 0.1
"""Smallest inlier ratio, which determines the number of RANSAC trials, in later passes; 0.25 in the first."""


def extract(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> None:
    """Extracts SIFT features from all copies, with a separate camera for each."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = config.max_image_size
    options.num_threads = config.threads
    options.sift.max_num_features = config.max_features
    options.sift.estimate_affine_shape = config.affine_features
    # Extraction numbers photos in the order in which threads finish, on which matching and mapping depend.
    names = [copy.work_name for copy in copies]
    pycolmap.Database.open(work.database).close()  # creates it
    pycolmap.import_images(work.database, work.images, pycolmap.CameraMode.PER_IMAGE, names)
    done = 0
    # Separate calls, because COLMAP skips photos without a mask if a folder of masks is given.
    for masked in (False, True):
        reader = pycolmap.ImageReaderOptions()
        if masked:
            reader.mask_path = work.masks
        names = [copy.work_name for copy in copies if copy.masked == masked]
        for batch in _batches(work, names):
            progress("extracting features", done, len(copies))
            pycolmap.extract_features(
                work.database,
                work.images,
                batch,
                pycolmap.CameraMode.PER_IMAGE,
                reader_options=reader,
                extraction_options=options,
            )
            done += len(batch)
    progress("extracting features", done, len(copies))


def _batches(work: Workplace, names: Sequence[str]) -> Iterator[list[str]]:
    """Batches of copies that COLMAP may decode at the same time, to limit memory."""
    batch: list[str] = []
    pixels = 0
    for name in names:
        with open_image(work.images / name, sys.maxsize) as image:
            own = image.width * image.height
        if batch and (len(batch) == EXTRACTION_BATCH or pixels + own > DECODING_PIXELS):
            yield batch
            batch, pixels = [], 0
        batch.append(name)
        pixels += own
    if batch:
        yield batch


def describe_photos(work: Workplace, copies: Sequence[WorkingCopy], seed: int) -> Float[Tensor, "N D"]:
    """A unit vector per photo for retrieval."""
    with open_database(work.database) as database:
        ids = image_ids(database, copies)

        def descriptors(photo: int) -> np.ndarray:
            image_id = ids[photo]
            if image_id is None or not database.exists_descriptors(image_id):
                return np.zeros((0, 128), dtype=np.uint8)
            return database.read_descriptors(image_id).data

        return vlad_descriptors(len(copies), descriptors, seed)


def match(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    config: SfmConfig,
    progress: Progress,
) -> tuple[Pairing, dict[int, int]]:
    """Selects pairs, matches their features and verifies the matches by epipolar geometry.

    The most similar photos are matched first, to find copies and crops, which are not matched with other photos.

    Returns:
        The matched pairs, and a mapping from copies and crops to the original photo.
    """
    progress("choosing pairs", 0, 0)
    likeness = vlads @ vlads.T
    nearest = alike_pairs(vlads, dict.fromkeys(range(len(copies)), 1))
    twins = {(a, b) for a, b in nearest if likeness[a, b] > CANDIDATE_LIKENESS}
    match_pairs(
        work,
        copies,
        twins,
        config,
        lambda done, total: progress("matching copies", done, total),
        keep_stationary=True,
    )
    crops = find_crops(work, copies, twins)
    others = {pair for pair in twins if len({crops.get(photo, photo) for photo in pair}) > 1}
    forget_pairs(work, copies, others)
    kept = [photo for photo in range(len(copies)) if photo not in crops]
    rows = {photo: row for row, photo in enumerate(kept)}
    positions = {
        rows[photo]: position
        for photo, copy in enumerate(copies)
        if photo in rows and (position := copy.position) is not None
    }
    chosen = choose_pairs(
        vlads[kept], positions, config.pairing, sum(_feature_counts(work, [copies[photo] for photo in kept]))
    )
    pairs = {(kept[a], kept[b]) for a, b in chosen.pairs}
    match_pairs(
        work,
        copies,
        (pairs - twins) | others,
        config,
        lambda done, total: progress("matching pairs", done, total),
    )
    return Pairing(chosen.name, tuple(sorted(pairs | twins))), crops


def _feature_counts(work: Workplace, copies: Sequence[WorkingCopy]) -> list[int]:
    """Number of features of each photo; 0 for photos that COLMAP could not read."""
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        return [0 if known is None else database.num_keypoints_for_image(known) for known in ids]


def match_pairs(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    pairs: Collection[Pair],
    config: SfmConfig,
    progress: Callable[[int, int], None],
    *,
    tolerant: bool = False,
    keep_stationary: bool = False,
) -> None:
    """Matches pairs and verifies the matches, except those already in the database.

    Matches at the same pixel of both photos are left out, and those at the same place of their margins
    (`wildgs.sfm.watermarks`), because they are watermarks and captions of agencies: photos of different views were
    registered at one place by them.

    Args:
        work: The workplace; its database contains the features, and the matches are written to it.
        copies: All photos.
        pairs: Pairs to match.
        config: Threads and seed.
        progress: Called with (pairs matched, total number of pairs).
        tolerant: Whether to use the thresholds of later passes.
        keep_stationary: Whether to keep matches at the same pixel of both photos, which copies consist of.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = config.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    verification.filter_stationary_matches = not keep_stationary
    if tolerant:
        options.sift.max_ratio = TOLERANT_RATIO
        verification.ransac.min_inlier_ratio = TOLERANT_INLIER_RATIO
    lists = work.root / "pairs.txt"
    # Sorted by blocks of photos, so that features are read once per block.
    ordered = sorted(pairs, key=lambda pair: (pair[0] // MATCHING_BLOCK, pair[1] // MATCHING_BLOCK, pair))
    step = max(50, min(MATCHING_BLOCK**2, len(ordered) // 20))
    done = 0
    for chunk in chunks_of_pairs(ordered, _feature_counts(work, copies), step):
        progress(done, len(ordered))
        done += len(chunk)
        lists.write_text("".join(f"{copies[a].work_name} {copies[b].work_name}\n" for a, b in chunk))
        pycolmap.match_image_pairs(
            work.database,
            matching_options=options,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(lists)),
            verification_options=verification,
        )
        if not keep_stationary:
            with open_database(work.database) as database:
                ids = image_ids(database, copies)
                known = [(ids[a], ids[b]) for a, b in chunk]
                remove_captions(database, [(a, b) for a, b in known if a and b], verification)
    if ordered:
        progress(len(ordered), len(ordered))


def chunks_of_pairs(pairs: Sequence[Pair], features: Sequence[int], most: int) -> Iterator[list[Pair]]:
    """Cuts pairs into chunks whose photos together have at most `MATCHING_FEATURES` features; a pair is not cut.

    Args:
        pairs: Pairs in the order in which they are matched.
        features: Number of features of each photo.
        most: Upper bound on the pairs of a chunk.
    """
    chunk: list[Pair] = []
    photos: set[int] = set()
    held = 0
    for pair in pairs:
        added = sum(features[photo] for photo in set(pair) - photos)
        if chunk and (len(chunk) == most or held + added > MATCHING_FEATURES):
            yield chunk
            chunk, photos, held = [], set(), 0
            added = sum(features[photo] for photo in set(pair))
        chunk.append(pair)
        photos.update(pair)
        held += added
    if chunk:
        yield chunk


def forget_pairs(work: Workplace, copies: Sequence[WorkingCopy], pairs: Collection[Pair]) -> None:
    """Deletes the matches of pairs, so that they can be matched again."""
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        for a, b in pairs:
            first, second = ids[a], ids[b]
            if first is not None and second is not None and database.exists_matches(first, second):
                database.delete_matches(first, second)
                database.delete_two_view_geometry(first, second)


def verified_pairs(database: Any, copies: Sequence[WorkingCopy]) -> dict[Pair, int]:
    """Number of verified matches by pair of photos."""
    rows = {image_id: row for row, image_id in enumerate(image_ids(database, copies)) if image_id is not None}
    found = {}
    for pair_id, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
        a, b = (rows[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        if inliers:
            found[min(a, b), max(a, b)] = int(inliers)
    return found


def image_ids(database: Any, copies: Sequence[WorkingCopy]) -> list[int | None]:
    """The photos' ids in the database; None for photos that COLMAP could not read."""
    ids = {image.name: int(image.image_id) for image in database.read_all_images()}
    return [ids.get(copy.work_name) for copy in copies]
