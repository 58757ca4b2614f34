"""Binary encoding of the scene in the web page: geometry, and the colours of each appearance.

All values are quantised to bytes and stored in planes (all first bytes, then all second bytes, ...), with Gaussians
in Morton order, so that gzip compresses well. Appearances after the first are stored as differences from it, modulo
256. `web/src/scene.js` is the decoder.

    means      asinh of each coordinate, 24 bits between minimum and maximum, high byte first
    scales     logarithm, 8 bits
    opacities  8 bits
    quats      the three smallest of (x, y, z, w) in 10 bits each, the index of the largest in 2; low byte first
    light<i>   spherical harmonics, 8 bits, one range per degree; by basis function, r g b each
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from wildgs.exporters.splats import Splats
from wildgs.geometry.morton import morton_order

_TAIL = 2e-4
"""Fraction of the coefficients that is clipped at either end of a range, for finer steps within it."""

Planes = list[tuple[str, UInt8[np.ndarray, "C N"]]]


@dataclass(frozen=True)
class PackedScene:
    """Encoded scene: counts and ranges for a JSON header, and all planes, compressed by gzip."""

    header: dict[str, Any]
    data: bytes


def pack_scene(splats: Splats, lights: Sequence[Float[np.ndarray, "N K 3"]]) -> PackedScene:
    """Encodes the geometry and the colours under all appearances.

    Args:
        splats: Geometry; its own harmonics are ignored.
        lights: Spherical harmonics of each appearance, all of one degree.

    Raises:
        ValueError: There is no appearance, or no Gaussian.
    """
    if not lights or not len(splats):
        raise ValueError("a page needs at least one light and one Gaussian")
    # Morton order at the finest resolution over the whole bounding box compresses best.
    order = morton_order(splats.means.double().asinh(), bits=21, outside=0.0).numpy()
    header: dict[str, Any] = {"count": len(order), "sh_degree": int(np.sqrt(lights[0].shape[1])) - 1}
    planes: Planes = []
    header["means"], means = _pack_means(splats.means.numpy()[order])
    header["scales"], scales = _pack_scales(splats.scales.numpy()[order])
    opacities = np.rint(splats.opacities.numpy()[order].clip(0, 1) * 255).astype(np.uint8)
    planes += [("means", means), ("scales", scales), ("opacities", opacities[None])]
    planes += [("quats", _pack_quats(splats.quats.numpy()[order]))]
    header["colors"], colors = _pack_lights([light[order] for light in lights])
    planes += [(f"light{index}", codes) for index, codes in enumerate(colors)]
    header["planes"] = [[name, len(plane)] for name, plane in planes]
    data = b"".join(np.ascontiguousarray(plane).tobytes() for _, plane in planes)
    return PackedScene(header, gzip.compress(data, compresslevel=6, mtime=0))


def _pack_means(means: Float[np.ndarray, "N 3"]) -> tuple[dict[str, Any], UInt8[np.ndarray, "9 N"]]:
    places = np.arcsinh(means.astype(np.float64))
    low, high = places.min(axis=0), places.max(axis=0)
    steps = np.rint((places - low) / np.maximum(high - low, 1e-12) * 0xFFFFFF).astype(np.uint32)
    planes = [(steps[:, axis] >> shift) & 255 for axis in range(3) for shift in (16, 8, 0)]
    return {"least": low.tolist(), "most": high.tolist()}, np.stack(planes).astype(np.uint8)


def _pack_scales(scales: Float[np.ndarray, "N 3"]) -> tuple[dict[str, Any], UInt8[np.ndarray, "3 N"]]:
    logs = np.log(np.maximum(scales.astype(np.float64), 1e-9))
    low, high = float(logs.min()), float(logs.max())
    step = max(high - low, 1e-6) / 255
    return {"least": low, "step": step}, np.rint((logs - low) / step).astype(np.uint8).T


def _pack_quats(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "4 N"]:
    """Smallest-three encoding of (w, x, y, z) quaternions, as (x, y, z, w)."""
    unit = np.roll(quats.astype(np.float64), -1, axis=1)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    largest = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    kept = np.arange(4)[None] != largest[:, None]
    small = (unit * sign)[kept].reshape(-1, 3)
    codes = np.rint((small / np.sqrt(2.0) + 0.5).clip(0, 1) * 1023).astype(np.uint32)
    words = codes[:, 0] | codes[:, 1] << 10 | codes[:, 2] << 20 | largest.astype(np.uint32) << 30
    return np.stack([(words >> shift) & 255 for shift in (0, 8, 16, 24)]).astype(np.uint8)


def _pack_lights(
    lights: Sequence[Float[np.ndarray, "N K 3"]],
) -> tuple[dict[str, Any], list[UInt8[np.ndarray, "C N"]]]:
    """Codes of all appearances in shared ranges, so that the page can interpolate them."""
    bases = lights[0].shape[1]
    least, step = [], []
    codes = [np.empty((3 * bases, light.shape[0]), np.uint8) for light in lights]
    for degree in range(int(np.sqrt(bases))):
        band = slice(degree**2, (degree + 1) ** 2)
        low, high = _range([light[:, band] for light in lights])
        least.append(low)
        step.append((high - low) / 255)
        for light, target in zip(lights, codes, strict=True):
            values = (
                np.rint((light[:, band].astype(np.float64) - low) / step[-1]).clip(0, 255).astype(np.uint8)
            )
            target[3 * degree**2 : 3 * (degree + 1) ** 2] = values.reshape(len(values), -1).T
    first = codes[0]
    return {"least": least, "step": step}, [first, *(other - first for other in codes[1:])]


def _range(values: Sequence[np.ndarray]) -> tuple[float, float]:
    """Range of nearly all values of every appearance."""
    ends = np.stack([np.quantile(value, [_TAIL, 1 - _TAIL]) for value in values])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    return low, max(high, low + 1e-6)
