"""The NeRF-W split files of the Phototourism scenes, and the plain hold-out where there is none."""

from __future__ import annotations

import csv
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import check_regular
from wildgs.scene.colmap import describe_names
from wildgs.scene.scene import Split

MAX_FILE_BYTES = 100 * 10**6

logger = logging.getLogger(__name__)


def find_split_file(root: Path) -> Path | None:
    """The scene's `*.tsv`, None where it has none.

    Raises:
        UserError: There are several.
    """
    found = sorted(root.glob("*.tsv"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise UserError(f"{root}: several split files ({names}); keep one")
    return found[0] if found else None


def read_split(path: Path) -> dict[str, Split]:
    """Read a NeRF-W split: tab-separated `filename`, `id`, `split`, `dataset`.

    Rows without an id are photos that NeRF-W's authors set aside; they are dropped, as NeRF-W does.

    Returns:
        From file name to split.

    Raises:
        UserError: The file is not such a table.
    """
    try:
        check_regular(path)
        if path.stat().st_size > MAX_FILE_BYTES:
            raise UserError(f"{path}: larger than {MAX_FILE_BYTES} bytes; this is not a split file")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, delimiter="\t", strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: the split file cannot be read ({error})") from error
    columns = set(rows[0]) if rows else set()
    if not {"filename", "split"} <= columns:
        raise UserError(
            f"{path}: a split file needs the tab-separated columns filename, id, split (and rows)"
        )

    splits: dict[str, Split] = {}
    for row in rows:
        filename, split = (row["filename"] or "").strip(), (row["split"] or "").strip().lower()
        if not filename or not (row.get("id", "0") or "").strip():
            continue
        if split not in ("train", "test"):
            raise UserError(f"{path}: {filename} has the split {split!r}; it must be train or test")
        if splits.get(filename, split) != split:
            raise UserError(f"{path}: {filename} is listed as train and as test; keep one of the rows")
        splits[filename] = "train" if split == "train" else "test"
    return splits


def assign_splits(names: Sequence[str], root: Path, holdout: int) -> dict[str, Split]:
    """Which photos train, which test; photos that a split file does not name are left out.

    Args:
        names: Photos of the model, sorted.
        root: The scene's folder, searched for a `*.tsv`.
        holdout: Where there is no split file, every n-th photo tests, starting with the first (as 3DGS does);
            0 = none.

    Returns:
        From name to split, in the order of `names`.

    Raises:
        UserError: The split leaves no photo to train.
    """
    path = find_split_file(root)
    if path is None:
        return _hold_out(names, holdout)
    listed = read_split(path)
    splits: dict[str, Split] = {}
    matched = set()
    for name in names:
        # The authors' files give bare file names; models may keep photos in sub-folders.
        key = name if name in listed else PurePosixPath(name).name
        if key in listed:
            splits[name] = listed[key]
            matched.add(key)
    missing = sorted(set(listed) - matched)
    if "train" not in splits.values():
        raise UserError(
            f"{path}: the split leaves no photo to train; the model has {len(matched)} of its {len(listed)}"
            + (f" (missing: {describe_names(missing)})" if missing else "")
        )
    if missing:
        warnings.warn(
            f"{path.name} names {len(missing)} photos that the model does not have:"
            f" {describe_names(missing)}; they are left out",
            WildGSWarning,
            stacklevel=2,
        )
    if len(splits) < len(names):
        logger.info(
            "%d of %d photos are not in %s and stay unused", len(names) - len(splits), len(names), path.name
        )
    return splits


def _hold_out(names: Sequence[str], holdout: int) -> dict[str, Split]:
    splits: dict[str, Split] = {
        name: "test" if holdout and index % holdout == 0 else "train" for index, name in enumerate(names)
    }
    if "train" not in splits.values():  # a scene of one photo: nothing can be held out
        return dict.fromkeys(names, "train")
    return splits
