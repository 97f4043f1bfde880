"""Thirty-two pairs at a time: the steps of `pairs` in loops that a CPU's compiler turns into vector instructions.

Each step is a loop over the lanes of a block.  What a pair needs of its star and tracks stands in two rows, which are
loaded by fours and eights and turned into lanes in registers, where a gather would load every number alone.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import float32, int32, njit, types, uint32
from numba.core.errors import TypingError
from numba.extending import intrinsic

from porrima.elementary import TAIL, bits, from_bits, normal_argument, normal_centre, normal_tail
from porrima.moments import N_MOMENTS
from porrima.pairs import (
    BASE,
    CUT,
    DIMMING,
    FRACTION,
    MASS,
    Q_FLAT,
    Q_SLOPE,
    Q_START,
    SIGMA,
    TRUNCATION,
    W0,
    WIDTH,
    A,
    add_moments,
    axis_argument,
    companion_mass,
    direction,
    flux_ratio,
    is_too_many,
    phase_word,
    place_on_track,
    primary,
    random_words,
    separation,
)  # fmt: skip

__all__ = [
    "BLOCK_SIZE",
    "LANES",
    "draw_block",
    "flush",
    "keep_block",
    "keep_lanes",
    "sum_block",
    "weigh_block",
]

LANES = 32
"""Pairs in a block: enough for a CPU to work on four vectors of eight at once."""

_SUM_LANES = 8

X, Y, SEPARATION, FLUX_RATIO, KEPT, VALID = (row * LANES for row in range(6))
"""Rows of a block: companion from primary and the length of that in `pairs.CUT`, flux ratio, weight in the stack (0
where the pair is resolved or not wanted), and 1, or 0 where there are too many of its star."""

_MASS, _PLACE, NUMBER, _ROW_NUMBER, _AXIS, _TAIL_X, _TAIL_W, _LEFT, _RIGHT = (
    row * LANES for row in range(6, 15)
)
"""More rows: log2 of the companion's mass and its place on the grid; as bits, the number of the star and of a row of
tracks; log2 of the semi-major axis and what it follows from; `light` on either side of the place."""

_STAR, _WORD = 15 * LANES, 23 * LANES
"""Rows of a block: the first eight columns of its stars, and five random words as bits."""

_SUMS = 28 * LANES
"""Sums of the moments of all blocks that wait to be flushed, rows of `_SUM_LANES`."""

BLOCK_SIZE = _SUMS + N_MOMENTS * _SUM_LANES
"""Numbers in a block: one flat array, since with distances that it knows the compiler vectorises without asking."""


_PLACE_TYPE = ir.IntType(64)


class _Rows:
    """Loads from arrays and stores to a block, the last of them, as an intrinsic writes them down."""

    def __init__(self, context: Any, builder: Any, kinds: Any, arrays: Any) -> None:
        self.builder = builder
        self.arrays = [
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(kinds, arrays, strict=True)
        ]

    def _pointer(self, array: int, place: Any, kind: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(self.arrays[array], [place]), kind.as_pointer())

    def number(self, place: int) -> Any:
        """Number that stands as bits in a place of the block."""
        number = self.builder.load(self._pointer(-1, _PLACE_TYPE(place), ir.IntType(32)))
        return self.builder.zext(number, _PLACE_TYPE)

    def load(self, array: int, row: Any, width: int, column: int, size: int) -> Any:
        """So many numbers from a column on, of a row of a table of that width."""
        place = self.builder.add(self.builder.mul(row, _PLACE_TYPE(width)), _PLACE_TYPE(column))
        return self.builder.load(self._pointer(array, place, ir.VectorType(ir.FloatType(), size)), align=4)

    def store(self, vector: Any, place: int) -> None:
        """Put a vector into the block."""
        self.builder.store(vector, self._pointer(-1, _PLACE_TYPE(place), vector.type), align=4)

    def mixed(self, a: Any, b: Any, lanes: list[int]) -> Any:
        """Lanes of two vectors, those of the second numbered on."""
        return self.builder.shuffle_vector(
            a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)
        )

    def woven(self, a: Any, b: Any, size: int) -> tuple[Any, Any]:
        """The lower halves of both fours of two vectors of eight, `size` lanes of each in turn, and the upper ones."""
        lower = [0, 8, 1, 9, 4, 12, 5, 13] if size == 1 else [0, 1, 8, 9, 4, 5, 12, 13]
        return self.mixed(a, b, lower), self.mixed(a, b, [lane + 2 for lane in lower])


_LOWER, _UPPER = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]


@intrinsic
def _take_stars(_context, star, block):  # type: ignore[no-untyped-def]
    """The first columns of the stars whose numbers stand in a block: eight rows at a time, four columns of each."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        rows = _Rows(context, builder, signature.args, arguments)
        for lane, column in ((lane, column) for lane in range(0, LANES, 8) for column in (0, 4)):
            fours = [rows.load(0, rows.number(NUMBER + lane + k), WIDTH, column, 4) for k in range(8)]
            a, b, c, d = (rows.mixed(fours[k], fours[k + 4], list(range(8))) for k in range(4))
            (a, b), (c, d) = rows.woven(a, b, 1), rows.woven(c, d, 1)
            for k, turned in enumerate((*rows.woven(a, c, 2), *rows.woven(b, d, 2))):
                rows.store(turned, _STAR + (column + k) * LANES + lane)
        return context.get_dummy_value()

    return types.void(*_by_rows(star, block)), code


@intrinsic
def _take_tracks(_context, star, track, block):  # type: ignore[no-untyped-def]
    """`light` of the track rows whose numbers stand in a block: each is weighed whole and summed while it is turned."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        rows = _Rows(context, builder, signature.args, arguments)

        def weighed(lane: int) -> Any:
            own = rows.number(NUMBER + lane)
            weight, dimming = rows.load(0, own, WIDTH, W0, 4), rows.load(0, own, WIDTH, DIMMING, 1)
            row = rows.load(1, rows.number(_ROW_NUMBER + lane), 8, 0, 8)
            product = builder.fmul(row, rows.mixed(weight, weight, [0, 1, 2, 3] * 2), flags=("contract",))
            return builder.fadd(product, rows.mixed(dimming, dimming, [0] * 8), flags=("contract",))

        for lane in range(0, LANES, 8):
            parts = [weighed(lane + k) for k in range(8)]
            for size in (1, 2):
                parts = [
                    builder.fadd(*rows.woven(a, b, size))
                    for a, b in zip(parts[::2], parts[1::2], strict=True)
                ]
            early, late = parts
            rows.store(rows.mixed(early, late, _LOWER), _LEFT + lane)
            rows.store(rows.mixed(early, late, _UPPER), _RIGHT + lane)
        return context.get_dummy_value()

    return types.void(*_by_rows(star, track, block)), code


def _by_rows(*arrays: Any) -> tuple[Any, ...]:
    """The same types, where all are contiguous."""
    for array in arrays:
        if array.layout != "C":
            raise TypingError(f"tables must be contiguous by rows, got {array}")
    return arrays


@intrinsic
def _take_sum(_context, block, row):  # type: ignore[no-untyped-def]
    """Sum over the lanes of a row, halves added to halves; the row is set to zero."""

    def code(context, builder, _signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(block)(context, builder, arguments[0]).data
        lanes = ir.VectorType(ir.FloatType(), _SUM_LANES)
        start = context.cast(builder, arguments[1], row, types.int64)
        pointer = builder.bitcast(builder.gep(array, [start]), lanes.as_pointer())
        total, size = builder.load(pointer, align=4), _SUM_LANES
        while size > 1:
            size //= 2
            low, high = (
                ir.Constant(ir.VectorType(ir.IntType(32), size), list(range(first, first + size)))
                for first in (0, size)
            )
            total = builder.fadd(
                builder.shuffle_vector(total, total, low), builder.shuffle_vector(total, total, high)
            )
        builder.store(ir.Constant(lanes, [0.0] * _SUM_LANES), pointer, align=4)
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return types.float32(block, row), code


_loop = njit(forceinline=True, _nrt=False, fastmath={"contract"}, error_model="numpy")


@_loop
def _draw_words(isotropic, block, key_low, key_high, stack_low, stack_high, first):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        words = random_words(key_low, key_high, stack_low, stack_high, uint32(first + lane))
        block[_WORD + lane] = from_bits(int32(words[0]))
        block[_WORD + LANES + lane] = from_bits(int32(words[1]))
        block[_WORD + 2 * LANES + lane] = from_bits(int32(words[2]))
        block[_WORD + 3 * LANES + lane] = from_bits(int32(words[3]))
    if not isotropic:
        for lane in range(LANES):
            word = phase_word(key_low, key_high, stack_low, stack_high, uint32(first + lane))
            block[_WORD + 4 * LANES + lane] = from_bits(int32(word))


@_loop
def _primaries(alias, block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        block[NUMBER + lane] = from_bits(int32(primary(uint32(bits(block[_WORD + lane])), alias)))


@_loop
def _axes(block):  # type: ignore[no-untyped-def]
    """Binary logarithm of the semi-major axes; the tail of the normal law only where a lane is in it."""
    tails = int32(0)
    for lane in range(LANES):
        x = axis_argument(
            uint32(bits(block[_WORD + 2 * LANES + lane])), block[_STAR + TRUNCATION * LANES + lane]
        )
        w = normal_argument(x)
        block[_TAIL_X + lane], block[_TAIL_W + lane] = x, w
        tails |= int32(w >= float32(TAIL))
        block[_AXIS + lane] = block[_STAR + A * LANES + lane] + block[
            _STAR + SIGMA * LANES + lane
        ] * normal_centre(x, w)
    if tails != 0:
        for lane in range(LANES):
            x, w = block[_TAIL_X + lane], block[_TAIL_W + lane]
            far = block[_STAR + A * LANES + lane] + block[_STAR + SIGMA * LANES + lane] * normal_tail(x, w)
            block[_AXIS + lane] = block[_AXIS + lane] if w < float32(TAIL) else far


@_loop
def _separations(isotropic, block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        turn = uint32(bits(block[_WORD + 3 * LANES + lane]))
        r = separation(isotropic, block[_AXIS + lane], turn, uint32(bits(block[_WORD + 4 * LANES + lane])))
        cosine, sine = direction(turn)
        block[X + lane], block[Y + lane], block[SEPARATION + lane] = r * cosine, r * sine, r


@_loop
def _companion_masses(block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        block[_MASS + lane] = companion_mass(
            uint32(bits(block[_WORD + LANES + lane])), block[_STAR + MASS * LANES + lane],
            block[_STAR + Q_SLOPE * LANES + lane], block[_STAR + Q_START * LANES + lane],
            block[_STAR + Q_FLAT * LANES + lane],
        )  # fmt: skip


@_loop
def _places(start, per_unit, n_grid, block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        k, t = place_on_track(block[_MASS + lane], start, per_unit, n_grid)
        row = bits(block[_STAR + BASE * LANES + lane]) + k
        block[_ROW_NUMBER + lane], block[_PLACE + lane] = from_bits(int32(row)), t


@_loop
def _flux_ratios(log_dark, block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        block[FLUX_RATIO + lane] = flux_ratio(
            block[_LEFT + lane], block[_RIGHT + lane], block[_PLACE + lane], block[_MASS + lane] < log_dark
        )


@_loop
def _validity(scale, is_capped, star, block):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        block[VALID + lane] = float32(1)
    if is_capped:
        for lane in range(LANES):
            mass_word = uint32(bits(block[_WORD + LANES + lane]))
            axis_word = uint32(bits(block[_WORD + 2 * LANES + lane]))
            fraction = star[bits(block[NUMBER + lane]), FRACTION]
            block[VALID + lane] = float32(not is_too_many(mass_word, axis_word, scale, fraction))


@_loop
def draw_numbers(tables, block, key_low, key_high, stack_low, stack_high, first):  # type: ignore[no-untyped-def]
    """The random part of `draw_block` alone, with whatever stars and laws the block holds: the least it can cost."""
    _draw_words(tables.isotropic, block, key_low, key_high, stack_low, stack_high, first)
    _primaries(tables.alias, block)
    _axes(block)
    _separations(tables.isotropic, block)
    _companion_masses(block)


@_loop
def draw_block(tables, block, scale, key_low, key_high, stack_low, stack_high, first):  # type: ignore[no-untyped-def]
    """Draw the pairs of one block; `first` is the number of the first in its stack."""
    _draw_words(tables.isotropic, block, key_low, key_high, stack_low, stack_high, first)
    _primaries(tables.alias, block)
    _take_stars(tables.star, block)
    _axes(block)
    _separations(tables.isotropic, block)
    _companion_masses(block)
    _places(tables.grid_start, tables.grid_per_unit, tables.n_grid, block)
    _take_tracks(tables.star, tables.track, block)
    _flux_ratios(tables.log_dark, block)
    _validity(scale, scale * tables.largest_fraction > 1.0, tables.star, block)


@_loop
def keep_block(block):  # type: ignore[no-untyped-def]
    """Keep every valid pair of a block that is not resolved; how many are valid, and how many of them kept."""
    valid, kept = int32(0), int32(0)
    for lane in range(LANES):
        is_valid = block[VALID + lane] > float32(0)
        is_kept = is_valid and block[SEPARATION + lane] < float32(CUT)
        block[KEPT + lane] = float32(1) if is_kept else float32(0)
        valid += int32(is_valid)
        kept += int32(is_kept)
    return valid, kept


@_loop
def keep_lanes(block, lane, wanted):  # type: ignore[no-untyped-def]
    """The same from a lane on for as many valid pairs as are wanted; the next lane, how many are valid, and kept."""
    valid, kept = int32(0), int32(0)
    if lane == 0:
        for k in range(LANES):
            block[KEPT + k] = float32(0)
    while lane < LANES and valid < wanted:
        is_valid = block[VALID + lane] > float32(0)
        is_kept = is_valid & (block[SEPARATION + lane] < float32(CUT))
        block[KEPT + lane] = float32(is_kept)
        valid += int32(is_valid)
        kept += int32(is_kept)
        lane += 1
    return lane, valid, kept


@_loop
def weigh_block(weight, block):  # type: ignore[no-untyped-def]
    """Total weight of the kept pairs of a block, each given that of its star."""
    total = 0.0
    for lane in range(LANES):
        block[KEPT + lane] *= weight[bits(block[NUMBER + lane])]
        total += block[KEPT + lane]
    return total


@_loop
def sum_block(block):  # type: ignore[no-untyped-def]
    """Add the kernel moments of the kept pairs of a block, each fourth of its lanes to the same sums."""
    for lane in range(_SUM_LANES):
        _add_lane(block, lane, lane)
        _add_lane(block, lane + _SUM_LANES, lane)
        _add_lane(block, lane + 2 * _SUM_LANES, lane)
        _add_lane(block, lane + 3 * _SUM_LANES, lane)


@njit(inline="always", _nrt=False)
def _add_lane(block, lane, to):  # type: ignore[no-untyped-def]
    kept, f, x, y = block[KEPT + lane], block[FLUX_RATIO + lane], block[X + lane], block[Y + lane]
    add_moments(block, _SUMS + to, _SUM_LANES, kept, f, x, y)


@_loop
def flush(block, total):  # type: ignore[no-untyped-def]
    """Move the sums of a block to one float64 total per moment."""
    for k in range(N_MOMENTS):
        total[k] += _take_sum(block, _SUMS + k * _SUM_LANES)
