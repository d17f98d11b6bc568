"""SIMD vector type of 8 doubles for Numba: one source of a kernel runs one vehicle or eight.

LLVM maps it to the vector registers of the machine: one of AVX-512, two of AVX2, four of SSE2.
Kernels that support it read and write through `get`, `put` and `add`, and branch through
`maximum`, `minimum` and `if_positive`. On the arrays of one vehicle these are plain indexing and
conditional expressions. On arrays with a last axis of LANES they operate on all lanes: an index
with one dimension less selects a row of lanes.

    get(q, j)      q (7,)     a float         q (7, LANES)     a vector
    get(p.x_1)     a float    a float         (LANES,)         a vector

Without compilation (`py_func`) only the scalar column exists. As in every kernel, a*b + c may be
contracted to a fused operation and x / c may become x * (1 / c).
"""

import operator
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.extending import models, overload, register_model

intrinsic: Any = extending.intrinsic  # its annotations count the typing context as an argument

LANES = 8
FLAGS = ("contract", "arcp")  # as `_numba.kernel` sets for scalars
_llvm = ir.VectorType(ir.DoubleType(), LANES)
_int32 = ir.IntType(32)


class Vector(types.Type):
    """Numba type of LANES doubles."""

    def __init__(self):
        super().__init__(name=f"vector of {LANES} doubles")


vector = Vector()


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _llvm)


def _any_vector(*kinds) -> bool:
    return any(isinstance(kind, Vector) for kind in kinds)


def _broadcast(context, builder, value, kind):
    """Return `value` as a vector; a number is broadcast to all lanes."""
    if isinstance(kind, Vector):
        return value
    number = context.cast(builder, value, kind, types.float64)
    nothing = ir.Constant(_llvm, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(_int32, 0))
    zeros = ir.Constant(ir.VectorType(_int32, LANES), [0] * LANES)
    return builder.shuffle_vector(first, nothing, zeros)


def _broadcast_all(context, builder, signature, values):
    return [_broadcast(context, builder, v, k) for v, k in zip(values, signature.args, strict=True)]


def _arithmetic(instruction: str) -> Any:
    @intrinsic
    def operation(context, a, b):
        def generate(context, builder, signature, values):
            a, b = _broadcast_all(context, builder, signature, values)
            return getattr(builder, instruction)(a, b, flags=FLAGS)

        return vector(a, b), generate

    return operation


def _overload_arithmetic(operators: tuple[Any, ...], instruction: str) -> None:
    operation = _arithmetic(instruction)
    for each in operators:

        @overload(each)
        def on_vectors(a, b):
            return (lambda a, b: operation(a, b)) if _any_vector(a, b) else None


_overload_arithmetic((operator.add, operator.iadd), "fadd")
_overload_arithmetic((operator.sub, operator.isub), "fsub")
_overload_arithmetic((operator.mul, operator.imul), "fmul")
_overload_arithmetic((operator.truediv, operator.itruediv), "fdiv")


@intrinsic
def _negate(context, a):
    def generate(context, builder, signature, values):
        return builder.fneg(values[0], flags=FLAGS)

    return vector(a), generate


@overload(operator.neg)
def _negate_vector(a):
    return (lambda a: _negate(a)) if _any_vector(a) else None


@intrinsic
def _where_greater(context, a, b, x, y):
    """Select lane by lane `x` where a > b, else `y`."""

    def generate(context, builder, signature, values):
        a, b, x, y = _broadcast_all(context, builder, signature, values)
        return builder.select(builder.fcmp_ordered(">", a, b), x, y)

    return vector(a, b, x, y), generate


def maximum(a, b):
    """Return the greater of `a` and `b`."""
    return a if a > b else b


def minimum(a, b):
    """Return the lesser of `a` and `b`."""
    return b if a > b else a


def if_positive(c, a, b):
    """Return `a` where `c` > 0, else `b`."""
    return a if c > 0.0 else b


@overload(maximum)
def _maximum(a, b):
    if _any_vector(a, b):
        return lambda a, b: _where_greater(a, b, a, b)
    return maximum


@overload(minimum)
def _minimum(a, b):
    if _any_vector(a, b):
        return lambda a, b: _where_greater(a, b, b, a)
    return minimum


@overload(if_positive)
def _if_positive(c, a, b):
    if _any_vector(c, a, b):
        return lambda c, a, b: _where_greater(c, 0.0, a, b)
    return if_positive


@intrinsic
def extract_lane(context, x, k):
    """Return lane `k` of a vector as a number."""

    def generate(context, builder, signature, values):
        k = context.cast(builder, values[1], signature.args[1], types.int32)
        return builder.extract_element(values[0], k)

    return types.float64(x, k), generate


@intrinsic
def insert_lane(context, x, k, value):
    """Return a copy of the vector `x` with the number `value` in lane `k`."""

    def generate(context, builder, signature, values):
        k = context.cast(builder, values[1], signature.args[1], types.int32)
        number = context.cast(builder, values[2], signature.args[2], types.float64)
        return builder.insert_element(values[0], number, k)

    return vector(x, k, value), generate


@intrinsic
def broadcast(context, value):
    """Return a vector with the number `value` in every lane."""

    def generate(context, builder, signature, values):
        return _broadcast(context, builder, values[0], signature.args[0])

    return vector(value), generate


def _address(context, builder, kind, array, index_kinds, indices):
    struct = context.make_array(kind)(context, builder, array)
    wide = [
        context.cast(builder, i, k, types.intp) for i, k in zip(indices, index_kinds, strict=True)
    ]
    wide.append(context.get_constant(types.intp, 0))  # lane 0: the start of the row
    at = cgutils.get_item_pointer(context, builder, kind, struct, wide, wraparound=False)
    return builder.bitcast(at, _llvm.as_pointer())


@intrinsic
def _load(context, array, indices):
    def generate(context, builder, signature, values):
        kind, index_kinds = signature.args
        unpacked = cgutils.unpack_tuple(builder, values[1])
        value = builder.load(_address(context, builder, kind, values[0], index_kinds, unpacked))
        value.align = 8  # NumPy guarantees no more; vectors would default to 64
        return value

    return vector(array, indices), generate


@intrinsic
def _store(context, array, indices, x):
    def generate(context, builder, signature, values):
        kind, index_kinds, x_kind = signature.args
        unpacked = cgutils.unpack_tuple(builder, values[1])
        at = _address(context, builder, kind, values[0], index_kinds, unpacked)
        builder.store(_broadcast(context, builder, values[2], x_kind), at).align = 8
        return context.get_dummy_value()

    return types.void(array, indices, x), generate


def get(a, *i):
    """Return the element, or the row of lanes, of `a` at the indices `i`."""
    return a[i] if i else a


def put(a, i, x):
    """Set the element, or the row of lanes, of `a` at index `i`."""
    a[i] = x


@overload(get)
def _get(a, *i):
    if isinstance(a, types.Float):
        return lambda a, *i: a
    if a.ndim == len(i):
        return lambda a, *i: a[i]
    return lambda a, *i: _load(a, i)


@overload(put)
def _put(a, i, x):
    if a.ndim == 1:
        return put
    return lambda a, i, x: _store(a, (i,), x)


def add(a, i, x):
    """Add `x` to the element, or the row of lanes, of `a` at index `i`."""
    put(a, i, get(a, i) + x)


@overload(add)
def _add(a, i, x):
    return add


@intrinsic
def _all_equal(context, x, a, b):
    """Return whether every lane of `x` equals the number `a` or the number `b`."""

    def generate(context, builder, signature, values):
        x, a, b = _broadcast_all(context, builder, signature, values)
        # one bit per lane, read as an integer: all ones if every lane is equal
        equal = (builder.fcmp_ordered("==", x, y) for y in (a, b))
        bits = builder.bitcast(builder.or_(*equal), ir.IntType(LANES))
        return builder.icmp_unsigned("==", bits, ir.Constant(ir.IntType(LANES), -1))

    return types.boolean(x, a, b), generate


def equals_one(x):
    """Return whether `x`, or every lane of it, is 1."""
    return x == 1.0


def is_zero_or_one(x):
    """Return whether `x`, or every lane of it, is 0 or 1."""
    return x == 0.0 or x == 1.0


@overload(equals_one)
def _equals_one(x):
    return (lambda x: _all_equal(x, 1.0, 1.0)) if _any_vector(x) else equals_one


@overload(is_zero_or_one)
def _is_flag(x):
    return (lambda x: _all_equal(x, 0.0, 1.0)) if _any_vector(x) else is_zero_or_one


def power(x, n):
    """Return `x` to the power `n`."""
    return x**n


@overload(power)
def _overload_power(x, n):
    if not _any_vector(x, n):
        return power

    # vector units have no instruction for a power
    def lane_by_lane(x, n):
        y = x
        for k in range(LANES):
            y = insert_lane(y, k, extract_lane(x, k) ** extract_lane(n, k))
        return y

    return lane_by_lane


@intrinsic
def _integer_part_of_vector(context, x):
    def generate(context, builder, signature, values):
        integers = builder.fptosi(values[0], ir.VectorType(ir.IntType(64), LANES))
        return builder.sitofp(integers, _llvm)

    return vector(x), generate


def integer_part(x):
    """Return the integer part of `x` >= 0 as a float."""
    return float(int(x))


@overload(integer_part)
def _overload_integer_part(x):
    return (lambda x: _integer_part_of_vector(x)) if _any_vector(x) else integer_part


@intrinsic
def _load_four_lanes(context, array, first):
    """Load four neighbours per lane as one row and transpose; this is faster than a gather."""
    four, row = ir.VectorType(ir.DoubleType(), 4), types.UniTuple(vector, 4)

    def generate(context, builder, signature, values):
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        first = _broadcast(context, builder, values[1], signature.args[1])
        at = builder.fptosi(first, ir.VectorType(ir.IntType(64), LANES))
        rows = []
        for k in range(LANES):
            address = builder.gep(struct.data, [builder.extract_element(at, _int32(k))])
            rows.append(builder.load(builder.bitcast(address, four.as_pointer())))
            rows[-1].align = 8
        columns = _transpose(builder, rows)
        return context.make_tuple(builder, signature.return_type, columns)

    return row(array, first), generate


def _transpose(builder, rows):
    """Return four vectors of LANES from LANES rows of four, by pairwise shuffles."""

    def shuffled(a, b, mask):
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_int32, len(mask)), mask))

    columns = []
    for j in range(4):
        parts = [shuffled(a, b, [j, 4 + j]) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        while len(parts) > 1:
            mask = list(range(2 * parts[0].type.count))
            parts = [shuffled(a, b, mask) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        columns.append(parts[0])
    return columns


def load_four(array, first):
    """Return four consecutive elements of a contiguous array, from flat index `first` on."""
    flat = array.ravel()
    i = int(first)
    return flat[i], flat[i + 1], flat[i + 2], flat[i + 3]


@intrinsic
def _load_four_numbers(context, array, first):
    def generate(context, builder, signature, values):
        struct = context.make_array(signature.args[0])(context, builder, values[0])
        at = context.cast(builder, values[1], signature.args[1], types.int64)
        addresses = (builder.gep(struct.data, [builder.add(at, at.type(k))]) for k in range(4))
        numbers = [builder.load(address) for address in addresses]
        return context.make_tuple(builder, signature.return_type, numbers)

    return types.UniTuple(types.float64, 4)(array, first), generate


@overload(load_four)
def _overload_load_four(array, first):
    if _any_vector(first):
        return lambda array, first: _load_four_lanes(array, first)
    return lambda array, first: _load_four_numbers(array, first)
