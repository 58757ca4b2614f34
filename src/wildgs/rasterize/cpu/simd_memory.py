"""Loads, stores and prefetches of Numba (njit) kernels that compute with `simd` vectors."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from wildgs.rasterize.cpu.simd import INT_VECTOR, LANES, VECTOR, VECTOR_IR, splat_ir


def element_pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, offset: Any) -> ir.Value:
    """The address of an array's flat element, in LLVM's terms."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [offset])


def _flat_float_array(kind: types.Type) -> bool:
    return isinstance(kind, types.Array) and kind.layout == "C" and kind.dtype == types.float32


@intrinsic
def vload(typingctx, array, offset):
    """Sixteen floats from a C-contiguous float32 array, from flat element `offset` on."""
    if not (_flat_float_array(array) and isinstance(offset, types.Integer)):
        return None

    def codegen(context, builder, sig, args):
        offset = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer = element_pointer(context, builder, sig.args[0], args[0], offset)
        return builder.load(builder.bitcast(pointer, VECTOR_IR.as_pointer()), align=4)

    return VECTOR(array, offset), codegen


@intrinsic
def vstore(typingctx, array, offset, value):
    """Writes sixteen floats to a C-contiguous float32 array, from flat element `offset` on."""
    if not (_flat_float_array(array) and isinstance(offset, types.Integer) and value is VECTOR):
        return None

    def codegen(context, builder, sig, args):
        offset = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer = element_pointer(context, builder, sig.args[0], args[0], offset)
        builder.store(args[2], builder.bitcast(pointer, VECTOR_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, offset, value), codegen


@intrinsic
def vspread(typingctx, array, offset):
    """The flat element `offset` of a C-contiguous float32 array in every lane; `offset` is not negative."""
    if not (_flat_float_array(array) and isinstance(offset, types.Integer)):
        return None

    def codegen(context, builder, sig, args):
        offset = context.cast(builder, args[1], sig.args[1], types.intp)
        return splat_ir(
            builder, builder.load(element_pointer(context, builder, sig.args[0], args[0], offset))
        )

    return VECTOR(array, offset), codegen


@intrinsic
def byte_bits(typingctx, array, offset, bit):
    """Which of 64 bytes of a uint8 array (C-contiguous), from element `offset` on, have bit `bit` set, as bits."""
    if not (isinstance(array, types.Array) and array.layout == "C" and array.dtype == types.uint8):
        return None
    kind = ir.VectorType(ir.IntType(8), 64)

    def codegen(context, builder, sig, args):
        offset, bit = (context.cast(builder, args[i], sig.args[i], types.intp) for i in (1, 2))
        pointer = element_pointer(context, builder, sig.args[0], args[0], offset)
        numbers = builder.load(builder.bitcast(pointer, kind.as_pointer()), align=1)
        one = builder.shl(ir.Constant(ir.IntType(8), 1), builder.trunc(bit, ir.IntType(8)))
        undefined = ir.Constant(kind, ir.Undefined)
        wanted = builder.insert_element(undefined, one, ir.Constant(ir.IntType(32), 0))
        wanted = builder.shuffle_vector(
            wanted, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 64), [0] * 64)
        )
        zero = ir.Constant(kind, [0] * 64)
        mask = builder.icmp_unsigned("!=", builder.and_(numbers, wanted), zero)
        return builder.bitcast(mask, ir.IntType(64))

    return types.int64(array, offset, bit), codegen


def _copier(count: int) -> Any:
    def typing(typingctx, to, to_offset, source, offset):
        if not (_flat_float_array(to) and _flat_float_array(source)):
            return None
        kind = ir.VectorType(ir.FloatType(), count).as_pointer()

        def codegen(context, builder, sig, args):
            places = []
            for i in (0, 2):
                offset = context.cast(builder, args[i + 1], sig.args[i + 1], types.intp)
                place = element_pointer(context, builder, sig.args[i], args[i], offset)
                places.append(builder.bitcast(place, kind))
            builder.store(builder.load(places[1], align=4), places[0], align=4)
            return context.get_dummy_value()

        return types.void(to, to_offset, source, offset), codegen

    return intrinsic(typing)


# Moves 4 or 8 floats between C-contiguous float32 arrays: (to, flat element there, source, flat element there).
copy4, copy8 = _copier(4), _copier(8)


def _prefetcher(to_write: int) -> Any:
    def typing(typingctx, array, offset):
        if not (isinstance(array, types.Array) and array.layout == "C" and isinstance(offset, types.Integer)):
            return None

        def codegen(context, builder, sig, args):
            offset = context.cast(builder, args[1], sig.args[1], types.intp)
            pointer = element_pointer(context, builder, sig.args[0], args[0], offset)
            byte_pointer = ir.IntType(8).as_pointer()
            int32 = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [byte_pointer, int32, int32, int32])
            function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            hints = [ir.Constant(int32, number) for number in (to_write, 3, 1)]  # keep in all caches, data
            builder.call(function, [builder.bitcast(pointer, byte_pointer), *hints])
            return context.get_dummy_value()

        return types.void(array, offset), codegen

    return intrinsic(typing)


# Ask for the cache line of a C-contiguous array's flat element `offset`, to read or to write; any offset is safe.
prefetch, prefetch_to_write = _prefetcher(0), _prefetcher(1)


def _columns_loader(count: int) -> Any:
    def typing(typingctx, array, offset):
        if not _flat_float_array(array):
            return None
        result = types.UniTuple(VECTOR, count)

        def codegen(context, builder, sig, args):
            offset = context.cast(builder, args[1], sig.args[1], types.intp)
            base = element_pointer(context, builder, sig.args[0], args[0], offset)
            base = builder.bitcast(base, VECTOR_IR.as_pointer())
            steps = [ir.Constant(ir.IntType(64), i) for i in range(count)]
            vectors = [builder.load(builder.gep(base, [step]), align=4) for step in steps]
            columns = [
                _pick(builder, vectors, [lane * count + c for lane in range(LANES)]) for c in range(count)
            ]
            return context.make_tuple(builder, result, columns)

        return result(array, offset), codegen

    return intrinsic(typing)


def _columns_storer(count: int) -> Any:
    def typing(typingctx, array, offset, columns):
        if not (_flat_float_array(array) and columns == types.UniTuple(VECTOR, count)):
            return None

        def codegen(context, builder, sig, args):
            offset = context.cast(builder, args[1], sig.args[1], types.intp)
            base = element_pointer(context, builder, sig.args[0], args[0], offset)
            base = builder.bitcast(base, VECTOR_IR.as_pointer())
            columns = [builder.extract_value(args[2], i) for i in range(count)]
            for i in range(count):
                flat = [i * LANES + lane for lane in range(LANES)]
                vector = _pick(builder, columns, [(f % count) * LANES + f // count for f in flat])
                builder.store(vector, builder.gep(base, [ir.Constant(ir.IntType(64), i)]), align=4)
            return context.get_dummy_value()

        return types.void(array, offset, columns), codegen

    return intrinsic(typing)


def _pick(builder: ir.IRBuilder, vectors: list[ir.Value], sources: list[int]) -> ir.Value:
    """A vector whose lanes come from several others; one shuffle of two sources for each but the first."""
    result = vectors[0]
    for i in range(1, len(vectors)):
        numbers = []
        for lane, source in enumerate(sources):
            here = LANES + source % LANES if source // LANES == i else lane
            numbers.append(source % LANES if i == 1 and source < LANES else here)
        result = builder.shuffle_vector(result, vectors[i], ir.Constant(INT_VECTOR, numbers))
    return result


# Rows of 2, 3, 4 or 8 floats, sixteen rows at once, as one vector per column: from (to) flat element `offset` on.
vload2, vload3, vload4 = _columns_loader(2), _columns_loader(3), _columns_loader(4)
vstore2, vstore3, vstore4, vstore8 = (_columns_storer(count) for count in (2, 3, 4, 8))
