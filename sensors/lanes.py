"""Vector instructions that Numba's loops do not become, for sixteen neighbouring rays or eight columns of a matrix.

LLVM cuts them to what a processor has. `generate` writes the instructions where a kernel calls the function.

Plain loops give the same counts. With them, the stage `evaluate` of 12 s of Luxembourg (4,500 equipped vehicles) takes
6.7 s instead of 2.9 s, which is 13 % of the whole run.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 16
"""Rows."""

TILE = 4
"""Columns."""

COLUMNS = 8
"""Columns of a matrix."""

_NUMBERS = ir.VectorType(ir.DoubleType(), COLUMNS)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_STEPS = ir.VectorType(ir.IntType(16), LANES)
_ONE, _MASK = ir.IntType(32), ir.IntType(LANES)

_instructions: Any = intrinsic
"""Decorator; Numba's own type wants `typing` from callers, too."""


def _spread(builder: Any, value: Any, kind: ir.VectorType) -> Any:
    """The value in every lane of a vector of this kind."""
    nothing = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_ONE, 0))
    of_first = ir.Constant(ir.VectorType(_ONE, kind.count), [0] * kind.count)
    return builder.shuffle_vector(one, nothing, of_first)


@_instructions
def near_box(
    typing: Any,
    steps: Any,
    column: Any,
    row: Any,
    cos_el: Any,
    sin_el: Any,
    limits: Any,
) -> Any:
    """How many of the rays in rows `row` to `row + LANES` of a column end in a box for certain, and which others may.

    `cos_el` and `sin_el` are lengths per step. `limits` are `middle`, `half`, `height`, `half_h` and `error`, all
    float32. A ray ends in the box if its horizontal length is within `half` of `middle` and its height within `half_h`
    of `height`. It is counted if this is true by a margin of `error`. The second result has one bit per ray, the first
    ray in the lowest. The bit is set for a ray that is not counted, but lies within the limits widened by `error`.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        def loaded(k: int, at: tuple[Any, ...], element: ir.Type) -> Any:
            array = context.make_array(signature.args[k])(context, builder, given[k])
            first = cgutils.get_item_pointer(context, builder, signature.args[k], array, at)
            whole = builder.bitcast(first, ir.VectorType(element, LANES).as_pointer())
            return builder.load(whole, align=element.get_abi_size(context.target_data))

        column, row = given[1], given[2]
        each = cgutils.unpack_tuple(builder, given[5])
        middle, half, height, half_h, error = (_spread(builder, value, _FLOATS) for value in each)
        size = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FLOATS, [_FLOATS]), f"llvm.fabs.v{LANES}f32"
        )
        far = builder.uitofp(loaded(0, (column, row), ir.IntType(16)), _FLOATS)
        flat = builder.fmul(far, loaded(3, (row,), ir.FloatType()))
        up = builder.fmul(far, loaded(4, (row,), ir.FloatType()))
        beside = builder.fsub(builder.call(size, [builder.fsub(flat, middle)]), half)
        above = builder.fsub(builder.call(size, [builder.fsub(up, height)]), half_h)

        def within(limit: Any) -> Any:
            both = (builder.fcmp_ordered("<", gap, limit) for gap in (beside, above))
            return builder.bitcast(builder.and_(*both), _MASK)

        certain, possible = within(builder.fneg(error)), within(error)
        count = builder.zext(builder.ctpop(certain), ir.IntType(64))
        undecided = builder.zext(builder.xor(certain, possible), ir.IntType(64))
        return context.make_tuple(builder, signature.return_type, (count, undecided))

    result = types.UniTuple(types.int64, 2)
    return result(steps, column, row, cos_el, sin_el, limits), generate


@_instructions
def nearest_and_farthest(typing: Any, steps: Any, column: Any, row: Any) -> Any:
    """Least and largest range in columns `column` to `column + TILE` and rows `row` to `row + LANES`, in steps.

    Rays without a return do not count for the largest. If no ray has a return, the result is `NO_RETURN` and -1.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, given[0])
        one = ir.Constant(_STEPS, [1] * LANES)

        def outermost(order: str, a: Any, b: Any) -> Any:
            return builder.select(builder.icmp_unsigned(order, a, b), a, b)

        least = most = None
        for k in range(TILE):
            column = builder.add(given[1], ir.Constant(given[1].type, k))
            first = cgutils.get_item_pointer(context, builder, signature.args[0], array, (column, given[2]))
            steps = builder.load(builder.bitcast(first, _STEPS.as_pointer()), align=2)
            next_step = builder.add(steps, one)  # no return becomes 0
            least = steps if least is None else outermost("<", least, steps)
            most = next_step if most is None else outermost(">", most, next_step)

        def over_all(name: str, of: Any) -> Any:
            kind = ir.FunctionType(ir.IntType(16), [_STEPS])
            reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.{name}.v{LANES}i16")
            return builder.zext(builder.call(reduce, [of]), ir.IntType(64))

        farthest = builder.sub(over_all("umax", most), ir.Constant(ir.IntType(64), 1))
        return context.make_tuple(builder, signature.return_type, (over_all("umin", least), farthest))

    return types.UniTuple(types.int64, 2)(steps, column, row), generate


@_instructions
def subtract_rows(typing: Any, rows: Any, i: Any, of: Any, k: Any, factors: Any, column: Any) -> Any:
    """Subtract multiples of rows k, k + 1, ... of a matrix from the rows i, i + 1 and i + 2 of `rows`.

    This is done in the columns `column` to `column + COLUMNS`. `factors` is a tuple of three factors for each row of
    `of`. Numba's loops do not use vectors here, because they would have to compare too many addresses first.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        def place(which: int, offset: int) -> Any:
            kind, begin = signature.args[which], given[which + 1]
            array = context.make_array(kind)(context, builder, given[which])
            row = builder.add(begin, ir.Constant(begin.type, offset))
            first = cgutils.get_item_pointer(context, builder, kind, array, (row, given[5]))
            return builder.bitcast(first, _NUMBERS.as_pointer())

        each = cgutils.unpack_tuple(builder, given[4])
        places = [place(2, row) for row in range(len(each) // 3)]
        sources = [builder.load(one, align=8) for one in places]
        for row in range(3):
            target = place(0, row)
            value = builder.load(target, align=8)
            for source, factor in zip(sources, each[row::3], strict=True):
                value = builder.fsub(value, builder.fmul(source, _spread(builder, factor, _NUMBERS)))
            builder.store(value, target, align=8)
        return context.get_dummy_value()

    return types.void(rows, i, of, k, factors, column), generate
