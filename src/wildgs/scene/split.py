"""Train/test splits: NeRF-W's split files of the Phototourism scenes, else every n-th photo."""

from __future__ import annotations

import csv
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import check_regular, describe_names
from wildgs.scene.scene import Split

MAX_FILE_BYTES = 100 * 10**6

logger = logging.getLogger(__name__)


def find_split_file(root: Path) -> Path | None:
    """The scene's `*.tsv` file, or None.

    Raises:
        UserError: There are several such files.
    """
    found = sorted(root.glob("*.tsv"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise UserError(f"{root}: several split files ({names}); keep one")
    return found[0] if found else None


def read_split(path: Path) -> dict[str, Split]:
    """Reads a NeRF-W split: tab-separated `filename`, `id`, `split`, `dataset`.

    Rows without an id, which NeRF-W's authors excluded, are dropped.

    Returns:
        The split of each file name.

    Raises:
        UserError: The file cannot be read or is not such a table.
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
    """Assigns photos to train and test; photos that are not in a split file are left out.

    Args:
        names: Photos of the model, sorted.
        root: The scene folder, searched for a `*.tsv` file.
        holdout: Without a split file, every n-th photo is a test photo, starting with the first (as in 3DGS); 0 =
            none.

    Returns:
        The split of each photo, in the order of `names`.

    Raises:
        UserError: There are no training photos.
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
            f"{path}: the split leaves no training photo; the model has {len(matched)} of its {len(listed)} photos"
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
            "%d of %d photos are not in %s and are not used", len(names) - len(splits), len(names), path.name
        )
    return splits


def _hold_out(names: Sequence[str], holdout: int) -> dict[str, Split]:
    splits: dict[str, Split] = {
        name: "test" if holdout and index % holdout == 0 else "train" for index, name in enumerate(names)
    }
    if "train" not in splits.values():  # a scene of one photo
        return dict.fromkeys(names, "train")
    return splits
