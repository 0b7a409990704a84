"""SIMD vectors of 16 float32 for numba: a row of a tile's pixels goes through the processor at once.

Numba leaves vectorization to LLVM, which does not vectorize a loop with branches, stores and a recurrence. Here a
vector is a type (``Lanes``) with operators, so that nothing has to be detected. The operations are those of IEEE 754 in
a fixed order: every processor gives the same bits, whatever the width of its registers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types
from numba.extending import models, overload, register_model

# Decorated functions are called without their first parameter, the context, which type checkers cannot know: Any.
intrinsic: Any = extending.intrinsic

WIDTH = 16
"""Numbers in one vector."""

FLOAT, INT, BOOL = ir.FloatType(), ir.IntType(32), ir.IntType(1)
FLOATS, INTS, BOOLS = (ir.VectorType(kind, WIDTH) for kind in (FLOAT, INT, BOOL))
EXP2_TERMS = np.polynomial.Chebyshev.interpolate(np.exp2, 5, [-0.5, 0.5]).convert(kind=np.polynomial.Polynomial).coef
"""Coefficients of a polynomial in f, constant first, that is 2^f on [-1/2, 1/2] to the precision of float32."""


class Lanes(types.Type):
    """The numba type of WIDTH float32."""


class Truths(types.Type):
    """The numba type of WIDTH booleans, the result of comparing Lanes."""


LANES, TRUTHS = Lanes("Lanes"), Truths("Truths")
# Their values are LLVM vectors, held in registers.
register_model(Lanes)(partial(models.PrimitiveModel, be_type=FLOATS))
register_model(Truths)(partial(models.PrimitiveModel, be_type=BOOLS))


def _operator(
    symbol: Callable[..., Any], operands: types.Type, result: types.Type, instruction: str, *how: str
) -> None:
    """Define an operator on two values of a type by one LLVM instruction."""

    @intrinsic
    def apply(context: Any, left: Any, right: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, instruction)(*how, *arguments)

        return result(operands, operands), generate

    @overload(symbol)
    def of(left, right):  # noqa: ANN001, ANN202
        if left is operands and right is operands:
            return lambda left, right: apply(left, right)
        return None  # other types: numba's own operator


_operator(operator.add, LANES, LANES, "fadd")
_operator(operator.sub, LANES, LANES, "fsub")
_operator(operator.mul, LANES, LANES, "fmul")
_operator(operator.gt, LANES, TRUTHS, "fcmp_ordered", ">")
_operator(operator.ge, LANES, TRUTHS, "fcmp_ordered", ">=")


def _all(value: float, vector: ir.VectorType = FLOATS) -> ir.Constant:
    """A constant with one value in every lane; floats are rounded to float32."""
    return ir.Constant(vector, [float(np.float32(value)) if vector is FLOATS else value] * WIDTH)


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Where WIDTH elements of an array begin, as a pointer to a vector."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), FLOATS.as_pointer())


@intrinsic
def broadcast(context: Any, number: Any) -> Any:
    """Lanes that all hold one float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # LLVM's idiom for a broadcast: put into the first lane, then every lane takes lane 0.
        undefined = ir.Constant(FLOATS, ir.Undefined)
        first = builder.insert_element(undefined, arguments[0], ir.Constant(INT, 0))
        return builder.shuffle_vector(first, undefined, _all(0, INTS))

    return LANES(types.float32), generate


@intrinsic
def iota(context: Any) -> Any:
    """Lanes 0, 1, 2, ..."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(FLOATS, [float(lane) for lane in range(WIDTH)])

    return LANES(), generate


@intrinsic
def load(context: Any, array: Any, index: Any) -> Any:
    """Lanes from WIDTH elements of a float32 array, the first of them at ``index``, which nothing checks."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # Arrays are aligned to their float32 elements, not to whole vectors.
        return builder.load(_address(context, builder, signature.args[0], *arguments), align=4)

    return LANES(array, types.intp), generate


@intrinsic
def store(context: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Write Lanes where `load` would read them."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], target).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@intrinsic
def select(context: Any, condition: Any, yes: Any, no: Any) -> Any:
    """Each lane from ``yes`` where the condition holds, else from ``no``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return LANES(TRUTHS, LANES, LANES), generate


@intrinsic
def minimum(context: Any, left: Any, right: Any) -> Any:
    """The minimum of two values in each lane; ``right`` where one is NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return LANES(LANES, LANES), generate


@intrinsic
def any_of(context: Any, condition: Any) -> Any:
    """Whether the condition holds in any lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(TRUTHS), generate


@intrinsic
def exp2(context: Any, lanes: Any) -> Any:
    """2 to the power of each lane, which must lie in [-126, 0.5]; to 3e-7 of the value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # 2^z = 2^i 2^f: cutting z - 1/2 <= 0 towards zero gives the nearest integer i, which becomes the exponent.
        whole = builder.fptosi(builder.fsub(arguments[0], _all(0.5)), INTS)
        rest = builder.fsub(arguments[0], builder.sitofp(whole, FLOATS))
        square = builder.fmul(rest, rest)
        pairs = [builder.fadd(_all(EXP2_TERMS[k]), builder.fmul(_all(EXP2_TERMS[k + 1]), rest)) for k in (0, 2, 4)]
        # In pairs: three short chains of operations instead of a long one (Estrin's scheme).
        value = builder.fadd(pairs[1], builder.fmul(square, pairs[2]))
        value = builder.fadd(pairs[0], builder.fmul(square, value))
        # 2^i as float32: its biased exponent, i + 127, above the 23 bits of the fraction.
        exponent = builder.shl(builder.add(whole, _all(127, INTS)), _all(23, INTS))
        return builder.fmul(value, builder.bitcast(exponent, FLOATS))

    return LANES(LANES), generate
