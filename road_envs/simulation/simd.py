"""SIMD vector type of 8 doubles for Numba: one source of a kernel runs one vehicle or eight.

LLVM maps it to the vector registers of the machine: one of AVX-512, two of AVX2, four of SSE2.
Kernels that support it read and write through `get`, `put` and `add`, and branch through
`maximum`, `minimum` and `if_positive`. On the arrays of one vehicle these are plain indexing and
conditional expressions. On arrays with a last axis of LANES they operate on all lanes: an index
with one dimension less selects a row of lanes.

    get(q, j)      q (7,)     a float         q (7, LANES)     a vector
    get(p.x_1)     a float    a float         (LANES,)         a vector

A row of lanes that is stored in single precision is read as a vector of doubles.

Indices are not negative. Without compilation (`py_func`) only the scalar column exists. As in every
kernel, a*b + c may be contracted to a fused operation and x / c may become x * (1 / c).

Each operation is typed and lowered directly: an `overload` would be compiled for every combination
of argument types, which took a tenth of the time to a first step.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, overload, register_model

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
    """Return `values` as vectors if any of them is one, else as they are."""
    if not _any_vector(*signature.args):
        return values
    return [_broadcast(context, builder, v, k) for v, k in zip(values, signature.args, strict=True)]


def _typed(function: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register the decorated function as typing of `function`.

    It returns the signature for types of arguments, or None for those it does not know.
    """

    def decorate(find: Callable[..., Any]) -> Callable[..., Any]:
        class Template(AbstractTemplate):
            prefer_literal = True

            def generic(self, args, kws):
                return find(*args)

        infer_global(function)(Template)
        return find

    return decorate


def _elementwise(*kinds):
    """Return the signature of a function of numbers or vectors: a vector if any of them is."""
    arguments = [k if isinstance(k, Vector) else types.float64 for k in kinds]
    return signature(vector if _any_vector(*kinds) else types.float64, *arguments)


def _constant(kind, number: float):
    """Return `number` as a constant of an LLVM type: of doubles, or of vectors."""
    if kind == _llvm:
        return ir.Constant(kind, [ir.Constant(kind.element, number)] * LANES)
    return ir.Constant(kind, number)


def _where_greater(builder, a, b, x, y):
    """Select lane by lane `x` where a > b, else `y`."""
    return builder.select(builder.fcmp_ordered(">", a, b), x, y)


def _overload_arithmetic(operators: tuple[Any, ...], instruction: str) -> None:
    def lower(context, builder, signature, values):
        a, b = _broadcast_all(context, builder, signature, values)
        return getattr(builder, instruction)(a, b, flags=FLAGS)

    for each in operators:
        _typed(each)(lambda *kinds: _elementwise(*kinds) if _any_vector(*kinds) else None)
        for kinds in ((vector, vector), (vector, types.float64), (types.float64, vector)):
            lower_builtin(each, *kinds)(lower)


_overload_arithmetic((operator.add, operator.iadd), "fadd")
_overload_arithmetic((operator.sub, operator.isub), "fsub")
_overload_arithmetic((operator.mul, operator.imul), "fmul")
_overload_arithmetic((operator.truediv, operator.itruediv), "fdiv")
_typed(operator.neg)(lambda kind: signature(vector, vector) if _any_vector(kind) else None)


@lower_builtin(operator.neg, vector)
def _negate(context, builder, signature, values):
    return builder.fneg(values[0], flags=FLAGS)


def maximum(a, b):
    """Return the greater of `a` and `b`."""
    return a if a > b else b


def minimum(a, b):
    """Return the lesser of `a` and `b`."""
    return b if a > b else a


def if_positive(c, a, b):
    """Return `a` where `c` > 0, else `b`."""
    return a if c > 0.0 else b


for _choice in (maximum, minimum, if_positive):
    _typed(_choice)(_elementwise)


@lower_builtin(maximum, types.VarArg(types.Any))
def _maximum(context, builder, signature, values):
    a, b = _broadcast_all(context, builder, signature, values)
    return _where_greater(builder, a, b, a, b)


@lower_builtin(minimum, types.VarArg(types.Any))
def _minimum(context, builder, signature, values):
    a, b = _broadcast_all(context, builder, signature, values)
    return _where_greater(builder, a, b, b, a)


@lower_builtin(if_positive, types.VarArg(types.Any))
def _if_positive(context, builder, signature, values):
    c, a, b = _broadcast_all(context, builder, signature, values)
    return _where_greater(builder, c, _constant(c.type, 0.0), a, b)


def _shuffled(builder, a, b, mask):
    """Return the elements `mask` of the vector `a` followed by the vector `b`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_int32, len(mask)), mask))


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
        total, width = values[0], LANES
        while width > 1:
            width //= 2
            low, high = (
                _shuffled(builder, total, total, list(range(at, at + width))) for at in (0, width)
            )
            total = builder.fadd(low, high, flags=FLAGS)
        return builder.extract_element(total, ir.Constant(_int32, 0))

    return types.float64(x), generate


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


def stack_array(rows):
    """Return an uninitialised array (rows,) on the stack of the kernel that calls this.

    The compiler keeps it apart from all other memory, so that it holds values in registers and
    reorders loads and stores around it. It must not outlive the kernel, and `rows` is a constant.
    """
    return np.empty(rows)


def stack_rows(rows):
    """Return a `stack_array` (rows, LANES)."""
    return np.empty((rows, LANES))


def _register_on_stack(function: Any, *lanes: int) -> None:
    @_typed(function)
    def find(rows):
        if isinstance(rows, types.IntegerLiteral):
            return signature(types.Array(types.float64, 1 + len(lanes), "C"), rows)
        return None

    @lower_builtin(function, types.IntegerLiteral)
    def lower(context, builder, signature, values):
        from numba.np.arrayobj import populate_array  # needed, and slow to import, only here

        shape = signature.args[0].literal_value, *lanes
        strides = [8 * int(np.prod(shape[i + 1 :])) for i in range(len(shape))]
        store = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), int(np.prod(shape))))
        store.align = 64
        array = context.make_array(signature.return_type)(context, builder)
        populate_array(
            array,
            builder.bitcast(store, array.data.type),
            [context.get_constant(types.intp, n) for n in shape],
            [context.get_constant(types.intp, n) for n in strides],
            context.get_constant(types.intp, 8),
            meminfo=None,
        )
        return array._getvalue()


_register_on_stack(stack_array)
_register_on_stack(stack_rows, LANES)


def get(a, *i):
    """Return the element, or the row of lanes, of `a` at the indices `i`."""
    return a[i] if i else a


def put(a, i, x):
    """Set the element, or the row of lanes, of `a` at index `i`."""
    a[i] = x


def add(a, i, x):
    """Add `x` to the element, or the row of lanes, of `a` at index `i`."""
    a[i] += x


@_typed(get)
def _find_get(a, *i):
    if not isinstance(a, types.Array):
        return signature(a, a)
    return signature(a.dtype if a.ndim == len(i) else vector, a, *[types.intp for _ in i])


def _find_put(a, i, x):
    kind = vector if a.ndim > 1 else a.dtype
    return signature(types.none, a, types.intp, x if kind == vector else kind)


_typed(put)(_find_put)
_typed(add)(_find_put)


def _address(context, builder, kind, array, indices):
    """Return the address of an element, or of the row of lanes, of an array."""
    struct = context.make_array(kind)(context, builder, array)
    start = context.get_constant(types.intp, 0)  # lane 0: the start of a row
    whole = [*indices, *[start] * (kind.ndim - len(indices))]
    at = cgutils.get_item_pointer(context, builder, kind, struct, whole, wraparound=False)
    if kind.ndim == len(indices):
        return at
    row = ir.VectorType(context.get_data_type(kind.dtype), LANES)
    return builder.bitcast(at, row.as_pointer())


def _load(builder, address, align=8):
    value = builder.load(address)
    value.align = align  # NumPy guarantees no more; vectors would default to 64
    return value


@lower_builtin(get, types.VarArg(types.Any))
def _get(context, builder, signature, values):
    kind = signature.args[0]
    if not isinstance(kind, types.Array):
        return values[0]
    address = _address(context, builder, kind, values[0], values[1:])
    value = _load(builder, address, kind.dtype.bitwidth // 8)
    widen = kind.dtype == types.float32 and kind.ndim > len(values) - 1
    return builder.fpext(value, _llvm) if widen else value


@lower_builtin(put, types.VarArg(types.Any))
def _put(context, builder, signature, values):
    array, _, x = signature.args
    at = _address(context, builder, array, values[0], values[1:2])
    value = _broadcast(context, builder, values[2], x) if array.ndim > 1 else values[2]
    builder.store(value, at).align = 8
    return context.get_dummy_value()


@lower_builtin(add, types.VarArg(types.Any))
def _add(context, builder, signature, values):
    array, _, x = signature.args
    at = _address(context, builder, array, values[0], values[1:2])
    value = _broadcast(context, builder, values[2], x) if array.ndim > 1 else values[2]
    builder.store(builder.fadd(_load(builder, at), value, flags=FLAGS), at).align = 8
    return context.get_dummy_value()


def equals_one(x):
    """Return whether `x`, or every lane of it, is 1."""
    return x == 1.0


def is_zero_or_one(x):
    """Return whether `x`, or every lane of it, is 0 or 1."""
    return x == 0.0 or x == 1.0


def _every_lane_is(builder, x, *numbers):
    """Return whether every lane of `x` equals one of two `numbers`."""
    a, b = (builder.fcmp_ordered("==", x, _constant(x.type, number)) for number in numbers)
    either = builder.or_(a, b)
    if x.type != _llvm:
        return either
    # one bit per lane, read as an integer: all ones if every lane is equal
    bits = builder.bitcast(either, ir.IntType(LANES))
    return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, -1))


for _test in (equals_one, is_zero_or_one):
    _typed(_test)(lambda x: signature(types.boolean, x))


@lower_builtin(equals_one, types.Any)
def _equals_one(context, builder, signature, values):
    return _every_lane_is(builder, values[0], 1.0, 1.0)


@lower_builtin(is_zero_or_one, types.Any)
def _is_zero_or_one(context, builder, signature, values):
    return _every_lane_is(builder, values[0], 0.0, 1.0)


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


def integer_part(x):
    """Return the integer part of `x` >= 0 as a float."""
    return float(int(x))


_typed(integer_part)(_elementwise)


@lower_builtin(integer_part, types.Any)
def _integer_part(context, builder, signature, values):
    integers = builder.fptosi(values[0], _integers(values[0].type))
    return builder.sitofp(integers, values[0].type)


def _integers(kind):
    """Return the LLVM type of integers, one for each double of `kind`."""
    integer = ir.IntType(64)
    return ir.VectorType(integer, LANES) if kind == _llvm else integer


def load_four(array, first):
    """Return four consecutive elements of a contiguous array, from flat index `first` on."""
    flat = array.ravel()
    i = int(first)
    return flat[i], flat[i + 1], flat[i + 2], flat[i + 3]


@_typed(load_four)
def _find_load_four(array, first):
    x = _elementwise(first)
    return signature(types.UniTuple(x.return_type, 4), array, *x.args)


@lower_builtin(load_four, types.Array, types.Any)
def _load_four(context, builder, signature, values):
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    at = builder.fptosi(values[1], _integers(values[1].type))
    if _any_vector(signature.args[1]):
        # a row of four neighbours per lane, transposed: faster than a gather
        four, rows = ir.VectorType(ir.DoubleType(), 4), []
        for k in range(LANES):
            address = builder.gep(data, [builder.extract_element(at, _int32(k))])
            rows.append(_load(builder, builder.bitcast(address, four.as_pointer())))
        columns = _transpose(builder, rows)
    else:
        addresses = (builder.gep(data, [builder.add(at, at.type(k))]) for k in range(4))
        columns = [builder.load(address) for address in addresses]
    return context.make_tuple(builder, signature.return_type, columns)


def _transpose(builder, rows):
    """Return four vectors of LANES from LANES rows of four, by twelve shuffles."""
    # rows k and k + 4 side by side, then 4 x 4 transposes in both halves of the registers
    pairs = [_shuffled(builder, rows[k], rows[k + 4], list(range(8))) for k in range(4)]
    columns = []
    for first in ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15]):
        halves = zip(pairs[::2], pairs[1::2], strict=True)
        low, high = (_shuffled(builder, a, b, first) for a, b in halves)
        columns.append(_shuffled(builder, low, high, [0, 1, 8, 9, 4, 5, 12, 13]))
        columns.append(_shuffled(builder, low, high, [2, 3, 10, 11, 6, 7, 14, 15]))
    return [columns[k] for k in (0, 2, 1, 3)]
