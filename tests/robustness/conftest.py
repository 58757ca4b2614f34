"""A tiny scene in both of COLMAP's formats, written byte by byte, and a run that was trained on it for no step."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT = 24, 16
PINHOLE = 1


@dataclass
class Model:
    """A sparse model that may be spoilt before it is written."""

    names: list[bytes] = field(default_factory=lambda: [b"p%02d.png" % i for i in range(6)])
    size: tuple[int, int] = (WIDTH, HEIGHT)
    params: Sequence[float] = (20.0, 20.0, 12.0, 8.0)
    poses: dict[int, Sequence[float]] = field(default_factory=dict)
    points: np.ndarray = field(
        default_factory=lambda: np.random.default_rng(0).normal(size=(30, 3)) * [1, 1, 0.3] + [0, 0, 4]
    )

    def pose(self, index: int) -> Sequence[float]:
        return self.poses.get(index, (1, 0, 0, 0, 0.2 * index, 0.1 * (index % 2), 0))

    def write_binary(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        camera = struct.pack("<QIiQQ", 1, 1, PINHOLE, *self.size) + struct.pack("<4d", *self.params)
        (folder / "cameras.bin").write_bytes(camera)
        images = struct.pack("<Q", len(self.names))
        for index, name in enumerate(self.names):
            images += struct.pack("<I7dI", index + 1, *self.pose(index), 1) + name + b"\0"
            images += struct.pack("<Q", 1) + struct.pack("<2dQ", 1.0, 2.0, 0)
        (folder / "images.bin").write_bytes(images)
        points = struct.pack("<Q", len(self.points))
        for index, point in enumerate(self.points):
            points += struct.pack("<Q3d3Bd", index, *point, 200, 100, 50, 0.5)
            points += struct.pack("<QIIII", 2, 1, 0, 2, 0)
        (folder / "points3D.bin").write_bytes(points)

    def write_text(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        camera = f"# a comment\n1 PINHOLE {self.size[0]} {self.size[1]} {' '.join(map(str, self.params))}\n"
        (folder / "cameras.txt").write_text(camera)
        images = b"# Number of images: %d, mean observations per image: 0.5\n" % len(self.names)
        for index, name in enumerate(self.names):
            pose = " ".join(map(str, self.pose(index)))
            images += f"{index + 1} {pose} 1 ".encode() + name + b"\n" + (b"" if index % 2 else b"1.0 2.0 0")
            images += b"\n"
        (folder / "images.txt").write_bytes(images)
        lines = [
            f"{index} {x} {y} {z} 200 100 50 0.5 1 0 2 0\n" for index, (x, y, z) in enumerate(self.points)
        ]
        (folder / "points3D.txt").write_text("".join(lines))


def write_scene(root: Path, model: Model | None = None, *, text: bool = False) -> Path:
    """The scene with photos of noise, masks and depth of the third photo, and no split."""
    model = model or Model()
    (model.write_text if text else model.write_binary)(root / "sparse" / "0")
    rng = np.random.default_rng(1)
    images = root / "images"
    images.mkdir(exist_ok=True)
    for name in model.names:
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / name.decode(errors="surrogateescape"), format="PNG")
    return root


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    root = tmp_path / "scene"
    root.mkdir()
    return write_scene(root)


@pytest.fixture
def make_model() -> type[Model]:
    """The model of `scene`, to be spoilt and written again."""
    return Model
