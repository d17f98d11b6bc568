"""SIMD vector type of 8 doubles for Numba: one source of a kernel runs one vehicle or eight.

LLVM maps it to the vector registers of the machine: one of AVX-512, two of AVX2, four of SSE2.
Kernels that support it read and write through `get`, `put` and `add` (`simd_arrays.py`), and branch
through `maximum`, `minimum` and `if_positive`. Without compilation (`py_func`) only numbers exist.

Each operation is typed and lowered directly: an `overload` would be compiled for every combination
of argument types, which took a tenth of the time to a first step.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.extending import lower_builtin, models, register_model

from road_envs.kernels._numba import AbstractTemplate, infer_global, signature

intrinsic: Any = extending.intrinsic  # its annotations count the typing context as an argument

LANES = 8
FLAGS = ("contract", "arcp")  # as `_numba.kernel` sets for scalars
LLVM_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
INT32 = ir.IntType(32)


class _Vector(types.Type):
    """Numba type of LANES doubles."""

    def __init__(self):
        super().__init__(name=f"vector of {LANES} doubles")


vector = _Vector()


@register_model(_Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, LLVM_VECTOR)


def any_vector(*kinds) -> bool:
    return any(isinstance(kind, _Vector) for kind in kinds)


def as_vector(context, builder, value, kind):
    """Return `value` as a vector; a number is broadcast to all lanes."""
    if isinstance(kind, _Vector):
        return value
    number = context.cast(builder, value, kind, types.float64)
    nothing = ir.Constant(LLVM_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(INT32, 0))
    zeros = ir.Constant(ir.VectorType(INT32, LANES), [0] * LANES)
    return builder.shuffle_vector(first, nothing, zeros)


def _broadcast_all(context, builder, signature, values):
    """Return `values` as vectors if any of them is one, else as they are."""
    if not any_vector(*signature.args):
        return values
    return [as_vector(context, builder, v, k) for v, k in zip(values, signature.args, strict=True)]


def typed(function: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register the decorated function, from types of arguments to a signature, for `function`."""

    def decorate(find: Callable[..., Any]) -> Callable[..., Any]:
        class Template(AbstractTemplate):
            prefer_literal = True

            def generic(self, args, kws):
                return find(*args)

        infer_global(function)(Template)
        return find

    return decorate


def elementwise(*kinds):
    """Return the signature of a function of numbers or vectors: a vector if any of them is."""
    arguments = [k if isinstance(k, _Vector) else types.float64 for k in kinds]
    return signature(vector if any_vector(*kinds) else types.float64, *arguments)


def _constant(kind, number: float):
    """Return `number` as a constant of an LLVM type: of doubles, or of vectors."""
    if kind == LLVM_VECTOR:
        return ir.Constant(kind, [ir.Constant(kind.element, number)] * LANES)
    return ir.Constant(kind, number)


def _overload_arithmetic(operators: tuple[Any, ...], instruction: str) -> None:
    def lower(context, builder, signature, values):
        a, b = _broadcast_all(context, builder, signature, values)
        return getattr(builder, instruction)(a, b, flags=FLAGS)

    for each in operators:
        typed(each)(lambda *kinds: elementwise(*kinds) if any_vector(*kinds) else None)
        for kinds in ((vector, vector), (vector, types.float64), (types.float64, vector)):
            lower_builtin(each, *kinds)(lower)


_overload_arithmetic((operator.add, operator.iadd), "fadd")
_overload_arithmetic((operator.sub, operator.isub), "fsub")
_overload_arithmetic((operator.mul, operator.imul), "fmul")
_overload_arithmetic((operator.truediv, operator.itruediv), "fdiv")
typed(operator.neg)(lambda kind: signature(vector, vector) if any_vector(kind) else None)


@lower_builtin(operator.neg, vector)
def _negate(context, builder, signature, values):
    return builder.fneg(values[0], flags=FLAGS)


def maximum(a, b):
    return a if a > b else b


def minimum(a, b):
    return b if a > b else a


def if_positive(c, a, b):
    return a if c > 0.0 else b


def _register_choice(function: Any, choose: Callable[..., Any]) -> None:
    """Lower a `function` to the numbers or vectors (a, b, x, y) of `choose`: x if a > b, else y."""
    typed(function)(elementwise)

    @lower_builtin(function, types.VarArg(types.Any))
    def lower(context, builder, signature, values):
        a, b, x, y = choose(*_broadcast_all(context, builder, signature, values))
        return builder.select(builder.fcmp_ordered(">", a, b), x, y)


_register_choice(maximum, lambda a, b: (a, b, a, b))
_register_choice(minimum, lambda a, b: (a, b, b, a))
_register_choice(if_positive, lambda c, a, b: (c, _constant(c.type, 0.0), a, b))


def shuffled(builder, a, b, mask):
    """Return the elements `mask` of the vector `a` followed by the vector `b`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT32, len(mask)), mask))


@intrinsic
def extract_lane(context, x, k):
    """Return lane `k` of a vector as a number."""

    def generate(context, builder, signature, values):
        k = context.cast(builder, values[1], signature.args[1], types.int32)
        return builder.extract_element(values[0], k)

    return types.float64(x, k), generate


@intrinsic
def sum_lanes(context, x):
    """Return the sum of all lanes of a vector, as a number: halves are added to halves."""

    def generate(context, builder, signature, values):
        total, lanes = values[0], list(range(LANES))
        while len(lanes) > 1:
            half = len(lanes) // 2
            low, high = (shuffled(builder, total, total, x) for x in (lanes[:half], lanes[half:]))
            total, lanes = builder.fadd(low, high, flags=FLAGS), lanes[:half]
        return builder.extract_element(total, ir.Constant(INT32, 0))

    return types.float64(x), generate


@intrinsic
def broadcast(context, value):
    """Return a vector with the number `value` in every lane."""

    def generate(context, builder, signature, values):
        return as_vector(context, builder, values[0], signature.args[0])

    return vector(value), generate


def equals_one(x):
    """Return whether `x`, or every lane of it, is 1."""
    return x == 1.0


def is_zero_or_one(x):
    """Return whether `x`, or every lane of it, is 0 or 1."""
    return x == 0.0 or x == 1.0


def any_positive(x):
    """Return whether `x`, or any lane of it, is greater than 0."""
    return x > 0.0


def _register_test(function: Any, comparison: str, *numbers: float) -> None:
    """Lower a test of all lanes for equality to one of `numbers`, or of any for being greater."""
    typed(function)(lambda x: signature(types.boolean, x))

    @lower_builtin(function, types.Any)
    def lower(context, builder, signature, values):
        (x,) = values
        flags = [builder.fcmp_ordered(comparison, x, _constant(x.type, n)) for n in numbers]
        found = functools.reduce(builder.or_, flags)
        if found.type == ir.IntType(1):
            return found
        bits = builder.bitcast(found, ir.IntType(LANES))  # one of each lane
        expected = ("==", -1) if comparison == "==" else ("!=", 0)
        return builder.icmp_unsigned(expected[0], bits, ir.Constant(bits.type, expected[1]))


_register_test(equals_one, "==", 1.0)
_register_test(is_zero_or_one, "==", 0.0, 1.0)
_register_test(any_positive, ">", 0.0)


def power(x, n):
    return x**n


typed(power)(elementwise)


@lower_builtin(power, types.Any, types.Any)
def _power(context, builder, signature, values):
    scalar_power = builder.module.declare_intrinsic("llvm.pow", [ir.DoubleType()])
    x, n = _broadcast_all(context, builder, signature, values)
    if x.type != LLVM_VECTOR:
        return builder.call(scalar_power, (x, n))
    y = x
    for k in map(INT32, range(LANES)):  # vector units have no instruction for a power
        one = builder.call(scalar_power, [builder.extract_element(each, k) for each in (x, n)])
        y = builder.insert_element(y, one, k)
    return y


def integer_part(x):
    """Return the integer part of `x` >= 0 as a float."""
    return float(int(x))


typed(integer_part)(elementwise)


@lower_builtin(integer_part, types.Any)
def _integer_part(context, builder, signature, values):
    (x,) = values
    return builder.sitofp(builder.fptosi(x, integers(x.type)), x.type)


def integers(kind):
    """Return the LLVM type of integers, one for each double of `kind`."""
    return ir.VectorType(ir.IntType(64), LANES) if kind == LLVM_VECTOR else ir.IntType(64)
