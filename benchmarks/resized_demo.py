"""The demo's scene with fewer photos, points and pixels (or more pixels), for tests and benchmarks."""

from __future__ import annotations

import tempfile
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from PIL import Image

from wildgs.scene.demo import write_demo_scene

TEST_SHARE = 4  # one photo in so many is held out


def write_resized_demo(
    folder: Path, *, photos: int = 40, long_side: int = 240, points: int | None = None
) -> Path:
    """Writes the demo's scene at another size: the same split, poses, depth priors and truth.

    Args:
        folder: The scene folder to make.
        photos: Number of photos, spread over the collection; a quarter of them held out (all: as shipped).
        long_side: Longer side of the photos, pixels.
        points: Upper bound on the sparse points; None keeps those that two or more of the photos see.

    Returns:
        The folder.
    """
    with tempfile.TemporaryDirectory() as temporary:
        source = write_demo_scene(Path(temporary) / "scene")
        rows = [line.split("\t") for line in (source / "split.tsv").read_text().splitlines()]
        names = _choose(rows[1:], photos)
        _resize_model(source, folder, names, long_side, points)
        for name in names:
            _resize_pictures(source, folder, PurePosixPath(name), long_side)
        kept = ["\t".join(row) + "\n" for row in rows if row[0] in {"filename", *names}]
        (folder / "split.tsv").write_text("".join(kept), encoding="utf-8")
    return folder


def _choose(rows: list[list[str]], photos: int) -> list[str]:
    """Names of test and training photos, evenly spread."""
    test = [row[0] for row in rows if row[2] == "test"]
    train = [row[0] for row in rows if row[2] == "train"]
    held_out = min(len(test), photos // TEST_SHARE)
    chosen = _spread(train, photos - held_out) + _spread(test, held_out)
    return sorted(chosen)


def _spread(names: list[str], count: int) -> list[str]:
    return [names[index] for index in np.linspace(0, len(names) - 1, count).round().astype(int)]


def _resize_model(source: Path, folder: Path, names: list[str], long_side: int, points: int | None) -> None:
    model = pycolmap.Reconstruction(str(source / "sparse" / "0"))
    for image in list(model.images.values()):
        if image.name not in names:
            model.deregister_frame(image.frame_id)
            continue
        camera = image.camera
        scale = long_side / max(camera.width, camera.height)
        camera.rescale(round(scale * camera.width), round(scale * camera.height))
        for point in image.points2D:
            point.xy = scale * point.xy
    if points is not None:
        ids = sorted(model.points3D)
        for index in np.random.default_rng(0).permutation(len(ids))[points:]:
            model.delete_point3D(ids[index])
    model.update_point_3d_errors()
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(str(folder / "sparse" / "0"))


def _resize_pictures(source: Path, folder: Path, name: PurePosixPath, long_side: int) -> None:
    stem = name.with_suffix(".png")
    for file, method in (
        (Path("images", name), Image.Resampling.LANCZOS),
        (Path("truth/clean", stem), Image.Resampling.LANCZOS),
        (Path("depth", stem), Image.Resampling.NEAREST),  # 0 is no disparity: nothing may be mixed with it
        (Path("truth/masks", stem), Image.Resampling.NEAREST),
    ):
        if not (source / file).is_file():
            continue
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        with Image.open(source / file) as picture:
            scale = long_side / max(picture.size)
            size = (round(scale * picture.width), round(scale * picture.height))
            resized = picture.resize(size, method)
        resized.save(folder / file, quality=92, subsampling=0)
