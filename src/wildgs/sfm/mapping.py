"""The steps of structure from motion by pycolmap: features, pairs, matches, poses."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from wildgs.errors import UserError
from wildgs.progress import Progress
from wildgs.scene.images import DECODING_PIXELS, open_image
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.pairs import Pairing, choose_pairs
from wildgs.sfm.upright import WorkingCopy

EXTRACTION_BATCH = 16
MATCHING_BLOCK = 50
"""Photos per block of pairs: COLMAP keeps the features of two blocks in memory."""


@dataclass(frozen=True)
class Workplace:
    """Temporary folders and files beside the output."""

    root: Path

    @property
    def images(self) -> Path:
        """The upright copies."""
        return self.root / "images"

    @property
    def masks(self) -> Path:
        """Masks of transparent pixels, by copy; absent where no photo has any."""
        return self.root / "masks"

    @property
    def database(self) -> Path:
        """Features and matches."""
        return self.root / "database.db"

    @property
    def scene(self) -> Path:
        """The finished scene before it moves to its place."""
        return self.root / "scene"


@contextmanager
def quiet() -> Iterator[None]:
    """Silences COLMAP's log on stderr; errors are exceptions and empty results."""
    previous = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = previous


def extract(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> None:
    """Find SIFT features in all copies, with a camera of its own for each."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = config.max_image_size
    options.num_threads = config.threads
    options.sift.max_num_features = config.max_features
    done = 0
    # COLMAP passes over photos without a mask once it is given a folder of masks, so these go apart.
    for masked in (False, True):
        reader = pycolmap.ImageReaderOptions()
        if masked:
            reader.mask_path = work.masks
        names = [copy.work_name for copy in copies if copy.masked == masked]
        for batch in _batches(work, names):
            progress("finding features", done, len(copies))
            pycolmap.extract_features(
                work.database,
                work.images,
                batch,
                pycolmap.CameraMode.PER_IMAGE,
                reader_options=reader,
                extraction_options=options,
            )
            done += len(batch)
    progress("finding features", done, len(copies))


def _batches(work: Workplace, names: Sequence[str]) -> Iterator[list[str]]:
    """Copies that COLMAP may decode at the same time: its threads keep whole pictures."""
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


def match(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> Pairing:
    """Choose the pairs, match their features and verify the matches by epipolar geometry."""
    with closing(pycolmap.Database.open(work.database)) as database:
        ids = image_ids(database, copies)
        positions = {i: copy.position for i, copy in enumerate(copies) if copy.position is not None}

        def descriptors(photo: int) -> np.ndarray:
            image_id = ids[photo]
            if image_id is None or not database.exists_descriptors(image_id):
                return np.zeros((0, 128), dtype=np.uint8)
            return database.read_descriptors(image_id).data

        progress("choosing pairs", 0, 0)
        pairing = choose_pairs(len(copies), descriptors, positions, config.pairing, config.seed)

    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = config.threads
    lists = work.root / "pairs.txt"
    # Pairs of the same two blocks of photos go together, so that features are read once per block.
    pairs = sorted(
        pairing.pairs, key=lambda pair: (pair[0] // MATCHING_BLOCK, pair[1] // MATCHING_BLOCK, pair)
    )
    for start in range(0, len(pairs), MATCHING_BLOCK**2):
        progress("matching pairs", start, len(pairs))
        chunk = pairs[start : start + MATCHING_BLOCK**2]
        lists.write_text("".join(f"{copies[a].work_name} {copies[b].work_name}\n" for a, b in chunk))
        pycolmap.match_image_pairs(
            work.database,
            matching_options=options,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(lists)),
        )
    progress("matching pairs", len(pairs), len(pairs))
    return pairing


def map_photos(work: Workplace, photos: Path, count: int, config: SfmConfig, progress: Progress) -> list[Any]:
    """All models, the largest first."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = config.threads
    options.random_seed = config.seed
    options.min_model_size = min(options.min_model_size, max(2, count // 4))
    (work.root / "models").mkdir()
    done = 2  # a model starts from a pair

    def count_photo() -> None:
        nonlocal done
        done += 1
        progress("finding poses", min(done, count), count)

    progress("finding poses", 0, count)
    models = pycolmap.incremental_mapping(
        work.database, work.images, work.root / "models", options, next_image_callback=count_photo
    )
    if not models:
        raise UserError(
            f"{photos}: the {count} photos do not match each other, so they have no poses; photos of one"
            " place with much overlap are needed"
        )
    return sorted(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)


def image_ids(database: Any, copies: Sequence[WorkingCopy]) -> list[int | None]:
    """The database's ids; None for photos that COLMAP could not read."""
    ids = {image.name: int(image.image_id) for image in database.read_all_images()}
    return [ids.get(copy.work_name) for copy in copies]


def find_registered(model: Any, copy: WorkingCopy) -> Any | None:
    """The photo's image in a model, None where it has no pose there."""
    image = model.find_image_with_name(copy.work_name)
    return image if image is not None and image.has_pose else None
