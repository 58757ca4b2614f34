"""Projection on the CPU: the autograd function around its kernels, tile lists, and reused scratch memory."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.rasterize.cpu import project_backward_kernels, project_kernels, tile_kernels
from wildgs.rasterize.cpu.footprint_kernels import CHUNK, GROUP
from wildgs.rasterize.cpu.reach_kernels import RECORD, TILE
from wildgs.rasterize.interface import Projection
from wildgs.threads import begin, flat, launch, run_once, thread_count

_lock = threading.Lock()
_free: dict[str, np.ndarray] = {}


@contextmanager
def scratch(name: str, size: int, dtype: type) -> Iterator[np.ndarray]:
    """Provides an uninitialised flat array that is cached under `name` for reuse.

    Concurrent requests get separate arrays, of which the largest is cached.
    """
    with _lock:
        array = _free.pop(name, None)
    if array is None or array.size < size:
        array = _aligned(size + size // 4, dtype)
    try:
        yield array[:size]
    finally:
        with _lock:
            kept = _free.get(name)
            if kept is None or kept.size < array.size:
                _free[name] = array


def _aligned(size: int, dtype: type) -> np.ndarray:
    """A flat array aligned to a cache line."""
    item = np.dtype(dtype).itemsize
    raw = np.empty(size + 64 // item, dtype)
    skip = -raw.ctypes.data % 64 // item
    return raw[skip : skip + size]


@dataclass(frozen=True)
class TileLists:
    """Tile lists and the geometry that blending reads, in flat arrays.

    Visible Gaussians are numbered by rank, so that neighbours in the image are neighbours in memory.

    Attributes:
        ranks: Rank of each Gaussian; -1 if it touches no tile.
        homes: Index of the Gaussian of each rank.
        records: Geometry of each rank, eight floats (see `reach_kernels.RECORD`).
        starts: First slot of each rank's (tile, Gaussian) pairs, followed by the number of pairs.
        offsets: Start of each tile's list in `entries` (in pairs), followed by the number of pairs.
        entries: Two numbers per pair, tile by tile, nearest first: the rank, and the pair's slot among the pairs
            sorted by rank. They are interleaved because they are written in random order.
        tile_order: Tiles in the order of processing, longest lists first, to balance the threads.
    """

    ranks: np.ndarray
    homes: np.ndarray
    records: np.ndarray
    starts: np.ndarray
    offsets: np.ndarray
    entries: np.ndarray
    tile_order: np.ndarray

    @property
    def pairs(self) -> int:
        """Number of (tile, Gaussian) pairs."""
        return self.entries.size // 2


@dataclass(frozen=True)
class _Lens:
    """Camera parameters in the layout of the kernels: `lens` is fx, fy, cx, cy, eps2d, antialiased."""

    view: np.ndarray
    lens: np.ndarray
    width: int
    height: int

    @staticmethod
    def of(camera: Camera, eps2d: float, antialiased: bool) -> _Lens:
        K = camera.K.detach().to("cpu", torch.float32).numpy()  # indexing a tensor costs ten times as much
        view = camera.viewmat.detach().to("cpu", torch.float32)[:3].contiguous().numpy().reshape(-1)
        lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], eps2d, antialiased], np.float32)
        return _Lens(view, lens, camera.width, camera.height)

    def arguments(self) -> tuple[Any, ...]:
        return self.view, self.lens, np.float32(self.width), np.float32(self.height)


def _padded(tensor: Tensor) -> Tensor:
    """Pads to the sixteen rows that the SIMD kernels need; the added rows are zero and hence culled."""
    missing = GROUP - len(tensor)
    return tensor if missing <= 0 else torch.cat([tensor, tensor.new_zeros(missing, *tensor.shape[1:])])


def _first(tensor: Tensor, n: int) -> Tensor:
    """Undoes `_padded`. Returns an unpadded tensor itself, since slicing costs a copy in the backward pass."""
    return tensor if len(tensor) == n else tensor[:n]


class _Project(torch.autograd.Function):
    """Autograd function of projection: returns the kernel's outputs; the backward pass is `project_backward`."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, lens: _Lens, outputs: Any) -> Any:
        *values, radii = outputs
        ctx.save_for_backward(means, quats, scales, radii)
        ctx.lens = lens
        return tuple(values)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        means, quats, scales, radii = ctx.saved_tensors
        outputs = (torch.empty_like(means), torch.empty_like(quats), torch.empty_like(scales))
        launch(
            project_backward_kernels.project_backward,
            *map(flat, (means, quats, scales)),
            *ctx.lens.arguments(),
            *map(flat, (radii, *grads)),
            *map(flat, outputs),
            items=_chunks(len(means)),
        )
        return *outputs, None, None


def _chunks(count: int) -> int:
    return -(-count // (GROUP * CHUNK))


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    camera: Camera,
    near: float,
    absgrad: bool,
    eps2d: float,
    antialiased: bool,
) -> Projection:
    """See `wildgs.rasterize.project`."""
    n = len(means)
    means_, quats_, scales_, opacities_ = (_padded(t).contiguous() for t in (means, quats, scales, opacities))
    lens = _Lens.of(camera, eps2d, antialiased)
    count = len(means_)
    means2d, depths = torch.empty(count, 2), torch.empty(count)
    conics, radii = torch.empty(count, 3), torch.empty(count, dtype=torch.int32)
    compensations = torch.empty(count if antialiased else 0)
    tile_counts = np.empty(count, np.int32)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    chunks = max(1, min(max(8, 2 * thread_count()), count // 1024))
    with (
        scratch("records", count * RECORD, np.float32) as records,
        scratch("boxes", count, np.int64) as boxes,
        scratch("masks", count, np.int32) as masks,
        scratch("cursors", chunks * (tiles_x * tiles_y + tiles_x + 2), np.int64) as counts,
    ):
        cursors = counts.reshape(chunks, -1)
        launch(
            project_kernels.project_forward,
            *map(flat, (means_, quats_, scales_, opacities_)),
            *lens.arguments(),
            np.float32(near),
            *map(flat, (means2d, depths, conics, compensations, radii)),
            records, boxes, masks, tile_counts, tiles_x, cursors,
            items=chunks,
        )  # fmt: skip
        tiles = _list_tiles(depths.numpy(), records, boxes, masks, tile_counts, cursors, (tiles_x, tiles_y))
    if torch.is_grad_enabled() and any(t.requires_grad for t in (means_, quats_, scales_)):
        outputs = (means2d, depths, conics, compensations, radii)
        means2d, depths, conics, compensations = _Project.apply(means_, quats_, scales_, lens, outputs)  # type: ignore[misc]
    return Projection(
        camera=camera,
        means2d=_first(means2d, n),
        depths=_first(depths, n),
        conics=_first(conics, n),
        opacities=opacities.clamp(max=1) * _first(compensations, n) if antialiased else opacities,
        radii=_first(radii, n),
        backend="cpu",
        tiles=tiles,
        absgrad=torch.zeros(n, 2) if absgrad else None,
    )


def _list_tiles(
    depths: np.ndarray,
    records: np.ndarray,
    boxes: np.ndarray,
    masks: np.ndarray,
    tile_counts: np.ndarray,
    cursors: np.ndarray,
    size: tuple[int, int],
) -> TileLists:
    """Ranks the Gaussians and builds the depth-sorted tile lists (see `tile_kernels`).

    Args:
        depths: Depth of each Gaussian, with the results of `project_forward` in the order of its arguments.
        records: As above.
        boxes: As above.
        masks: As above.
        tile_counts: As above.
        cursors: As above; overwritten.
        size: Number of tiles in a row and in a column.
    """
    tiles_x, tiles_y = size
    n, chunks = tile_counts.size, len(cursors)
    offsets = np.empty(tiles_x * tiles_y + 1, np.int64)
    run_once(tile_kernels.place_chunks, cursors, offsets)
    seen = int(offsets[-1])
    ranks, homes = np.empty(n, np.int32), np.empty(seen, np.int32)
    ranked_records, starts = np.empty(seen * RECORD, np.float32), np.empty(seen + 1, np.int64)
    tile_order = np.empty(tiles_x * tiles_y, np.int64)
    with (
        scratch("spans", 4 * seen, np.int32) as spans,
        scratch("keys", 2 * seen, np.uint32) as keys,
        scratch("order", 2 * seen, np.int32) as order,
        scratch("nearest", seen, np.int32) as nearest,
    ):
        ordered = begin(
            tile_kernels.sort_by_depth,
            depths, tile_counts, keys[:seen], order[:seen], keys[seen:], order[seen:],
        )  # fmt: skip
        launch(
            tile_kernels.move_home,
            tile_counts, boxes, masks, records, tiles_x, cursors, ranks, homes, ranked_records, spans,
            items=chunks,
        )  # fmt: skip
        numbered = begin(tile_kernels.number_slots, spans, starts)
        launch(
            tile_kernels.count_pairs, ordered(), ranks, nearest, spans, ranked_records, tiles_x, cursors,
            items=chunks,
        )  # fmt: skip
        run_once(tile_kernels.place_chunks, cursors, offsets)
        pairs = numbered()
        if pairs >= 2**31:
            raise UserError(f"too many pairs of tile and Gaussian ({pairs:,}); render at a lower resolution")
        entries = np.empty(2 * pairs + 2, np.int32)
        run_once(tile_kernels.order_tiles, offsets, tile_order)
        launch(
            tile_kernels.write_pairs, nearest, spans, ranked_records, starts, tiles_x, cursors, entries,
            items=chunks,
        )  # fmt: skip
    return TileLists(ranks, homes, ranked_records, starts, offsets, entries[:-2], tile_order)
