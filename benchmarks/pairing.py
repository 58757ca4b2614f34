"""Retrieval against exhaustive matching, and the cost of choosing pairs against the number of photos.

    python -m benchmarks.pairing ../shared/data/gate ../shared/data/liberty --photos 50 100 200
    python -m benchmarks.pairing generated --photos 200 500 1000 2000

The first form reconstructs the same photos once with all pairs and once with those of retrieval, and prints
registered photos, pairs and CPU time. Photos of several places are taken in equal shares; photos registered are
those of the model that is kept.

The second form measures pairing alone, without matching: features of photos that are warped crops of the demo's
photos with noise (`--side` pixels), their VLAD descriptors, and the choice of pairs. Each number of photos runs in
a process of its own, so that the peak of memory is its own. A crop counts as found if retrieval pairs it with
another crop of the same photo.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

import wildgs
from wildgs.progress import silent
from wildgs.scene.demo import write_demo_scene
from wildgs.sfm.config import PairingConfig, SfmConfig
from wildgs.sfm.mapping import quiet
from wildgs.sfm.matching import describe_photos, extract
from wildgs.sfm.pairs import choose_pairs
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

GENERATED = "generated"
NOISE = 6.0
"""Standard deviation of the noise of generated photos, of 255."""


@dataclass(frozen=True)
class Command:
    """Measures pairing."""

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """Scenes whose photos are reconstructed, or `generated`."""
    photos: tuple[int, ...] = (50, 100, 200)
    """Numbers of photos."""
    side: int = 480
    """Longer side of generated photos, pixels."""
    max_features: int = 1000
    """Upper bound on the features of a generated photo; retrieval reads at most 1,000."""
    case: bool = False
    """Internal: measures the single number of photos in this process."""


def main(command: Command) -> None:
    """Prints one line per measurement."""
    if command.case:
        print(json.dumps(_measure_pairing(command, command.photos[0])))
    elif command.scenes == (GENERATED,):
        for count in command.photos:
            _print_pairing(command, count)
    else:
        for count in command.photos:
            _compare([Path(scene) for scene in command.scenes], count)


def _compare(scenes: list[Path], count: int) -> None:
    files = [file for scene in scenes for file in _spread(scene, count // len(scenes))]
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        photos.mkdir()
        for file in files:
            (photos / f"{file.parents[1].name}_{file.name}").symlink_to(file.resolve())
        for name, limit in (("retrieval", 0), ("exhaustive", sys.maxsize)):
            config = SfmConfig(pairing=PairingConfig(exhaustive_features=limit))
            used, started = time.process_time(), time.perf_counter()
            report = wildgs.reconstruct(photos, Path(folder) / name, config)
            print(
                f"{len(files)} photos, {name}: {len(report.registered)} registered, other groups"
                f" {[len(group) for group in report.other_places]}, {report.points} points, {report.pairs} pairs,"
                f" {time.process_time() - used:.0f} s of CPU, {time.perf_counter() - started:.0f} s",
                flush=True,
            )


def _spread(scene: Path, count: int) -> list[Path]:
    """Photos of a scene, evenly spread in the order of their names."""
    files = sorted(path for path in (scene / "images").iterdir() if path.is_file())
    rows = np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)
    return [files[row] for row in rows]


def _print_pairing(command: Command, count: int) -> None:
    options = [
        "--photos",
        str(count),
        "--side",
        str(command.side),
        "--max-features",
        str(command.max_features),
    ]
    script = [sys.executable, "-m", "benchmarks.pairing", GENERATED, "--case", *options]
    result = json.loads(subprocess.run(script, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1])
    peak, before, stored = (result[name] / 2**20 for name in ("peak", "before", "database"))
    print(
        f"{count} photos: features {result['features']:.1f} s, descriptors {result['descriptors']:.1f} s,"
        f" choosing {result['pairs']:,} pairs {result['choosing']:.2f} s (CPU); {result['found']:.1%} of the photos"
        f" are paired with a crop of the same photo; peak {peak:,.0f} MiB, {before:,.0f} MiB of it before the"
        f" descriptors; database {stored:,.0f} MiB",
        flush=True,
    )


def _measure_pairing(command: Command, count: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        work = Workplace(Path(folder))
        work.images.mkdir()
        copies, sources = _write_photos(Path(folder), work.images, count, command.side)
        config = SfmConfig(max_features=command.max_features)
        began = time.process_time()
        with quiet():
            extract(work, copies, config, silent)
        extracted, before = time.process_time(), _peak()
        vlads = describe_photos(work, copies, config.seed)
        described = time.process_time()
        chosen = choose_pairs(vlads, {}, config.pairing, sys.maxsize)
        done = time.process_time()
        found = {photo for pair in chosen.pairs if sources[pair[0]] == sources[pair[1]] for photo in pair}
        return {
            "features": extracted - began,
            "descriptors": described - extracted,
            "choosing": done - described,
            "pairs": len(chosen.pairs),
            "found": len(found) / count,
            "before": before,
            "peak": _peak(),
            "database": work.database.stat().st_size,
        }


def _write_photos(root: Path, folder: Path, count: int, side: int) -> tuple[list[WorkingCopy], list[int]]:
    """Writes warped crops of the demo's photos with noise; returns them and the index of each one's photo."""
    demo = sorted((write_demo_scene(root / "demo") / "images").iterdir())
    rng = np.random.default_rng(0)
    copies, sources = [], []
    for number in range(count):
        sources.append(number % len(demo))
        name = f"{number:06d}.jpg"
        with Image.open(demo[sources[-1]]) as photo:
            _warped(photo.convert("RGB"), side, rng).save(folder / name, quality=90)
        copies.append(WorkingCopy(name, name, name, masked=False))
    return copies, sources


def _warped(photo: Image.Image, side: int, rng: np.random.Generator) -> Image.Image:
    """A quadrilateral with corners at up to a sixth of the sides, at another size and brightness, with noise."""
    width, height = photo.size
    inwards = rng.uniform(0, 1 / 6, (4, 2)) * [width, height]
    corners = np.array([[0, 0], [0, height], [width, height], [width, 0]])
    quad = corners + inwards * [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    size = (side, round(side * height / width))
    warped = photo.transform(
        size, Image.Transform.QUAD, tuple(quad.ravel()), resample=Image.Resampling.BICUBIC
    )
    values = np.asarray(warped, np.float32) * rng.uniform(0.7, 1.2) + rng.normal(0, NOISE, (*size[::-1], 1))
    return Image.fromarray(values.clip(0, 255).astype(np.uint8))


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main(tyro.cli(Command))
