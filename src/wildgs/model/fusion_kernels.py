"""Numba (njit) kernels of the fusion network's layers and their gradients, on the rasteriser's vectors.

Rows (Gaussians) are taken in chunks whose activations stay in the fastest caches, from the first layer to the last.
The backward pass computes the activations again instead of storing them: that is cheaper than moving them through
memory. Matrices are row-major, with rows padded to whole vectors.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.picture_kernels import aligned
from wildgs.rasterize.cpu.simd import LANES, VECTOR_IR, fused_ir, select, splat_ir, vmax
from wildgs.rasterize.cpu.simd_memory import copy4, copy8, element_pointer, vload, vstore
from wildgs.threads import fetch_add

SIDE = 8  # rows of a product that are summed in registers at once, for up to three vectors of columns
CHUNK = 96  # rows whose activations are in the cache together
PART = 21 * CHUNK  # rows per work item, which has sums of the weights' gradients of its own


def _product(vectors: int) -> Any:
    """An intrinsic that computes ``C = S + A B`` for `SIDE` rows and some vectors of columns.

    The element of A in row q and column k is ``a[a0 + q * row + k * column]``, so that A may be transposed. Row k
    of B starts at ``b[b0 + k * width]``, row q of C at ``c[c0 + q * width]``, and that of S at
    ``s[s0 + q * s_width]``; S may be C.
    """

    def typing(typingctx, a, a0, row, column, depth, b, b0, s, s0, s_width, c, c0, width):
        kinds = (a, a0, row, column, depth, b, b0, s, s0, s_width, c, c0, width)

        def codegen(context, builder, sig, args):
            a, a0, row, column, depth, b, b0, s, s0, s_width, c, c0, width = (
                value if isinstance(kind, types.Array) else context.cast(builder, value, kind, types.intp)
                for value, kind in zip(args, kinds, strict=True)
            )

            def pointer(kind, array, offset, steps=0, step=None, more=0):
                if step is not None:
                    offset = builder.add(offset, builder.mul(step, ir.Constant(step.type, steps)))
                offset = builder.add(offset, ir.Constant(offset.type, more * LANES))
                return element_pointer(context, builder, kind, array, offset)

            def vector_at(*place):
                return builder.bitcast(pointer(*place), VECTOR_IR.as_pointer())

            places = [(q, v) for q in range(SIDE) for v in range(vectors)]
            sums = {}
            for q, v in places:
                start = builder.load(vector_at(kinds[7], s, s0, q, s_width, v), align=4)
                sums[q, v] = cgutils.alloca_once_value(builder, start)
            with cgutils.for_range(builder, depth) as loop:
                b_row = builder.add(b0, builder.mul(loop.index, width))
                columns = [
                    builder.load(vector_at(kinds[5], b, b_row, 0, None, v), align=4) for v in range(vectors)
                ]
                a_column = builder.add(a0, builder.mul(loop.index, column))
                for q in range(SIDE):
                    number = splat_ir(builder, builder.load(pointer(kinds[0], a, a_column, q, row)))
                    for v in range(vectors):
                        total = fused_ir(builder, number, columns[v], builder.load(sums[q, v]))
                        builder.store(total, sums[q, v])
            for q, v in places:
                builder.store(builder.load(sums[q, v]), vector_at(kinds[10], c, c0, q, width, v), align=4)
            return context.get_dummy_value()

        return types.void(*kinds), codegen

    return intrinsic(typing)


_one, _two, _three = (_product(vectors) for vectors in (1, 2, 3))


@njit(nogil=True)
def product(a, a0, row, column, depth, b, s, s0, s_width, c, c0, width):
    """``C = S + A B`` for `SIDE` rows and all columns; see `_product`."""
    at = 0
    while width - at >= 3 * LANES:
        _three(a, a0, row, column, depth, b, at, s, s0 + at, s_width, c, c0 + at, width)
        at += 3 * LANES
    if width - at >= 2 * LANES:
        _two(a, a0, row, column, depth, b, at, s, s0 + at, s_width, c, c0 + at, width)
    elif width - at >= LANES:
        _one(a, a0, row, column, depth, b, at, s, s0 + at, s_width, c, c0 + at, width)


@njit(nogil=True)
def layer(x, width, depth, weight, bias, out, columns):
    """``out = x W + bias`` for a chunk, with W [depth, columns] and one row of bias."""
    for first in range(0, CHUNK, SIDE):
        product(x, first * width, width, 1, depth, weight, bias, 0, 0, out, first * columns, columns)


@njit(nogil=True)
def add_layer(x, width, depth, weight, out, columns):
    """``out += x W`` for a chunk."""
    for first in range(0, CHUNK, SIDE):
        at = first * columns
        product(x, first * width, width, 1, depth, weight, out, at, columns, out, at, columns)


@njit(nogil=True)
def add_outer(delta, rows, x, columns, out):
    """``out += deltaᵀ x`` over the chunk's rows: the gradient of a weight matrix [rows, columns]."""
    for first in range(0, rows, SIDE):
        at = first * columns
        product(delta, first, 1, rows, CHUNK, x, out, at, columns, out, at, columns)


@njit(nogil=True)
def add_rows(delta, columns, out):
    """``out += delta`` summed over the chunk's rows: the gradient of a bias."""
    for at in range(0, columns, LANES):
        total = vload(out, at)
        for r in range(CHUNK):
            total = total + vload(delta, r * columns + at)
        vstore(out, at, total)


@njit(nogil=True)
def rectify(x):
    """Negative numbers become 0."""
    for at in range(0, x.size, LANES):
        vstore(x, at, vmax(0.0, vload(x, at)))  # in this order, NaN stays


@njit(nogil=True)
def close_gate(delta, hidden):
    """The gradient becomes 0 where the rectified number is."""
    for at in range(0, delta.size, LANES):
        vstore(delta, at, select(vload(hidden, at) <= 0.0, 0.0, vload(delta, at)))


@njit(nogil=True)
def read_rows(source, width, first, count, out, padded):
    """A chunk's rows, padded with zeros."""
    if count < CHUNK or padded > width:
        out[:] = 0.0
    if padded == width:
        out[: count * width] = source[first * width : (first + count) * width]
    elif width == 12:  # harmonics of degree 1
        for r in range(count):
            copy8(out, r * padded, source, (first + r) * 12)
            copy4(out, r * padded + 8, source, (first + r) * 12 + 8)
    else:
        for r in range(count):
            for k in range(width):
                out[r * padded + k] = source[(first + r) * width + k]


@njit(nogil=True)
def write_rows(source, padded, out, width, first, count):
    """The inverse of `read_rows`."""
    if padded == width:
        out[first * width : (first + count) * width] = source[: count * width]
    elif width == 12:
        for r in range(count):
            copy8(out, (first + r) * 12, source, r * padded)
            copy4(out, (first + r) * 12 + 8, source, r * padded + 8)
    else:
        for r in range(count):
            for k in range(width):
                out[(first + r) * width + k] = source[r * padded + k]


@njit(nogil=True)
def copy_row(source, at, out, to, width):
    """``out[to : to + width] = source[at : at + width]``."""
    k = 0
    while width - k >= LANES:
        vstore(out, to + k, vload(source, at + k))
        k += LANES
    while k < width:
        out[to + k] = source[at + k]
        k += 1


@njit(nogil=True)
def gather_rows(source, width, index, first, count, out, padded):
    """Like `read_rows` for the rows that `index` names; an empty one names all."""
    if index.size == 0:
        read_rows(source, width, first, count, out, padded)
        return
    if count < CHUNK or padded > width:
        out[:] = 0.0
    for r in range(count):
        copy_row(source, index[first + r] * width, out, r * padded, width)


@njit(nogil=True)
def scatter_rows(source, padded, out, width, index, first, count):
    """The inverse of `gather_rows`."""
    if index.size == 0:
        write_rows(source, padded, out, width, first, count)
        return
    for r in range(count):
        copy_row(source, r * padded, out, index[first + r] * width, width)


@njit(nogil=True)
def hidden_layers(x, padded_inputs, inputs, first, first_bias, second, second_bias, one, two, hidden):
    """The activations of both hidden layers for a chunk, into `one` and `two`."""
    layer(x, padded_inputs, inputs, first, first_bias, one, hidden)
    rectify(one)
    layer(one, hidden, hidden, second, second_bias, two, hidden)
    rectify(two)


@njit(nogil=True)
def layers_forward(counter, n, rows, index,
                   inputs, padded_inputs, hidden, outputs, padded_outputs, codes, padded_codes,
                   first, first_bias, second, second_bias, last, last_bias, direct, code_weights, zeros,
                   out, out_codes):  # fmt: skip
    """See `fused_layers.FusedLayers`, for the n rows of one region.

    Weights are transposed, [inputs, outputs]; `direct` is empty without D, `code_weights` without C.
    """
    x, one = aligned(CHUNK * padded_inputs), aligned(CHUNK * hidden)
    two, y = aligned(CHUNK * hidden), aligned(CHUNK * padded_outputs)
    z = aligned(CHUNK * padded_codes)
    while True:
        begin = fetch_add(counter, 1) * PART
        if begin >= n:
            break
        for at in range(begin, min(begin + PART, n), CHUNK):
            count = min(CHUNK, n - at)
            gather_rows(rows, inputs, index, at, count, x, padded_inputs)
            hidden_layers(x, padded_inputs, inputs, first, first_bias, second, second_bias, one, two, hidden)
            layer(two, hidden, hidden, last, last_bias, y, padded_outputs)
            if direct.size > 0:
                add_layer(x, padded_inputs, inputs, direct, y, padded_outputs)
            write_rows(y, padded_outputs, out, outputs, at, count)
            if code_weights.size > 0:
                layer(x, padded_inputs, inputs, code_weights, zeros, z, padded_codes)
                write_rows(z, padded_codes, out_codes, codes, at, count)


@njit(nogil=True)
def layers_backward(counter, n, rows, index, gradient, code_gradient,
                    inputs, padded_inputs, hidden, outputs, padded_outputs, codes, padded_codes,
                    first, first_bias, second, second_bias, first_back, second_back, last_back, direct_back,
                    code_back, zeros, by_rows, sums):  # fmt: skip
    """The gradients of `layers_forward`.

    Weights whose names end in `_back` are [outputs, inputs]. `sums` has a row per work item: the gradients of W1,
    b1, W2, b2, W3, b3, D and C, one after the other, padded; a work item is computed by one thread, in order.
    """
    x, one = aligned(CHUNK * padded_inputs), aligned(CHUNK * hidden)
    two, y = aligned(CHUNK * hidden), aligned(CHUNK * padded_outputs)
    of_one, of_two = aligned(CHUNK * hidden), aligned(CHUNK * hidden)
    of_x, z = aligned(CHUNK * padded_inputs), aligned(CHUNK * padded_codes)
    while True:
        item = fetch_add(counter, 1)
        begin = item * PART
        if begin >= n:
            break
        total = sums[item]
        total[:] = 0.0
        to = 0
        by_first = total[to : to + hidden * padded_inputs]
        to += by_first.size
        by_first_bias = total[to : to + hidden]
        to += hidden
        by_second = total[to : to + hidden * hidden]
        to += by_second.size
        by_second_bias = total[to : to + hidden]
        to += hidden
        by_last = total[to : to + padded_outputs * hidden]
        to += by_last.size
        by_last_bias = total[to : to + padded_outputs]
        to += padded_outputs
        by_direct = total[to : to + padded_outputs * padded_inputs]
        to += by_direct.size
        by_codes = total[to : to + padded_codes * padded_inputs]
        for at in range(begin, min(begin + PART, n), CHUNK):
            count = min(CHUNK, n - at)
            gather_rows(rows, inputs, index, at, count, x, padded_inputs)
            read_rows(gradient, outputs, at, count, y, padded_outputs)
            hidden_layers(x, padded_inputs, inputs, first, first_bias, second, second_bias, one, two, hidden)
            layer(y, padded_outputs, outputs, last_back, zeros, of_two, hidden)
            close_gate(of_two, two)
            layer(of_two, hidden, hidden, second_back, zeros, of_one, hidden)
            close_gate(of_one, one)
            layer(of_one, hidden, hidden, first_back, zeros, of_x, padded_inputs)
            if direct_back.size > 0:
                add_layer(y, padded_outputs, outputs, direct_back, of_x, padded_inputs)
                add_outer(y, padded_outputs, x, padded_inputs, by_direct)
            if code_back.size > 0:
                read_rows(code_gradient, codes, at, count, z, padded_codes)
                add_layer(z, padded_codes, codes, code_back, of_x, padded_inputs)
                add_outer(z, padded_codes, x, padded_inputs, by_codes)
            add_outer(of_one, hidden, x, padded_inputs, by_first)
            add_rows(of_one, hidden, by_first_bias)
            add_outer(of_two, hidden, one, hidden, by_second)
            add_rows(of_two, hidden, by_second_bias)
            add_outer(y, padded_outputs, two, hidden, by_last)
            add_rows(y, padded_outputs, by_last_bias)
            scatter_rows(of_x, padded_inputs, by_rows, inputs, index, at, count)
