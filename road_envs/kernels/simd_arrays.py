"""Arrays of one vehicle or of lanes: elements and rows of lanes are read and written by one source.

On the arrays of one vehicle `get`, `put` and `add` are plain indexing. On arrays with a last axis
of LANES they operate on all lanes: an index with one dimension less selects a row of lanes.

    get(q, j)      q (7,)     a float         q (7, LANES)     a vector
    get(p.x_1)     a float    a float         (LANES,)         a vector

A row of lanes in single precision is read as a vector of doubles and written from it; one of bytes
is read so. Indices are not negative. Without compilation (`py_func`) only numbers exist.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import lower_builtin

from road_envs.kernels._numba import cgutils, populate_array, signature
from road_envs.kernels.simd import (
    FLAGS,
    INT32,
    LANES,
    LLVM_VECTOR,
    any_vector,
    as_vector,
    elementwise,
    integers,
    shuffled,
    typed,
    vector,
)


def stack_array(rows):
    """Return an uninitialised array (rows,) on the stack of the kernel, which it must not outlive.

    The compiler keeps it apart from other memory, and its values in registers; `rows` is constant.
    """
    return np.empty(rows)


def stack_rows(rows):
    """Return a `stack_array` (rows, LANES)."""
    return np.empty((rows, LANES))


def _register_on_stack(function: Any, *lanes: int) -> None:
    @typed(function)
    def find(rows):
        if isinstance(rows, types.IntegerLiteral):
            return signature(types.Array(types.float64, 1 + len(lanes), "C"), rows)
        return None

    @lower_builtin(function, types.IntegerLiteral)
    def lower(context, builder, signature, values):
        shape = signature.args[0].literal_value, *lanes
        strides = [8 * int(np.prod(shape[i + 1 :])) for i in range(len(shape))]
        store = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), int(np.prod(shape))))
        store.align = 64
        array = context.make_array(signature.return_type)(context, builder)
        sizes = [[context.get_constant(types.intp, n) for n in x] for x in (shape, strides, [8])]
        data = builder.bitcast(store, array.data.type)
        populate_array(array, data, sizes[0], sizes[1], sizes[2][0], meminfo=None)
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


@typed(get)
def _find_get(a, *i):
    if not isinstance(a, types.Array):
        return signature(a, a)
    return signature(a.dtype if a.ndim == len(i) else vector, a, *[types.intp for _ in i])


def _find_put(a, i, x):
    kind = vector if a.ndim > 1 else a.dtype
    return signature(types.none, a, types.intp, x if kind == vector else kind)


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
    if kind.ndim == len(values) - 1 or kind.dtype == types.float64:
        return value
    widen = builder.fpext if kind.dtype == types.float32 else builder.uitofp
    return widen(value, LLVM_VECTOR)


def _register_store(function: Any, adds: bool) -> None:
    typed(function)(_find_put)

    @lower_builtin(function, types.VarArg(types.Any))
    def lower(context, builder, signature, values):
        array, _, x = signature.args
        at = _address(context, builder, array, values[0], values[1:2])
        value = as_vector(context, builder, values[2], x) if array.ndim > 1 else values[2]
        if adds:
            value = builder.fadd(_load(builder, at), value, flags=FLAGS)
        elif array.ndim > 1 and array.dtype == types.float32:
            value = builder.fptrunc(value, ir.VectorType(ir.FloatType(), LANES))
        builder.store(value, at).align = 8
        return context.get_dummy_value()


_register_store(put, adds=False)
_register_store(add, adds=True)


def load_four(array, first, stride, i):
    """Return four consecutive elements of a contiguous array, from flat `first` + `stride` i on.

    `first` and `i` are whole numbers as floats, `stride` is an integer.
    """
    flat, at = array.ravel(), int(first) + stride * int(i)
    return flat[at], flat[at + 1], flat[at + 2], flat[at + 3]


@typed(load_four)
def _find_load_four(array, first, stride, i):
    x = elementwise(first, i)
    if isinstance(stride, types.IntegerLiteral):
        return signature(types.UniTuple(x.return_type, 4), array, x.args[0], stride, x.args[1])
    return None


@lower_builtin(load_four, types.Array, types.Any, types.IntegerLiteral, types.Any)
def _load_four(context, builder, signature, values):
    array, first, stride, i = signature.args
    data = context.make_array(array)(context, builder, values[0]).data
    floats = [(values[1], first), (values[3], i)]
    if vectors := any_vector(first, i):
        floats = [(as_vector(context, builder, *x), vector) for x in floats]
    # each straight to an integer: `i` was one before, and a sum of floats would delay the load
    start, steps = (builder.fptosi(x, integers(x.type)) for x, _ in floats)
    by = [stride.literal_value] * LANES if vectors else stride.literal_value
    at = builder.add(start, builder.mul(steps, ir.Constant(steps.type, by)))
    if vectors:
        # a row of four neighbours per lane, transposed: faster than a gather
        four, rows = ir.VectorType(ir.DoubleType(), 4), []
        for k in range(LANES):
            address = builder.gep(data, [builder.extract_element(at, INT32(k))])
            rows.append(_load(builder, builder.bitcast(address, four.as_pointer())))
        columns = _transpose(builder, rows)
    else:
        addresses = (builder.gep(data, [builder.add(at, at.type(k))]) for k in range(4))
        columns = [builder.load(address) for address in addresses]
    return context.make_tuple(builder, signature.return_type, columns)


def _transpose(builder, rows):
    """Return four vectors of LANES from LANES rows of four, by twelve shuffles."""
    # rows k and k + 4 side by side, then 4 x 4 transposes in both halves of the registers
    pairs = [shuffled(builder, rows[k], rows[k + 4], list(range(8))) for k in range(4)]
    columns = []
    for first in ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15]):
        halves = zip(pairs[::2], pairs[1::2], strict=True)
        low, high = (shuffled(builder, a, b, first) for a, b in halves)
        columns.append(shuffled(builder, low, high, [0, 1, 8, 9, 4, 5, 12, 13]))
        columns.append(shuffled(builder, low, high, [2, 3, 10, 11, 6, 7, 14, 15]))
    return [columns[k] for k in (0, 2, 1, 3)]
