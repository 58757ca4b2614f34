"""Output files of evaluation: one image per view, and JSON, written atomically."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from wildgs.files import written_aside


def picture_paths(names: Iterable[str]) -> dict[str, PurePosixPath]:
    """Relative path of the image of each view.

    Folders in a name are kept, and parts that leave the output folder (``..``, a root, a drive) are replaced. Views
    whose names differ only in the suffix keep it, so that no two views share a file.

    Args:
        names: Unique view names.
    """
    safe = {name: _inside(name) for name in names}
    stems = Counter(str(path.with_suffix(".png")).lower() for path in safe.values())
    paths: dict[str, PurePosixPath] = {}
    taken: set[str] = set()
    for name, path in safe.items():
        target = path.with_suffix(".png")
        if stems[str(target).lower()] > 1:
            target = path.with_name(path.name + ".png")
        while str(target).lower() in taken:
            target = target.with_name("_" + target.name)
        taken.add(str(target).lower())
        paths[name] = target
    return paths


def distinct_names(names: Sequence[str]) -> list[str]:
    """Unique names for `picture_paths`: those of repeated names end with their position in the sequence."""
    count = Counter(names)
    paths = [PurePosixPath(name) for name in names]
    return [
        str(path.with_stem(f"{path.stem}_{number}")) if count[name] > 1 else name
        for number, (name, path) in enumerate(zip(names, paths, strict=True))
    ]


def _inside(name: str) -> PurePosixPath:
    parts = [part.replace(":", "_") for part in name.replace("\\", "/").split("/")]
    parts = ["_" if part == ".." else part for part in parts if part not in ("", ".")]
    return PurePosixPath(*parts) if parts else PurePosixPath("_")


def write_picture(file: Path, picture: UInt8[Tensor, "H W 3"]) -> None:
    """Writes a PNG or JPEG, by the suffix, atomically."""
    jpeg = file.suffix.lower() in (".jpg", ".jpeg")
    options = {"format": "JPEG", "quality": 95} if jpeg else {"format": "PNG"}
    with written_aside(file) as aside:
        Image.fromarray(picture.cpu().numpy()).save(aside, **options)


def write_json(file: Path, content: dict[str, Any]) -> None:
    """Writes strict JSON (without NaN) atomically."""
    with written_aside(file) as aside:
        aside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
