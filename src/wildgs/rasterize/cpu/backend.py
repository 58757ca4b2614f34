"""The CPU backend: torch tensors in and out, Numba kernels inside, gradients by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize.cpu import (
    backward_kernels,
    forward_kernels,
    geometry_kernels,
    sh_kernels,
    tile_kernels,
)
from wildgs.rasterize.cpu.reach_kernels import RECORD, TILE
from wildgs.rasterize.cpu.scratch import scratch
from wildgs.rasterize.cpu.threads import announce_compilation, launch, thread_count
from wildgs.rasterize.interface import Projection, Rendering

GROUP = geometry_kernels.GROUP
_SUM_CHUNK = 1024


@dataclass(frozen=True)
class TileLists:
    """What blending needs to know of the geometry; arrays are flat.

    Gaussians that reach the picture are numbered by rank, so that neighbours in the picture are neighbours in memory.

    Attributes:
        ranks: Each Gaussian's rank; -1 where it reaches no tile.
        homes: Each rank's Gaussian.
        records: Per rank what blending reads, eight floats (see `reach_kernels.RECORD`).
        starts: First slot of each rank's (tile, Gaussian) pairs, and the number of pairs.
        offsets: Where each tile's list starts in `ids`; one more than there are tiles.
        ids: Ranks, tile by tile, nearest first.
        slots: Of each entry of `ids`: its slot among the rank's pairs.
        tile_order: Tiles with long lists first, so that threads end together.
    """

    ranks: np.ndarray
    homes: np.ndarray
    records: np.ndarray
    starts: np.ndarray
    offsets: np.ndarray
    ids: np.ndarray
    slots: np.ndarray
    tile_order: np.ndarray


@dataclass(frozen=True)
class _Lens:
    """A camera as the kernels take it."""

    view: np.ndarray
    lens: np.ndarray
    width: int
    height: int

    @staticmethod
    def of(camera: Camera) -> _Lens:
        K = camera.K.detach().to("cpu", torch.float32)
        view = camera.viewmat.detach().to("cpu", torch.float32)[:3].contiguous().numpy().reshape(-1)
        lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
        return _Lens(view, lens, camera.width, camera.height)

    def arguments(self) -> tuple[Any, ...]:
        return self.view, self.lens, np.float32(self.width), np.float32(self.height)


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy().reshape(-1)


def _padded(tensor: Tensor) -> Tensor:
    """At least sixteen rows, which the vector kernels need; the rows added are zero and hence culled."""
    missing = GROUP - len(tensor)
    return tensor if missing <= 0 else torch.cat([tensor, tensor.new_zeros(missing, *tensor.shape[1:])])


def _first(tensor: Tensor, n: int) -> Tensor:
    """Undoes `_padded`; the tensor itself where nothing was added, as slicing costs a copy in the backward pass."""
    return tensor if len(tensor) == n else tensor[:n]


class _Project(torch.autograd.Function):
    """Hands out what the projection kernel wrote; its backward pass is `project_backward`."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        lens: _Lens,
        outputs: Any,
    ) -> Any:
        means2d, depths, conics, radii = outputs
        ctx.save_for_backward(means, quats, scales, radii)
        ctx.lens = lens
        return means2d, depths, conics

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        v_means2d, v_depths, v_conics = grads
        means, quats, scales, radii = ctx.saved_tensors
        outputs = (
            torch.empty_like(means),
            torch.empty_like(quats),
            torch.empty_like(scales),
        )
        launch(
            geometry_kernels.project_backward,
            *map(_flat, (means, quats, scales)),
            *ctx.lens.arguments(),
            *map(_flat, (radii, v_means2d, v_depths, v_conics)),
            *map(_flat, outputs),
            items=_chunks(len(means)),
        )
        return *outputs, None, None


def _chunks(count: int) -> int:
    return -(-count // (GROUP * geometry_kernels.CHUNK))


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    camera: Camera,
    near: float,
    absgrad: bool,
) -> Projection:
    """See `wildgs.rasterize.project`."""
    n = len(means)
    means_, quats_, scales_, opacities_ = (_padded(t).contiguous() for t in (means, quats, scales, opacities))
    lens = _Lens.of(camera)
    count = len(means_)
    means2d, depths = torch.empty(count, 2), torch.empty(count)
    conics, radii = torch.empty(count, 3), torch.empty(count, dtype=torch.int32)
    tile_counts = np.empty(count, np.int32)
    with (
        scratch("records", count * RECORD, np.float32) as records,
        scratch("boxes", 4 * count, np.int16) as boxes,
        scratch("masks", count, np.int32) as masks,
    ):
        launch(
            geometry_kernels.project_forward,
            *map(_flat, (means_, quats_, scales_, opacities_)),
            *lens.arguments(),
            np.float32(near),
            *map(_flat, (means2d, depths, conics, radii)),
            records, boxes, masks, tile_counts,
            items=_chunks(count),
        )  # fmt: skip
        tiles = _list_tiles(depths.numpy(), records, boxes, masks, tile_counts, camera)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (means_, quats_, scales_)):
        outputs = (means2d, depths, conics, radii)
        means2d, depths, conics = _Project.apply(means_, quats_, scales_, lens, outputs)  # type: ignore[misc]
    return Projection(
        camera=camera,
        means2d=_first(means2d, n),
        depths=_first(depths, n),
        conics=_first(conics, n),
        opacities=opacities,
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
    camera: Camera,
) -> TileLists:
    """Ranks the Gaussians and lists each tile's, nearest first (see `tile_kernels`)."""
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    n = tile_counts.size
    seen = int(np.count_nonzero(tile_counts))
    ranks, homes = np.empty(n, np.int32), np.empty(seen, np.int32)
    ranked_records, starts = (
        np.empty(seen * RECORD, np.float32),
        np.empty(seen + 1, np.int64),
    )
    offsets = np.empty(tiles_x * tiles_y + 1, np.int64)
    chunks = max(1, min(2 * thread_count(), n // 1024))
    with (
        scratch("cursors", chunks * tiles_x * tiles_y, np.int64) as flat,
        scratch("spans", 4 * seen, np.int32) as spans,
        scratch("keys", 2 * seen, np.uint32) as keys,
        scratch("order", 2 * seen, np.int32) as order,
    ):
        cursors = flat.reshape(chunks, -1)
        launch(tile_kernels.count_homes, tile_counts, boxes, tiles_x, cursors, items=chunks)
        _serial(tile_kernels.place_chunks, cursors, offsets)
        launch(
            tile_kernels.move_home,
            tile_counts, boxes, masks, records, tiles_x, cursors, ranks, homes, ranked_records, spans,
            items=chunks,
        )  # fmt: skip
        pairs = _serial(tile_kernels.number_slots, spans, starts)
        order = _serial(
            tile_kernels.sort_by_depth, depths, ranks, keys[:seen], order[:seen], keys[seen:], order[seen:]
        )  # fmt: skip
        launch(
            tile_kernels.count_pairs,
            order,
            spans,
            ranked_records,
            tiles_x,
            cursors,
            items=chunks,
        )
        _serial(tile_kernels.place_chunks, cursors, offsets)
        ids, slots = np.empty(pairs, np.int32), np.empty(pairs, np.int64)
        launch(
            tile_kernels.write_pairs, order, spans, ranked_records, starts, tiles_x, cursors, ids, slots, items=chunks
        )  # fmt: skip
    # In powers of two of the length: within one, neighbouring tiles follow each other and share what is in the cache.
    tile_order = np.argsort(-np.frexp(np.diff(offsets))[1], kind="stable")
    return TileLists(ranks, homes, ranked_records, starts, offsets, ids, slots, tile_order)


def _serial(kernel: Any, *arguments: Any) -> Any:
    return kernel(*arguments) if kernel.signatures else announce_compilation(kernel, *arguments)


class _Blend(torch.autograd.Function):
    """Blending with the bookkeeping that its gradient needs."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        opacities: Tensor,
        colors: Tensor,
        background: Tensor,
        projection: Projection,
        with_depth: bool,
    ) -> Any:
        tiles: TileLists = projection.tiles
        pictures = _blend_pictures(projection, colors, background, with_depth, bookkeeping=True)
        out_colors, out_depth, out_alpha, transmittance, last = pictures
        ctx.save_for_backward(conics, depths, opacities, colors, background, out_depth, out_alpha)
        ctx.tiles, ctx.camera, ctx.absgrad = (
            tiles,
            projection.camera,
            projection.absgrad,
        )
        ctx.transmittance, ctx.last, ctx.with_depth = transmittance, last, with_depth
        return out_colors, out_depth, out_alpha

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        v_colors, v_depth, v_alpha = grads
        conics, depths, opacities, colors, background, out_depth, out_alpha = ctx.saved_tensors
        tiles: TileLists = ctx.tiles
        n, channels = colors.shape
        # Rows are padded to whole vectors.
        stride = -(-(backward_kernels.ROW_COLORS + channels) // 16) * 16
        v_means2d, v_conics = torch.empty(n, 2), torch.empty(n, 3)
        v_opacities, v_depths, v_values = (
            torch.empty(n),
            torch.empty(n),
            torch.empty(n, channels),
        )
        absgrad = None if ctx.absgrad is None else _flat(ctx.absgrad)
        with scratch("rows", tiles.ids.size * stride, np.float32) as rows:
            launch(
                backward_kernels.blend_backward,
                tiles.tile_order, tiles.offsets, tiles.ids, tiles.slots, tiles.records,
                _rank_values(tiles, depths, colors), channels, ctx.with_depth, _flat(background),
                ctx.camera.width, ctx.camera.height, ctx.transmittance, ctx.last, _flat(out_depth), _flat(out_alpha),
                _flat(v_colors), _flat(v_depth), _flat(v_alpha), stride, rows, absgrad is not None,
            )  # fmt: skip
            launch(
                backward_kernels.sum_rows,
                _SUM_CHUNK, tiles.ranks, tiles.starts, stride, rows, channels, _flat(conics), _flat(opacities),
                *map(_flat, (v_means2d, v_conics, v_opacities, v_depths, v_values)), absgrad,
                items=-(-n // _SUM_CHUNK),
            )  # fmt: skip
        v_background = None
        if ctx.needs_input_grad[5]:
            v_background = ((1 - out_alpha)[..., None] * v_colors).sum((0, 1))
        return (
            v_means2d,
            v_conics,
            v_depths,
            v_opacities,
            v_values,
            v_background,
            None,
            None,
        )


def _rank_values(tiles: TileLists, depths: Tensor, colors: Tensor) -> np.ndarray:
    """Depths and colours in the order of ranks."""
    values = np.empty(tiles.homes.size * (colors.shape[1] + 1), np.float32)
    launch(
        tile_kernels.rank_values,
        _SUM_CHUNK, tiles.homes, _flat(depths), _flat(colors), colors.shape[1], values,
        items=-(-tiles.homes.size // _SUM_CHUNK),
    )  # fmt: skip
    return values


def _blend_pictures(
    projection: Projection,
    colors: Tensor,
    background: Tensor,
    with_depth: bool,
    bookkeeping: bool,
) -> Any:
    """Runs the forward kernel; gives colours, depth, alpha, final transmittance and last positions."""
    tiles: TileLists = projection.tiles
    width, height = projection.camera.width, projection.camera.height
    channels = colors.shape[1]
    values = _rank_values(tiles, projection.depths, colors)
    out_colors = torch.empty(height, width, channels)
    out_depth = torch.empty(height, width) if with_depth else torch.zeros(())
    out_alpha = torch.empty(height, width)
    size = (tiles.offsets.size - 1) * TILE * TILE
    transmittance = np.empty(size, np.float32) if bookkeeping else None
    last = np.empty(size, np.float32) if bookkeeping else None
    launch(
        forward_kernels.blend_forward,
        tiles.tile_order, tiles.offsets, tiles.ids, tiles.records,
        values, channels, with_depth, _flat(background),
        width, height, _flat(out_colors), _flat(out_depth), _flat(out_alpha), transmittance, last,
    )  # fmt: skip
    if not with_depth:
        out_depth = out_depth.expand(height, width)
    return out_colors, out_depth, out_alpha, transmittance, last


def blend(
    projection: Projection,
    colors: Float[Tensor, "N C"],
    background: Float[Tensor, "C"] | None,
    depth: bool,
) -> Rendering:
    """See `wildgs.rasterize.blend`."""
    if background is None:
        background = colors.new_zeros(colors.shape[1])
    geometry = (
        projection.means2d,
        projection.conics,
        projection.depths,
        projection.opacities,
    )
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*geometry, colors, background)):
        pictures = _Blend.apply(*geometry, colors, background, projection, depth)
    else:
        pictures = _blend_pictures(projection, colors, background, depth, bookkeeping=False)[:3]
    return Rendering(*pictures)  # type: ignore[misc]


class _Shade(torch.autograd.Function):
    """Spherical harmonics of visible Gaussians."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        sh: Tensor,
        eye: np.ndarray,
        degree: int,
        visible: np.ndarray,
    ) -> Any:
        out = torch.empty(len(means), 3)
        launch(
            sh_kernels.shade_forward,
            _flat(means), _flat(sh), sh.shape[1], degree, eye, visible, _flat(out),
            items=-(-len(means) // sh_kernels.CHUNK),
        )  # fmt: skip
        ctx.save_for_backward(means, sh, out)
        ctx.rest = eye, degree, visible
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        means, sh, out = ctx.saved_tensors
        eye, degree, visible = ctx.rest
        v_sh = torch.empty_like(sh, memory_format=torch.contiguous_format)
        v_means = (
            torch.empty_like(means, memory_format=torch.contiguous_format)
            if ctx.needs_input_grad[0]
            else None
        )
        launch(
            sh_kernels.shade_backward,
            _flat(means), _flat(sh), sh.shape[1], degree, eye, visible, _flat(out), _flat(grads[0]),
            _flat(v_sh), None if v_means is None else _flat(v_means),
            items=-(-len(means) // sh_kernels.CHUNK),
        )  # fmt: skip
        return v_means, v_sh, None, None, None


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    degree: int,
    visible: Bool[Tensor, "N"] | None,
) -> Float[Tensor, "N 3"]:
    """See `wildgs.rasterize.sh_to_colors`."""
    if visible is None:
        visible = torch.ones(len(means), dtype=torch.bool)
    eye = _flat(camera.position.detach().to("cpu", torch.float32))
    return _Shade.apply(means, sh, eye, degree, _flat(visible))  # type: ignore[return-value]
