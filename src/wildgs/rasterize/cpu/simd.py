"""Sixteen floats at once inside Numba kernels: a vector type whose every operation is one LLVM vector instruction.

LLVM's loop vectoriser cannot be relied on for loops with early exits and masks. Kernels that hold their
values in this type are vectorised by construction: AVX-512 takes one register per value, AVX2 and NEON two
or four, with the same results. `F32x16` values live only inside compiled (njit) code.

Comparisons give masks; `select(mask, a, b)` chooses per lane. Scalars mix freely with vectors.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

LANES = 16
_FLOAT = ir.FloatType()
VECTOR_IR = ir.VectorType(_FLOAT, LANES)
INT_VECTOR = ir.VectorType(ir.IntType(32), LANES)
_MASK_VECTOR = ir.VectorType(ir.IntType(1), LANES)
# NaN and infinity keep their meaning: culling depends on comparisons with them being false. Nothing is fused or
# reordered behind the kernels' back (`fma` says where): a test gives the same answer wherever it is inlined.
_FLAGS = ("nsz",)


class _Vector(types.Type):
    def __init__(self) -> None:
        super().__init__(name="F32x16")


class _Mask(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Mask16")


VECTOR = _Vector()
MASK = _Mask()


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: types.Type) -> None:
        super().__init__(dmm, fe_type, VECTOR_IR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: types.Type) -> None:
        super().__init__(dmm, fe_type, _MASK_VECTOR)


def has_avx512() -> bool:
    """Whether kernels are compiled for a processor with AVX-512 (`NUMBA_CPU_FEATURES` overrides what it has)."""
    _, _, instructions = cpu_target.target_context.codegen().magic_tuple()
    return "+avx512dq" in instructions.split(",")


def splat_ir(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    """The vector with the same number in every lane, in LLVM's terms."""
    one = builder.insert_element(ir.Constant(VECTOR_IR, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(
        one, ir.Constant(VECTOR_IR, ir.Undefined), ir.Constant(INT_VECTOR, [0] * LANES)
    )


def _as_vector(context: Any, builder: ir.IRBuilder, value: ir.Value, kind: types.Type) -> ir.Value:
    if kind is VECTOR:
        return value
    return splat_ir(builder, context.cast(builder, value, kind, types.float32))


def _constant(numbers: list[float]) -> ir.Constant:
    return ir.Constant(VECTOR_IR, numbers)


def _is_operand(kind: types.Type) -> bool:
    return kind is VECTOR or isinstance(kind, types.Float | types.Integer)


def _binary(op: Any, result: types.Type, emit: Any) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and VECTOR in args and all(_is_operand(a) for a in args):
                return signature(result, *args)
            return None

    infer_global(op)(Template)

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        a, b = (_as_vector(context, builder, v, k) for v, k in zip(args, sig.args, strict=True))
        return emit(builder, a, b)

    for left, right in ((VECTOR, VECTOR), (VECTOR, types.Float), (types.Float, VECTOR)):
        lower_builtin(op, left, right)(lower)
    for left, right in ((VECTOR, types.Integer), (types.Integer, VECTOR)):
        lower_builtin(op, left, right)(lower)


_binary(operator.add, VECTOR, lambda b, x, y: b.fadd(x, y, flags=_FLAGS))
_binary(operator.sub, VECTOR, lambda b, x, y: b.fsub(x, y, flags=_FLAGS))
_binary(operator.mul, VECTOR, lambda b, x, y: b.fmul(x, y, flags=_FLAGS))
_binary(operator.truediv, VECTOR, lambda b, x, y: b.fdiv(x, y, flags=_FLAGS))
for _op, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _binary(_op, MASK, lambda b, x, y, sign=_sign: b.fcmp_ordered(sign, x, y))


def _mask_binary(op: Any, emit: Any) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(MASK, MASK, MASK) if args == (MASK, MASK) else None

    infer_global(op)(Template)
    lower_builtin(op, MASK, MASK)(lambda context, builder, sig, args: emit(builder, *args))


_mask_binary(operator.and_, lambda b, x, y: b.and_(x, y))
_mask_binary(operator.or_, lambda b, x, y: b.or_(x, y))


@infer_global(operator.neg)
class _Negate(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(VECTOR, VECTOR) if args == (VECTOR,) else None


@lower_builtin(operator.neg, VECTOR)
def _lower_negate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    return builder.fsub(_constant([-0.0] * LANES), args[0], flags=_FLAGS)


@infer_global(operator.invert)
class _Invert(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(MASK, MASK) if args == (MASK,) else None


@lower_builtin(operator.invert, MASK)
def _lower_invert(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    return builder.not_(args[0])


@intrinsic
def splat(typingctx, scalar):
    """The same number in every lane."""
    if not isinstance(scalar, types.Float | types.Integer):
        return None

    def codegen(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0])

    return VECTOR(scalar), codegen


@intrinsic
def lane_x(typingctx):
    """Column of each lane in a 4 x 4 block: 0 1 2 3 0 1 2 3 ..."""
    numbers = [float(i % 4) for i in range(LANES)]
    return VECTOR(), lambda context, builder, sig, args: _constant(numbers)


@intrinsic
def lane_y(typingctx):
    """Row of each lane in a 4 x 4 block: 0 0 0 0 1 1 1 1 ..."""
    numbers = [float(i // 4) for i in range(LANES)]
    return VECTOR(), lambda context, builder, sig, args: _constant(numbers)


@intrinsic
def select(typingctx, mask, a, b):
    """`a` where the mask is set, else `b`."""
    if mask is not MASK or not (_is_operand(a) and _is_operand(b)):
        return None

    def codegen(context, builder, sig, args):
        a, b = (_as_vector(context, builder, args[i], sig.args[i]) for i in (1, 2))
        return builder.select(args[0], a, b)

    return VECTOR(mask, a, b), codegen


def _extremum(sign: str) -> Any:
    def typing(typingctx, a, b):
        if not (_is_operand(a) and _is_operand(b)):
            return None

        def codegen(context, builder, sig, args):
            a, b = (_as_vector(context, builder, v, k) for v, k in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(sign, a, b), a, b)

        return VECTOR(a, b), codegen

    return typing


vmin = intrinsic(_extremum("<"))
vmax = intrinsic(_extremum(">"))


def _call_vector_intrinsic(builder: ir.IRBuilder, name: str, *values: ir.Value) -> ir.Value:
    kind = ir.FunctionType(VECTOR_IR, [VECTOR_IR] * len(values))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, values)


def fused_ir(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    """A * b + c for vectors, in LLVM's terms."""
    return _call_vector_intrinsic(builder, "fmuladd", a, b, c)


@intrinsic
def fma(typingctx, a, b, c):
    """A * b + c, in one instruction where the processor has it."""
    if not all(_is_operand(kind) for kind in (a, b, c)):
        return None

    def codegen(context, builder, sig, args):
        vectors = [_as_vector(context, builder, v, k) for v, k in zip(args, sig.args, strict=True)]
        return fused_ir(builder, *vectors)

    return VECTOR(a, b, c), codegen


@intrinsic
def vsqrt(typingctx, value):
    """Square root per lane."""

    def codegen(context, builder, sig, args):
        return _call_vector_intrinsic(builder, "sqrt", args[0])

    return (VECTOR(value), codegen) if value is VECTOR else None


@intrinsic
def mask_bits(typingctx, mask):
    """The mask as an integer: bit i is lane i."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(16)), ir.IntType(64))

    return (types.int64(mask), codegen) if mask is MASK else None


@intrinsic
def lowest_bit(typingctx, bits):
    """Index of the lowest set bit of a positive integer."""

    def codegen(context, builder, sig, args):
        value = context.cast(builder, args[0], sig.args[0], types.int64)
        return builder.cttz(value, ir.Constant(ir.IntType(1), 1))

    return (types.int64(bits), codegen) if isinstance(bits, types.Integer) else None


@intrinsic
def vratio(typingctx, a, b):
    """A / b per lane, for normal b; by an estimate of 1 / b and one Newton step where the processor has estimates.

    A division of sixteen floats occupies the divider for 10 cycles or more. The error is at most two units in the
    last place.
    """

    def codegen(context, builder, sig, args):
        return builder.fdiv(args[0], args[1], flags=("nsz", "arcp", "contract", "reassoc", "nnan", "ninf"))

    return (VECTOR(a, b), codegen) if a is VECTOR and b is VECTOR else None


# exp2 on [-0.5, 0.5], minimax of degree 4, relative error 2.6e-6, a thousandth of what 8 bits resolve. A further
# degree makes blending 3% slower. The second is the same on [0, 1].
_EXP2 = (9.57010199e-3, 5.59178606e-2, 0.240247448, 0.693121815, 0.999999261)
_EXP2_ABOVE = (0.0135341678, 0.0520114601, 0.241442755, 0.693003833, 1.00000262)


@intrinsic
def vexp2(typingctx, value):
    """2 to the power of each lane, for lanes in [-125, 0]; relative error about 3e-6.

    AVX-512 has instructions for the fractional part of a number and for scaling by powers of two.
    """

    def codegen(context, builder, sig, args):
        return (_scaled_exp2 if has_avx512() else _shifted_exp2)(builder, args[0])

    return (VECTOR(value), codegen) if value is VECTOR else None


def _polynomial(builder: ir.IRBuilder, x: ir.Value, coefficients: tuple[float, ...]) -> ir.Value:
    result, *others = (_constant([c] * LANES) for c in coefficients)
    for coefficient in others:
        result = fused_ir(builder, result, x, coefficient)
    return result


def _shifted_exp2(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    # Added to 1.5 * 2^23, x is rounded to a whole number, which stands in the low bits of the sum.
    rounder = _constant([12582912.0] * LANES)
    rounded = builder.fadd(x, rounder)
    rest = builder.fsub(x, builder.fsub(rounded, rounder))
    whole = builder.bitcast(rounded, INT_VECTOR)
    power = _polynomial(builder, rest, _EXP2)
    shift = ir.Constant(INT_VECTOR, [23] * LANES)
    bits = builder.add(builder.bitcast(power, INT_VECTOR), builder.shl(whole, shift))
    return builder.bitcast(bits, VECTOR_IR)


def _scaled_exp2(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    int16, int32 = ir.IntType(16), ir.IntType(32)
    undefined, all_lanes = ir.Constant(VECTOR_IR, ir.Undefined), ir.Constant(int16, -1)
    below, current = (
        ir.Constant(int32, 1),
        ir.Constant(int32, 4),
    )  # what is left by floor; the rounding mode set

    def call(name: str, *values: ir.Value) -> ir.Value:
        arguments = [*values, undefined, all_lanes, current]
        kind = ir.FunctionType(VECTOR_IR, [value.type for value in arguments])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.avx512.mask.{name}.ps.512")
        return builder.call(function, arguments)

    return call("scalef", _polynomial(builder, call("reduce", x, below), _EXP2_ABOVE), x)


@intrinsic
def vlog2(typingctx, value):
    """Base 2 logarithm of each lane, for positive normal numbers; absolute error about 1e-7."""

    def codegen(context, builder, sig, args):
        def ints(number):
            return ir.Constant(INT_VECTOR, [number] * LANES)

        def floats(number):
            return _constant([number] * LANES)

        # x = 2^whole * mantissa with the mantissa in [sqrt(1/2), sqrt(2)), then the series of atanh.
        bits = builder.bitcast(args[0], INT_VECTOR)
        above = builder.sub(bits, ints(0x3F3504F3))
        whole = builder.ashr(above, ints(23))
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(whole, ints(23))), VECTOR_IR)
        ratio = builder.fdiv(builder.fsub(mantissa, floats(1.0)), builder.fadd(mantissa, floats(1.0)))
        square = builder.fmul(ratio, ratio)
        series = floats(1.0 / 9.0)
        for odd in (7.0, 5.0, 3.0, 1.0):
            series = fused_ir(builder, series, square, floats(1.0 / odd))
        logarithm = builder.fmul(builder.fmul(series, ratio), floats(2.8853900817779268))
        return builder.fadd(logarithm, builder.sitofp(whole, VECTOR_IR), flags=_FLAGS)

    return (VECTOR(value), codegen) if value is VECTOR else None


@intrinsic
def vfloor(typingctx, value):
    """The largest whole number that is not above, per lane."""

    def codegen(context, builder, sig, args):
        return _call_vector_intrinsic(builder, "floor", args[0])

    return (VECTOR(value), codegen) if value is VECTOR else None


# Where `lane_sums` puts its sums: as few of the tree's nodes as can be have one child alone.
SUM_LANES = (0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13)


@intrinsic
def lane_sums(typingctx, vectors):
    """Lane `SUM_LANES[i]` of the result is the sum over the lanes of `vectors[i]`, of at most 12."""
    if not (
        isinstance(vectors, types.UniTuple) and vectors.dtype is VECTOR and len(vectors) <= len(SUM_LANES)
    ):
        return None

    def codegen(context, builder, sig, args):
        level: list[ir.Value | None] = [None] * LANES
        for i in range(len(vectors)):
            level[SUM_LANES[i]] = builder.extract_value(args[0], i)
        # Fold halves of two vectors into one, four times: 12 additions in all instead of 12 full reductions.
        for half in (8, 4, 2, 1):
            count = len(level) // 2
            level = [_fold(builder, level[i], level[i + count], half) for i in range(count)]
        return level[0]

    return VECTOR(vectors), codegen


def _fold(builder: ir.IRBuilder, a: ir.Value | None, b: ir.Value | None, half: int) -> ir.Value | None:
    if a is None:
        return None
    if b is None:
        b = ir.Constant(VECTOR_IR, ir.Undefined)
    low, high = [], []
    for i in range(LANES):
        # Groups of `half` lanes alternate between a and b; each takes both halves of its double group.
        group, lane = divmod(i, half)
        source = (group // 2) * 2 * half + lane + (LANES if group % 2 else 0)
        low.append(source)
        high.append(source + half)
    masks = [ir.Constant(INT_VECTOR, numbers) for numbers in (low, high)]
    first, second = (builder.shuffle_vector(a, b, mask) for mask in masks)
    return builder.fadd(first, second, flags=_FLAGS)
