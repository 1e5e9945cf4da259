"""Front-to-back blending of a tile's Gaussians, and its derivative.

One lane is one tile of TILE x TILE pixels whose transmittances and colours are loop
variables: what a lane gathers serves all of its pixels. The sign of a transmittance
marks a pixel that has stopped; its size stays what it was.
"""

import functools
import operator
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile.binning import TILE
from mi_splat.render.tile.projection import CUTOFF

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
# floats of a record in the first of its two arrays; the ninth is in the second
RECORD = 8

_EXP2 = (1.0, 0.69314700, 0.24022242, 0.055507336, 0.009671513, 0.0013264727)
_PIXELS = range(TILE * TILE)


class Record:
    """The numbers of a Gaussian as seen from a tile's first pixel centre: (x, y) is the
    offset from its centre.
    """

    def __init__(self, values: list[Any]) -> None:
        self.x, self.y, self.u0, self.u1, self.v1, self.level = values[:6]
        self.colour = values[6:9]
        self.depth = values[9] if len(values) > 9 else None

    def alphas(self) -> list[Any]:
        """Unclamped alpha at every pixel of the tile, 0 where it is below 1/255."""
        values = []
        for row in range(TILE):
            dy = self.y + float(row)
            u = dr.fma(self.u0, self.x, self.u1 * dy)
            v = self.v1 * dy
            rest = dr.fma(-v, v, self.level)
            for _ in range(TILE):
                power = dr.fma(-u, u, rest)
                values.append(dr.select(power >= CUTOFF, exp2_of_alpha(power), 0.0))
                u = u + self.u0
        return values


def read_record(
    records: tuple[Any, ...], index: Any, corner: tuple[Any, Any]
) -> list[Any]:
    """The values of a `Record`, which a loop may carry."""
    v = dr.gather(mi.ArrayXf, records[0], index, shape=(RECORD, dr.width(index)))
    others = [dr.gather(mi.Float, single, index) for single in records[1:]]
    return [
        corner[0] - v[0],
        corner[1] - v[1],
        *(v[k] for k in range(2, RECORD)),
        *others,
    ]


def exp2_of_alpha(power: Any) -> Any:
    """2^x for x in [CUTOFF, 0.1], within 2e-7 of it; other values have no meaning.

    A polynomial for the fraction, and the whole part added to its exponent: half of the
    operations of `dr.exp2`, which has to be right everywhere. The coefficients are the
    fit of degree 5 with the smallest relative error on [-0.5, 0.5] that is 1 at 0
    (least squares, reweighted until all its maxima are equal: 9e-8). Where the machine
    has an instruction for it, as CUDA does, that is taken.
    """
    if dr.backend_v(power) != dr.JitBackend.LLVM:
        return dr.exp2(power)
    whole = dr.round(power)
    fraction = power - whole
    value = mi.Float(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        value = dr.fma(value, fraction, coefficient)
    return dr.reinterpret_array(
        mi.Float, dr.reinterpret_array(mi.Int32, value) + (mi.Int32(whole) << 23)
    )


def first_pixel(tile: Any, columns: Any) -> tuple[Any, Any]:
    """Pixel coordinates of the centre of a tile's first pixel."""
    row = tile // columns
    return mi.Float((tile - row * columns) * TILE) + 0.5, mi.Float(row * TILE) + 0.5


def blend_step(alpha: Any, transmittance: Any) -> tuple[Any, Any]:
    """Weight of a Gaussian at a pixel and the transmittance behind it (negative once
    the pixel has stopped).
    """
    behind = dr.fma(-alpha, transmittance, transmittance)
    stop = behind < MIN_TRANSMITTANCE
    return dr.select(stop, 0.0, alpha * transmittance), dr.select(
        stop, -dr.abs(transmittance), behind
    )


def any_open(transmittances: list[Any]) -> Any:
    """Whether any pixel of the tile has not stopped: whether the sign bits are not all
    set.
    """
    return (
        functools.reduce(
            operator.and_, (dr.reinterpret_array(mi.Int32, t) for t in transmittances)
        )
        >= 0
    )


def first_of_list(gaussians: Any, pair_range: tuple[Any, Any]) -> tuple[Any, Any]:
    """A tile's first pair and the Gaussian of it; its range may be empty."""
    return mi.UInt32(pair_range[0]), dr.gather(
        mi.UInt32, gaussians, pair_range[0], pair_range[0] < pair_range[1]
    )


def next_of_list(
    gaussians: Any, pair_range: tuple[Any, Any], pair: Any
) -> tuple[Any, Any]:
    """The next pair and the Gaussian of it, if there is one."""
    return pair + 1, dr.gather(mi.UInt32, gaussians, pair + 1, pair + 1 < pair_range[1])


def blend_tile(
    records: tuple[Any, ...],
    gaussians: Any,
    pair_range: tuple[Any, Any],
    corner: tuple[Any, Any],
) -> tuple[list[Any], list[Any], Any]:
    """Blend every tile: colour and transmittance of its pixels (four numbers each),
    depths, and where it stopped.
    """
    # What a step blends was read in the step before it, so that arithmetic hides the
    # wait for memory. Dr.Jit orders the arithmetic as the state: pixel by pixel, so
    # that no weight has to be kept for later.
    first, gaussian = first_of_list(gaussians, pair_range)
    start = (
        *next_of_list(gaussians, pair_range, first),
        read_record(records, gaussian, corner),
        [[mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(1)] for _ in _PIXELS],
        [mi.Float(0) for _ in range(3 * TILE * TILE if len(records) > 2 else 0)],
    )

    def body(
        following: Any,
        gaussian: Any,
        values: list[Any],
        pixels: list[list[Any]],
        depths: list[Any],
    ) -> Any:
        record = Record(values)
        values = read_record(records, gaussian, corner)
        blended = []
        measured = list(depths)
        for p, alpha in enumerate(record.alphas()):
            *colour, transmittance = pixels[p]
            weight, left = blend_step(dr.minimum(alpha, MAX_ALPHA), transmittance)
            blended.append(
                [
                    *(
                        dr.fma(weight, own, sum)
                        for own, sum in zip(record.colour, colour, strict=True)
                    ),
                    left,
                ]
            )
            if measured:
                halved = (transmittance > 0.5) & (left <= 0.5)
                total = TILE * TILE + p
                summed_depth = 2 * TILE * TILE + p
                measured[p] = dr.select(halved, record.depth, measured[p])
                measured[total] = measured[total] + weight
                measured[summed_depth] = dr.fma(
                    weight, record.depth, measured[summed_depth]
                )
        return (
            *next_of_list(gaussians, pair_range, following),
            values,
            blended,
            measured,
        )

    following, _, _, pixels, depths = dr.while_loop(
        start,
        lambda following, _, values, pixels, *others: (
            (following <= pair_range[1]) & any_open([pixel[3] for pixel in pixels])
        ),
        body,
        label="blend",
    )
    return (
        [value for *colour, t in pixels for value in (*colour, dr.abs(t))],
        depths,
        following - 1,
    )


def blend_tile_backward(
    records: tuple[Any, ...],
    pairs: tuple[Any, Any],
    pair_range: tuple[Any, Any],
    corner: tuple[Any, Any],
    pixels: tuple[list[Any], list[Any], list[tuple[Any, Any]], list[Any]],
    moments: tuple[Any, ...],
) -> Any:
    """Walk every tile's list again and store each pair's share of the gradient in the
    pair's own row.

    For h = alpha dL/dalpha at a pixel and (dx, dy) from the Gaussian's centre, a row
    holds the sums over the tile of h, h dx, h dy, h dx^2, h dx dy, h dy^2 and of weight
    times dL/dcolour (and, with depths, of dL/d(expected depth) times weight over the
    sum of weights); no two lanes write to one row, so the result does not depend on the
    order of execution. An expected depth D moves with weight w_i by (z_i - D) over that
    sum; the sum of w_i (z_i - D) is 0.
    """
    grad_colour, grad_opacity, grad_depth, weighted = pixels
    first, gaussian = first_of_list(pairs[0], pair_range)
    values = read_record(records, gaussian, corner)
    start = (
        *next_of_list(pairs[0], pair_range, first),
        values,
        [[mi.Float(1), rest] for rest in weighted],
    )
    n = TILE * TILE

    def body(
        following: Any, gaussian: Any, values: list[Any], states: list[list[Any]]
    ) -> Any:
        record = Record(values)
        values = read_record(records, gaussian, corner)
        behind = []
        colour_sums = [mi.Float(0)] * 3
        depth_sum = mi.Float(0)
        rows = []
        alphas = record.alphas()
        for row in range(TILE):
            m0 = mi.Float(0)
            m1 = mi.Float(0)
            m2 = mi.Float(0)
            for column in range(TILE):
                p = row * TILE + column
                alpha = dr.minimum(alphas[p], MAX_ALPHA)
                transmittance, remaining = states[p]
                weight, left = blend_step(alpha, transmittance)
                gain = record.colour[0] * grad_colour[p]
                gain = dr.fma(record.colour[1], grad_colour[n + p], gain)
                gain = dr.fma(record.colour[2], grad_colour[2 * n + p], gain)
                if grad_opacity:
                    gain = gain + grad_opacity[p]
                if grad_depth:
                    slope, expected = grad_depth[p]
                    gain = dr.fma(record.depth - expected, slope, gain)
                    depth_sum = dr.fma(weight, slope, depth_sum)
                rest = dr.fma(-weight, gain, remaining)
                # alpha dL/dalpha = weight gain - rest alpha / (1 - alpha); zero where
                # clamped, skipped or stopped
                h = dr.fma(weight, gain, -rest * alpha / (1.0 - alpha))
                h = dr.select((weight > 0.0) & (alphas[p] < MAX_ALPHA), h, 0.0)
                dx = record.x + float(column)
                m0 = m0 + h
                m1 = dr.fma(h, dx, m1)
                m2 = dr.fma(h * dx, dx, m2)
                for c in range(3):
                    colour_sums[c] = dr.fma(
                        weight, grad_colour[c * n + p], colour_sums[c]
                    )
                behind.append([left, rest])
            rows.append((m0, m1, m2))
        s = [mi.Float(0)] * 6
        for row, (m0, m1, m2) in enumerate(rows):
            dy = record.y + float(row)
            s = [
                s[0] + m0,
                s[1] + m1,
                dr.fma(m0, dy, s[2]),
                s[3] + m2,
                dr.fma(m1, dy, s[4]),
                dr.fma(m0 * dy, dy, s[5]),
            ]
        index = dr.gather(mi.UInt32, pairs[1], following - 1)
        dr.scatter(moments[0], mi.ArrayXf([*s, colour_sums[0], colour_sums[1]]), index)
        dr.scatter(moments[1], colour_sums[2], index)
        if grad_depth:
            dr.scatter(moments[2], depth_sum, index)
        return *next_of_list(pairs[0], pair_range, following), values, behind

    following, *_ = dr.while_loop(
        start,
        lambda following, _, values, states: (
            (following <= pair_range[1]) & any_open([state[0] for state in states])
        ),
        body,
        label="blend backward",
    )
    return following - 1


def clear_rows(
    rows: Any, pair_range: tuple[Any, Any], moments: tuple[Any, ...]
) -> None:
    """Set the rows of pairs behind the last one that was walked to 0.

    A loop beside the other one slows that down.
    """

    def clear(pair: Any) -> tuple[Any]:
        index = dr.gather(mi.UInt32, rows, pair)
        dr.scatter(moments[0], mi.ArrayXf([mi.Float(0)] * RECORD), index)
        for single in moments[1:]:
            dr.scatter(single, mi.Float(0), index)
        return (pair + 1,)

    dr.while_loop(
        (mi.UInt32(pair_range[0]),),
        lambda pair: pair < pair_range[1],
        clear,
        label="hidden pairs",
    )
