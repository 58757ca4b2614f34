"""What does training take in memory: per Gaussian, per pixel, and with a collection larger than the image cache?

`python benchmarks/memory.py` measures the constants of `engine/memory.py`: peak resident memory of short
trainings that differ in one size. With `--photos 2000` it trains on so many photos of `--megapixels` within
`--image-cache`, and prints the peak beyond the cache.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from wildgs.model.registry import MethodName


@dataclass(frozen=True)
class Command:
    """Measures memory."""

    method: MethodName = "3dgs"
    """What is trained."""
    photos: int = 0
    """Trains on so many photos on disk; 0 measures the constants."""
    megapixels: float = 12.0
    """Size of these photos."""
    image_cache: str = "500MB"
    """Limit for decoded photos."""
    downscale: float = 1.0
    """Divides width and height of these photos."""
    steps: int = 4
    """Training steps."""
    case: str = ""
    """Internal: GAUSSIANS,SIDE of one measurement."""


def main(command: Command) -> None:
    if command.case:
        count, side = map(int, command.case.split(","))
        print(json.dumps(_train_in_memory(command, count, side)))
    elif command.photos:
        _train_on_photos(command)
    else:
        _measure_constants(command)


def _measure_constants(command: Command) -> None:
    few, many, small, large = 20_000, 120_000, 320, 1280
    base, gaussians, pixels = (
        _measure(command, count, side) for count, side in ((few, small), (many, small), (few, large))
    )
    per_gaussian = (gaussians - base) / (many - few)
    per_pixel = (pixels - base) / (large**2 - small**2)
    fixed = base - per_gaussian * few - per_pixel * small**2
    print(
        f"{command.method}: {per_gaussian:.0f} bytes a Gaussian, {per_pixel:.0f} bytes a pixel, "
        f"{fixed / 2**20:.0f} MiB besides"
    )


def _measure(command: Command, count: int, side: int) -> int:
    arguments = ["--method", command.method, "--steps", str(command.steps), "--case", f"{count},{side}"]
    result = subprocess.run(
        [sys.executable, __file__, *arguments], capture_output=True, text=True, check=True
    )
    peak = int(json.loads(result.stdout.splitlines()[-1]))
    print(f"{count:,} Gaussians, {side}x{side} pixels: peak {peak / 2**20:.0f} MiB", flush=True)
    return peak


def _train_in_memory(command: Command, count: int, side: int) -> int:
    import numpy as np
    import torch

    from wildgs.engine.checkpoint import save_checkpoint
    from wildgs.engine.schedule import ScheduleConfig
    from wildgs.engine.trainer import TrainConfig, Trainer
    from wildgs.geometry.camera import Camera
    from wildgs.model.registry import method_type
    from wildgs.scene import Alignment, Scene, View
    from wildgs.scene.images import Photo
    from wildgs.scene.photo_store import PhotoStore

    class SamePhoto(PhotoStore):
        def get(self, name: str) -> Photo:
            return photo

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) - torch.tensor([0.5, 0.5, -1.0])
    colors = torch.full((count, 3), 128, dtype=torch.uint8)
    photo = Photo(np.full((side, side, 3), 100, dtype=np.uint8))
    photos = SamePhoto()
    K = torch.tensor([[0.8 * side, 0, side / 2], [0, 0.8 * side, side / 2], [0, 0, 1]])
    views = tuple(
        View(
            name=f"{index}.jpg",
            camera=Camera(torch.eye(4), K, side, side),
            split="train",
            photos=photos,
        )
        for index in range(2)
    )
    scene = Scene(Path("memory"), views, points, colors, Alignment.identity())
    kind = method_type(command.method)
    schedule = ScheduleConfig(first_stage=1, densify_from=1, densify_every=30_000 // command.steps * 2)
    config = TrainConfig(steps=command.steps, schedule=schedule)
    trainer = Trainer(kind.from_points(kind.Config(), points, colors), scene, config)
    trainer.run()
    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder), trainer.step, trainer.state(), {})
    return _peak()


def _train_on_photos(command: Command) -> None:
    from wildgs.engine.trainer import TrainConfig, Trainer
    from wildgs.model.registry import create_method
    from wildgs.scene import DataConfig, load_scene
    from wildgs.scene.config import parse_bytes
    from wildgs.scene.images import read_photo

    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        width, height = _write_scene(root, command)
        read_photo(root / "images" / "000000.jpg")
        config = DataConfig(downscale=command.downscale, holdout=0)
        scene = load_scene(root, config, image_cache=command.image_cache, progress=_progress)
        print(
            f"\n{len(scene.views)} photos of {width}x{height}: peak {_peak() / 2**20:.0f} MiB after reading"
        )
        method = create_method(command.method, None, scene)
        trainer = Trainer(method, scene, TrainConfig(steps=command.steps))
        trainer.run([lambda report: print(f"step {report.step}: peak {_peak() / 2**20:.0f} MiB", flush=True)])
        beyond = _peak() - parse_bytes(command.image_cache)
        print(f"peak {_peak() / 2**20:.0f} MiB = cache of {command.image_cache} + {beyond / 2**20:.0f} MiB")


def _write_scene(root: Path, command: Command) -> tuple[int, int]:
    """One noisy photo under many names, and a model in text."""
    import numpy as np
    from PIL import Image

    height = round((command.megapixels * 1e6 / (4 / 3)) ** 0.5)
    width = round(height * 4 / 3)
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (height // 16 + 1, width // 16 + 1, 3), dtype=np.uint8)
    (root / "images").mkdir()
    first = root / "images" / "000000.jpg"
    Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(first, quality=90)
    for index in range(1, command.photos):
        first.with_name(f"{index:06d}.jpg").hardlink_to(first)
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    focal = 0.8 * width
    camera = f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n"
    (sparse / "cameras.txt").write_text(camera)
    lines = [f"{i + 1} 1 0 0 0 {0.001 * i} 0 0 1 {i:06d}.jpg\n\n" for i in range(command.photos)]
    (sparse / "images.txt").write_text("".join(lines))
    points = rng.normal(size=(2000, 3)) * [1, 1, 0.2] + [0, 0, 4]
    lines = [f"{i + 1} {x} {y} {z} 128 128 128 0 1 0\n" for i, (x, y, z) in enumerate(points)]
    (sparse / "points3D.txt").write_text("".join(lines))
    return width, height


def _progress(done: int, total: int) -> None:
    if done % 100 == 0 or done == total:
        print(f"\rread {done} of {total}: peak {_peak() / 2**20:.0f} MiB", end="", flush=True)


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main(tyro.cli(Command))
