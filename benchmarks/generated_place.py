"""Writes a scene of many photos with known poses: a block with four façades that stands in a walled square.

    python benchmarks/generated_place.py OUT --photos 2000 --megapixels 3
    python benchmarks/sfm_accuracy.py OUT

The block, the walls and the ground carry random textures with detail at all scales, so that SIFT finds features in
them as in a photo of stone. Cameras stand around the block at eye level and look towards it, with different focal
lengths and exposures. The scene has no points; `sfm_accuracy.py` reads its poses only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numba import njit
from PIL import Image
from scipy.ndimage import zoom

HALF_BLOCK = np.array([4.0, 3.0, 5.0], np.float32)
"""Half of the block's extent along x and z, and its height as y, units of about two metres."""
HALF_SQUARE, WALL_HEIGHT = 14.0, 9.0
TEXTURE = 4096
"""Side of a texture, pixels."""
EYE = 0.8
NOISE = 4.0
"""Standard deviation of the noise of photos, of 255."""


@dataclass(frozen=True)
class Command:
    """Writes a scene of generated photos."""

    output: tyro.conf.Positional[Path]
    """Folder to write."""
    photos: int = 2000
    """Number of photos."""
    megapixels: float = 3.0
    """Size of a photo, 4:3."""
    seed: int = 0
    """Random seed."""


def main(command: Command) -> None:
    """Writes `images/` and `sparse/0/`."""
    rng = np.random.default_rng(command.seed)
    width = round(np.sqrt(command.megapixels * 1e6 * 4 / 3))
    height = round(width * 3 / 4)
    levels = _mipmaps(np.stack([_texture(rng) for _ in range(9)]))
    images, sparse = command.output / "images", command.output / "sparse" / "0"
    images.mkdir(parents=True)
    sparse.mkdir(parents=True)
    cameras, poses = [], []
    for number in range(command.photos):
        focal = width * rng.uniform(0.75, 1.3)
        rotation, position = _camera(rng)
        shape = (height, width)
        values = _render(*levels, rotation, position, np.float32(focal), shape) * rng.uniform(0.6, 1.2)
        values += rng.normal(0, NOISE, shape).astype(np.float32)[..., None]
        name = f"{number:06d}.jpg"
        Image.fromarray(values.clip(0, 255).astype(np.uint8)).save(images / name, quality=90)
        cameras.append(f"{number + 1} PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}")
        translation = -rotation @ position
        values_text = " ".join(f"{value:.9f}" for value in (*_quaternion(rotation), *translation))
        poses.append(f"{number + 1} {values_text} {number + 1} {name}\n")
    (sparse / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (sparse / "images.txt").write_text("\n".join(poses) + "\n")
    (sparse / "points3D.txt").write_text("")


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Noise of several octaves over rows of rectangles, like windows and stones; [H, W, 3], 0 to 255."""
    values = np.zeros((TEXTURE, TEXTURE), np.float32)
    for cells in (8, 32, 128, 512, 2048):
        coarse = rng.normal(0, 1, (cells, cells)).astype(np.float32)
        values += zoom(coarse, TEXTURE // cells, order=1) * 14
    for _ in range(1500):
        size = np.exp(rng.uniform(np.log(8), np.log(200), 2)).astype(int)
        row, column = rng.integers(0, TEXTURE - size)
        values[row : row + size[0], column : column + size[1]] += rng.normal(0, 35)
    color = rng.uniform(0.75, 1.0, 3).astype(np.float32)
    return (values + 128).clip(10, 245)[..., None] * color


def _mipmaps(textures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All levels of all textures as rows of one array, and where each level begins."""
    levels, starts = [], [0]
    while textures.shape[1] > 1:
        levels.append(textures.reshape(-1, 3))
        starts.append(starts[-1] + len(levels[-1]))
        half = textures.shape[1] // 2
        textures = textures.reshape(len(textures), half, 2, half, 2, 3).mean((2, 4))
    return np.concatenate(levels).astype(np.uint8), np.array(starts)


def _camera(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation (x right, y down, z forward) and position; y of the world points up."""
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(7.5, 13)
    position = np.array([distance * np.cos(angle), EYE + rng.uniform(-0.1, 0.3), distance * np.sin(angle)])
    target = np.array([rng.normal(0, 1.5), rng.uniform(1.0, 3.5), rng.normal(0, 1.5)])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    roll = rng.normal(0, 0.03)
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    rotation = np.stack([turned, np.cross(forward, turned), forward])
    return rotation.astype(np.float32), position.astype(np.float32)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Real part first."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation.astype(np.float64)).as_quat(), 1)


@njit(fastmath=True, error_model="numpy")
def _render(texels, starts, rotation, position, focal, shape):
    """Rays against the inside of the square and the outside of the block; texture of the nearest level."""
    height, width = shape
    image = np.zeros((height, width, 3), np.float32)
    for row in range(height):
        for column in range(width):
            x, y = (column + 0.5 - width / 2) / focal, (row + 0.5 - height / 2) / focal
            ray = rotation[0] * x + rotation[1] * y + rotation[2]
            nearest, face, u, v, facing = np.inf, -1, 0.0, 0.0, 1.0
            if ray[1] < 0:
                t = -position[1] / ray[1]
                nearest, face, facing = t, 8, -ray[1]
                u = (position[0] + t * ray[0]) / (2 * HALF_SQUARE) + 0.5
                v = (position[2] + t * ray[2]) / (2 * HALF_SQUARE) + 0.5
            for axis in (0, 2):
                other = 2 - axis
                sign = 1.0 if ray[axis] > 0 else -1.0
                t = (sign * HALF_SQUARE - position[axis]) / ray[axis]
                h = position[1] + t * ray[1]
                if t < nearest and h < WALL_HEIGHT:
                    nearest, face, facing = t, 4 + axis + (1 if sign > 0 else 0), abs(ray[axis])
                    u = (position[other] + t * ray[other]) / (2 * HALF_SQUARE) + 0.5
                    v = 1 - h / (2 * HALF_SQUARE)
                t = (-sign * HALF_BLOCK[axis // 2] - position[axis]) / ray[axis]
                along, h = position[other] + t * ray[other], position[1] + t * ray[1]
                half = HALF_BLOCK[other // 2]
                if 0 < t < nearest and abs(along) < half and 0 <= h < HALF_BLOCK[2]:
                    nearest, face, facing = t, axis + (1 if sign > 0 else 0), abs(ray[axis])
                    u = (along + half) / 8.1
                    v = 1 - h / 8.1
            if face < 0:
                image[row, column] = 235.0
                continue
            side = 8.1 if face < 4 else 2 * HALF_SQUARE
            pixel = nearest / focal / side * TEXTURE / np.sqrt(max(facing, 0.05))
            level = min(max(int(np.log2(max(pixel, 1.0)) + 0.5), 0), len(starts) - 2)
            size = TEXTURE >> level
            a = min(max(u * size - 0.5, 0.0), size - 1.001)
            b = min(max(v * size - 0.5, 0.0), size - 1.001)
            i, j = int(b), int(a)
            p, q = b - i, a - j
            start = starts[level] + (face * size + i) * size + j
            for c in range(3):
                upper = texels[start, c] * (1 - q) + texels[start + 1, c] * q
                lower = texels[start + size, c] * (1 - q) + texels[start + size + 1, c] * q
                image[row, column, c] = upper * (1 - p) + lower * p
    return image


if __name__ == "__main__":
    main(tyro.cli(Command))
