"""Four float64 numbers in one vector register, as a type that numba compiles; elementary functions of them.

Each of the four *lanes* holds a number of another trajectory. Lanes have the operators of numbers, so a compiled pass
over four trajectories reads like a pass over one, and takes a quarter of the instructions.
"""

from __future__ import annotations

import gc
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, get_type_hints

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import cgutils, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.typing.templates import AttributeTemplate, ConcreteTemplate, infer_getattr, infer_global
from numba.extending import lower_builtin, lower_getattr_generic, models, register_model

Array = np.ndarray


class _Part(JITCodeLibrary):  # type: ignore[misc]
    """The code of a function, which LLVM optimises and turns into machine code in its callers alone."""

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class _Inner(Compiler):  # type: ignore[misc]
    def define_pipelines(self) -> Any:
        state = self.state
        state.targetctx = state.targetctx.subtarget(get_executable=_without_code)
        state.library = _Part(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


def _without_code(library: Any, of: Any, environment: Any) -> Any:
    return _dynfunc.make_function(of.lookup_module(), of.qualname, "", 0, environment, (library,))


class Outer(Compiler):  # type: ignore[misc]
    """Compiles a function, and all that it calls, without the garbage collector: a seventh of the time."""

    def compile_extra(self, function: Any) -> Any:
        """The compiled function."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(function)
        finally:
            if collecting:
                gc.enable()


jit = numba.njit(  # type: ignore[call-overload]
    error_model="numpy",
    fastmath={"contract"},
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    no_rewrites=True,
    pipeline_class=_Inner,
)
"""Compiles functions that compiled functions alone call, and that index no tuple.

A literal argument makes numba compile the function once more; ``np.intp(1)`` does not."""

LANES = 4
"""Numbers in a register of AVX2; compilers of other processors split or join registers."""


class Plane(NamedTuple):
    """Lanes [T, n] in memory.

    :param address: of the first number.
    :param columns: n.
    """

    address: int
    columns: int


class _Kind(types.Type):  # type: ignore[misc]
    """Four values of a kind."""


Lanes, Mask = type("Lanes", (_Kind,), {})("Lanes"), type("Mask", (_Kind,), {})("Mask")
Number, Whole = types.float64, types.intp


class Record(types.Type):  # type: ignore[misc]
    """The address of the fields of a NamedTuple, one right after the other: whole numbers, and such records.

    Compiled code never writes them.

    :ivar fields: where each field begins, and its type.
    :ivar words: whole numbers of all fields.
    """

    def __init__(self, of: type) -> None:
        super().__init__(of.__name__)
        self.fields: dict[str, tuple[int, Any]] = {}
        self.words = 0
        for name, kind in get_type_hints(of).items():
            inner = Record(kind) if hasattr(kind, "_fields") else Whole
            self.fields[name] = self.words, inner
            self.words += inner.words if isinstance(inner, Record) else 1


Lines = Record(Plane)


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    key = Record

    def generic_resolve(self, value: Record, attr: str) -> Any:  # type: ignore[override]
        return value.fields[attr][1]


I1, I32, I64, DOUBLE = ir.IntType(1), ir.IntType(32), ir.IntType(64), ir.DoubleType()
MASK, INTEGERS, WORDS, DOUBLES, FLOATS = (ir.VectorType(one, LANES) for one in (I1, I32, I64, DOUBLE, ir.FloatType()))


def _model(kind: Any, value: Any) -> None:
    def begin(self: Any, manager: Any, of: Any) -> None:
        models.PrimitiveModel.__init__(self, manager, of, value)

    register_model(type(kind))(type(f"{kind.name}Model", (models.PrimitiveModel,), {"__init__": begin}))


_model(Lanes, DOUBLES)
_model(Mask, MASK)


@register_model(Record)
class _RecordModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, I64)


@lower_getattr_generic(Record)
def _field(context: Any, builder: Any, of: Record, value: Any, name: str) -> Any:
    words, kind = of.fields[name]
    return _word(builder, value, words) if kind == Whole else builder.add(value, I64(8 * words))


def _word(builder: Any, address: Any, words: int) -> Any:
    """A whole number of a record."""
    read = builder.load(_place(builder, address, I64(words), I64))
    read.set_metadata("invariant.load", builder.module.add_metadata([]))
    return read


def _constant(vector: Any, value: int) -> Any:
    return ir.Constant(vector, [value] * LANES)


def _broadcast(builder: Any, value: Any) -> Any:
    """A number in every lane; lanes as they are."""
    if value.type != DOUBLE:
        return value
    first = builder.insert_element(ir.Constant(DOUBLES, ir.Undefined), value, I32(0))
    return builder.shuffle_vector(first, first, _constant(INTEGERS, 0))


def _instruction(function: Any, emit: Callable[..., Any], result: Any, *signatures: tuple[Any, ...]) -> None:
    """Compile calls of a function with one of these signatures to what ``emit(builder, *args)`` writes."""
    cases = [result(*arguments) for arguments in signatures]
    first = {"target": "cpu"}  # before the templates of numbers and of arrays, which serve every target
    name, members = f"{function.__name__}Template", {"cases": cases, "metadata": first}
    infer_global(function)(type(name, (ConcreteTemplate,), members))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        written = emit(builder, *args)
        return context.get_dummy_value() if result is types.void else written

    for arguments in signatures:
        lower_builtin(function, *arguments)(lower)


def _of_two(function: Any, emit: Callable[..., Any], result: Any = Lanes) -> None:
    def broadcast(builder: Any, x: Any, y: Any) -> Any:
        return emit(builder, _broadcast(builder, x), _broadcast(builder, y))

    _instruction(function, broadcast, result, (Lanes, Lanes), (Lanes, Number), (Number, Lanes))


_of_two(operator.add, lambda builder, x, y: builder.fadd(x, y, flags=("contract",)))
_of_two(operator.sub, lambda builder, x, y: builder.fsub(x, y, flags=("contract",)))
_of_two(operator.mul, lambda builder, x, y: builder.fmul(x, y, flags=("contract",)))
_of_two(operator.truediv, lambda builder, x, y: builder.fdiv(x, y))
_of_two(operator.lt, lambda builder, x, y: builder.fcmp_ordered("<", x, y), Mask)
_of_two(operator.gt, lambda builder, x, y: builder.fcmp_ordered(">", x, y), Mask)
_of_two(operator.ge, lambda builder, x, y: builder.fcmp_ordered(">=", x, y), Mask)
_of_two(operator.le, lambda builder, x, y: builder.fcmp_ordered("<=", x, y), Mask)
_of_two(operator.eq, lambda builder, x, y: builder.fcmp_ordered("==", x, y), Mask)
_instruction(operator.and_, lambda builder, x, y: builder.and_(x, y), Mask, (Mask, Mask))
_instruction(operator.or_, lambda builder, x, y: builder.or_(x, y), Mask, (Mask, Mask))
_instruction(operator.invert, lambda builder, x: builder.not_(x), Mask, (Mask,))


def apart() -> None:
    """Have the function that says so called, not copied into its callers: they are optimised in less time."""


def lanes(value: Any) -> Any:
    """A number in every lane."""


def where(mask: Any, first: Any, second: Any) -> Any:
    """``first`` in the lanes of the mask, ``second`` in others."""


def any_of(mask: Any) -> Any:
    """Whether a lane is in the mask."""


def floor(x: Any) -> Any:
    """The largest whole number up to x."""


def absolute(x: Any) -> Any:
    """|x|."""


def power_of_two(x: Any) -> Any:
    """2^x of whole x between -1022 and 1023."""


def exponent(x: Any) -> Any:
    """The largest whole n with 2^n ≤ x, for positive normal x."""


def mantissa(x: Any) -> Any:
    """x / 2^n of that n, from 1 to 2."""


def at(plane: Any, t: Any, column: Any) -> Any:
    """The lanes at a step and a column."""


def put(plane: Any, t: Any, column: Any, value: Any) -> Any:
    """Write lanes, or a number to every lane."""


def whole(address: Any, index: Any) -> Any:
    """A whole number of those at an address."""


def number(address: Any, index: Any) -> Any:
    """A number of those at an address."""


def write(address: Any, index: Any, value: Any) -> Any:
    """Write a number among those at an address."""


def gather(first: Any, second: Any, third: Any, fourth: Any, single: Any) -> Any:
    """The numbers at four addresses, float32 where ``single``."""


def scatter(first: Any, second: Any, third: Any, fourth: Any, single: Any, value: Any) -> Any:
    """Write a number to each of four addresses."""


def gather_square(
    first: Any, second: Any, third: Any, fourth: Any, single: Any, plane: Any, t: Any, column: Any
) -> Any:
    """Write to four columns of a plane what stands at four addresses, four numbers side by side at each."""


def scatter_square(
    first: Any, second: Any, third: Any, fourth: Any, single: Any, plane: Any, t: Any, column: Any
) -> Any:
    """Write four columns of a plane to four addresses, four numbers side by side at each."""


def _where(builder: Any, mask: Any, first: Any, second: Any) -> Any:
    return builder.select(mask, _broadcast(builder, first), _broadcast(builder, second))


def _any_of(builder: Any, mask: Any) -> Any:
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, bits.type(0))


def _of_llvm(name: str) -> Callable[..., Any]:
    def emit(builder: Any, x: Any) -> Any:
        kind = ir.FunctionType(DOUBLES, [DOUBLES])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), [x])

    return emit


def _power_of_two(builder: Any, x: Any) -> Any:
    biased = builder.add(builder.fptosi(x, INTEGERS), _constant(INTEGERS, 1023))
    return builder.bitcast(builder.shl(builder.zext(biased, WORDS), _constant(WORDS, 52)), DOUBLES)


def _exponent(builder: Any, x: Any) -> Any:
    biased = builder.trunc(builder.lshr(builder.bitcast(x, WORDS), _constant(WORDS, 52)), INTEGERS)
    return builder.sitofp(builder.sub(biased, _constant(INTEGERS, 1023)), DOUBLES)


def _mantissa(builder: Any, x: Any) -> Any:
    fraction = builder.and_(builder.bitcast(x, WORDS), _constant(WORDS, (1 << 52) - 1))
    return builder.bitcast(builder.or_(fraction, _constant(WORDS, 1023 << 52)), DOUBLES)


def _place(builder: Any, address: Any, index: Any, kind: Any) -> Any:
    return builder.gep(builder.inttoptr(address, kind.as_pointer()), [index])


def _plane(builder: Any, plane: Any, t: Any, column: Any) -> Any:
    address, columns = _word(builder, plane, 0), _word(builder, plane, 1)
    return _place(builder, address, builder.add(builder.mul(t, columns), column), DOUBLES)


def _put(builder: Any, plane: Any, t: Any, column: Any, value: Any) -> None:
    builder.store(_broadcast(builder, value), _plane(builder, plane, t, column), align=8)


def _write(builder: Any, address: Any, index: Any, value: Any) -> None:
    builder.store(value, _place(builder, address, index, DOUBLE))


def _by_precision(emit: Callable[..., Any]) -> Callable[..., Any]:
    """What an ``emit`` of a vector of floats or of doubles writes, as the argument after the addresses says."""

    def both(builder: Any, *args: Any) -> Any:
        found = []
        with builder.if_else(args[LANES]) as branches:
            for branch, vector in zip(branches, (FLOATS, DOUBLES), strict=True):
                with branch:
                    found.append((emit(builder, vector, args[:LANES], args[LANES + 1 :]), builder.block))
        if found[0][0] is None:
            return None
        either = builder.phi(DOUBLES)
        for value, block in found:
            either.add_incoming(value, block)
        return either

    return both


def _doubles(builder: Any, values: Any) -> Any:
    return values if values.type == DOUBLES else builder.fpext(values, DOUBLES)


def _rounded(builder: Any, values: Any, vector: Any) -> Any:
    return values if vector == DOUBLES else builder.fptrunc(values, vector)


def _gather(builder: Any, vector: Any, addresses: Any, _: Any) -> Any:
    found = ir.Constant(vector, ir.Undefined)
    for lane, address in enumerate(addresses):
        one = builder.load(builder.inttoptr(address, vector.element.as_pointer()))
        found = builder.insert_element(found, one, I32(lane))
    return _doubles(builder, found)


def _scatter(builder: Any, vector: Any, addresses: Any, values: Any) -> None:
    own = _rounded(builder, values[0], vector)
    for lane, address in enumerate(addresses):
        one = builder.extract_element(own, I32(lane))
        builder.store(one, builder.inttoptr(address, one.type.as_pointer()))


def _transposed(builder: Any, rows: Any) -> list[Any]:
    def pick(first: Any, second: Any, places: list[int]) -> Any:
        return builder.shuffle_vector(first, second, ir.Constant(INTEGERS, places))

    low = [pick(rows[i], rows[i + 1], [0, 4, 1, 5]) for i in (0, 2)]
    high = [pick(rows[i], rows[i + 1], [2, 6, 3, 7]) for i in (0, 2)]
    return [pick(pair[0], pair[1], places) for pair in (low, high) for places in ([0, 1, 4, 5], [2, 3, 6, 7])]


def _gather_square(builder: Any, vector: Any, addresses: Any, place: Any) -> None:
    kind, align = vector.as_pointer(), 4 if vector == FLOATS else 8
    read = [builder.load(builder.inttoptr(address, kind), align=align) for address in addresses]
    plane, t, column = place
    for i, values in enumerate(_transposed(builder, read)):
        _put(builder, plane, t, builder.add(column, I64(i)), _doubles(builder, values))


def _scatter_square(builder: Any, vector: Any, addresses: Any, place: Any) -> None:
    plane, t, column = place
    read = [builder.load(_plane(builder, plane, t, builder.add(column, I64(i))), align=8) for i in range(LANES)]
    written = _transposed(builder, [_rounded(builder, values, vector) for values in read])
    for address, values in zip(addresses, written, strict=True):
        builder.store(values, builder.inttoptr(address, vector.as_pointer()), align=4 if vector == FLOATS else 8)


_instruction(apart, lambda builder: builder.function.attributes.add("noinline"), types.void, ())
_instruction(lanes, _broadcast, Lanes, (Number,))
_instruction(where, _where, Lanes, *((Mask, x, y) for x in (Lanes, Number) for y in (Lanes, Number)))
_instruction(any_of, _any_of, types.boolean, (Mask,))
_instruction(floor, _of_llvm("floor"), Lanes, (Lanes,))
_instruction(absolute, _of_llvm("fabs"), Lanes, (Lanes,))
_instruction(power_of_two, _power_of_two, Lanes, (Lanes,))
_instruction(exponent, _exponent, Lanes, (Lanes,))
_instruction(mantissa, _mantissa, Lanes, (Lanes,))
_instruction(at, lambda builder, *args: builder.load(_plane(builder, *args), align=8), Lanes, (Lines, Whole, Whole))
_instruction(put, _put, types.void, *((Lines, Whole, Whole, kind) for kind in (Lanes, Number)))
_instruction(
    whole, lambda builder, address, index: builder.load(_place(builder, address, index, I64)), Whole, (Whole, Whole)
)
_instruction(
    number,
    lambda builder, address, index: builder.load(_place(builder, address, index, DOUBLE)),
    Number,
    (Whole, Whole),
)
_instruction(write, _write, types.void, (Whole, Whole, Number))
_instruction(gather, _by_precision(_gather), Lanes, (*(Whole,) * LANES, types.boolean))
_instruction(scatter, _by_precision(_scatter), types.void, (*(Whole,) * LANES, types.boolean, Lanes))
for _function, _emit in ((gather_square, _gather_square), (scatter_square, _scatter_square)):
    _instruction(_function, _by_precision(_emit), types.void, (*(Whole,) * LANES, types.boolean, Lines, Whole, Whole))


def record(function: Any, of: type) -> None:
    """Compile calls of ``function(address, index)``: of the records side by side at an address, the one at an index."""
    kind = Record(of)

    def emit(builder: Any, address: Any, index: Any) -> Any:
        return builder.add(address, builder.mul(index, I64(8 * kind.words)))

    _instruction(function, emit, kind, (Whole, Whole))


LOG2_E = math.log2(math.e)
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
SMALLEST = -708.0
"""exp of less is 0 here; as a float64 it would be a subnormal number."""

CENTRE = 3.0
SCALED_ERFC = (
    0.0, 0.0, -3.451497488052316e-11, 8.393734858669998e-10, 1.201971944036733e-09, -8.217595058699489e-09,
    -1.3906145791791663e-08, 4.106401366791042e-08, 1.0277997488280234e-07, -1.404765431542417e-07,
    -6.175617678993209e-07, 3.5576086684076704e-07, 3.4730241678415896e-06, -7.308281468783382e-07,
    -2.0100843094844752e-05, 4.949196649968336e-06, 0.0001250994355712812, -0.00010515971958448065,
    -0.0007798322884823084, 0.0018886903449991718, 0.0025293918180474668, -0.02377051491717134, 0.06830802734384515,
    -0.11927366341538638, 0.12964515870276475, -0.0475622943534492, -0.1356211061245812, 1.2530080582697296,
)  # fmt: skip
"""(1 + 2z) exp(z²) erfc(z) for z ≥ 0 as a polynomial in (z - 3)/(z + 3), highest power first, after Shepherd and
Laframboise (1981). Their number is a multiple of four."""

SQRT_HALF, SQRT_2_OVER_PI = math.sqrt(0.5), math.sqrt(2 / math.pi)


@jit
def exponential(x: Any) -> Any:
    """exp(x) of lanes: relative error below 5e-16, 0 below :data:`SMALLEST`, NaN for NaN, exp(709) at least above."""
    within = where(x > SMALLEST, where(x < 709.0, x, 709.0), SMALLEST)
    k = floor(within * LOG2_E + 0.5)
    r = x - k * LN2_HIGH - k * LN2_LOW
    q = r * 2.08767569878681e-09 + 2.505210838544172e-08
    q = q * r + 2.755731922398589e-07
    q = q * r + 2.7557319223985893e-06
    q = q * r + 2.48015873015873e-05
    q = q * r + 0.0001984126984126984
    q = q * r + 0.001388888888888889
    q = q * r + 0.008333333333333333
    q = q * r + 0.041666666666666664
    q = q * r + 0.16666666666666666
    q = q * r + 0.5
    q = q * r + 1.0
    return where(x < SMALLEST, 0.0, (q * r + 1.0) * power_of_two(k))


@jit
def logarithm(x: Any) -> Any:
    """log(x) of lanes that are positive and normal: error below 5e-16, relative or absolute; NaN for NaN."""
    part, k = mantissa(x), exponent(x)
    high = part > 1.4142135623730951
    m, k = where(high, part * 0.5, part), where(high, k + 1.0, k)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    q = z * (1.0 / 21.0) + 1.0 / 19.0
    q = q * z + 1.0 / 17.0
    q = q * z + 1.0 / 15.0
    q = q * z + 1.0 / 13.0
    q = q * z + 1.0 / 11.0
    q = q * z + 1.0 / 9.0
    q = q * z + 1.0 / 7.0
    q = q * z + 1.0 / 5.0
    q = q * z + 1.0 / 3.0
    value = k * LN2_HIGH + (s * 2.0 + (s * z * q * 2.0 + k * LN2_LOW))
    return where(x == x, value, x)


@jit
def log_normal_cdf(x: Any) -> Any:
    """log Φ(x) of lanes, and its derivative φ(x) / Φ(x).

    log Φ has an error of at most 2e-15, relative or absolute; the derivative has a relative one of at most 4e-15.
    """
    z = absolute(x) * SQRT_HALF
    far, denominator = z + CENTRE, z * 2.0 + 1.0
    inverse = 1.0 / (far * denominator)
    t = (z - CENTRE) * denominator * inverse
    fourth = t * t * (t * t)
    a, b, c, d = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
    for i in range(0, len(SCALED_ERFC), 4):  # four chains, which do not wait for each other
        a, b = a * fourth + SCALED_ERFC[i], b * fourth + SCALED_ERFC[i + 1]
        c, d = c * fourth + SCALED_ERFC[i + 2], d * fourth + SCALED_ERFC[i + 3]
    ratio = ((a * t + b) * t + c) * t + d
    square = x * x * -0.5
    density = exponential(square)
    below = ratio * 0.5 * far * inverse  # Φ(x) / exp(-x²/2) of a negative x
    low = x <= 0.0
    part = where(low, below, 1.0 - density * below)
    slope = where(low, 1.0, density) * (0.5 * SQRT_2_OVER_PI) / part
    return logarithm(part) + where(low, square, 0.0), slope
