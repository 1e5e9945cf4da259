"""An image from colours alone, and the gradient of colours: the two frozen stages of a
`FrozenView`.

Both are products with the matrix of weights that `weights` keeps, walked tile by tile.
The rules of README.md hold.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile.frozen import aligned, buffer, run
from mi_splat.render.tile.layouts import rows_of
from mi_splat.render.tile.weights import GROUP, PIXELS, FrozenPairs


def picture_of(frozen: FrozenPairs, terms: int, sh: Any) -> tuple[Any, Any]:
    """The image (Float, 3 a pixel, row-major) of these SH (Float, 3 `terms` a free
    Gaussian), and their colours.
    """
    colours = buffer(4 * len(frozen.columns))
    return run(colour_forward, terms, aligned(sh), frozen, colours), colours


def gradient_of(
    frozen: FrozenPairs, terms: int, colours: Any, grad_picture: Any
) -> Any:
    """dL/d(SH), Float, 3 `terms` a free Gaussian."""
    grad_sh = buffer(3 * terms * len(frozen.columns))
    run(colour_backward, terms, aligned(grad_picture), frozen, colours, grad_sh)
    return grad_sh


def colour_forward(terms: int, sh: Any, frozen: FrozenPairs, colours: Any) -> Any:
    """Blend the free Gaussians' colours over the constant part of the image."""
    column = frozen.columns
    row = rows_of(sh, column, 3 * terms)
    basis = _basis(frozen, terms)
    values = []
    for c in range(3):
        total = mi.Float(0.5)
        for k in range(terms):
            total = dr.fma(basis[k], row[3 * k + c], total)
        # what is not a number stays so
        values.append(dr.select(total <= 0.0, 0.0, total))
    dr.scatter(colours, mi.ArrayXf([*values, mi.Float(0)]), column)
    dr.eval(colours)

    def body(pair: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        colour = rows_of(colours, dr.gather(mi.UInt32, frozen.pairs[0], pair), 4)
        weights = rows_of(frozen.weights, pair, PIXELS)
        return pair + GROUP, [
            dr.fma(weights[k // 3], colour[k % 3], total)
            for k, total in enumerate(sums)
        ]

    start, stop = frozen.ranges
    _, sums = dr.while_loop(
        (mi.UInt32(start), [mi.Float(0) for _ in range(3 * PIXELS)]),
        lambda pair, _: pair < stop,
        body,
        label="colours",
    )
    padded = [v for p in range(PIXELS) for v in (*sums[3 * p : 3 * p + 3], mi.Float(0))]
    dr.scatter(frozen.canvas, mi.ArrayXf(padded), frozen.slots)
    dr.eval(frozen.canvas)
    return frozen.base + dr.gather(mi.Float, frozen.canvas, frozen.where)


def colour_backward(
    terms: int, grad_picture: Any, frozen: FrozenPairs, colours: Any, grad_sh: Any
) -> None:
    """Gradient of SH from that of the image.

    Each pair sums into its own row: no atomics, one order.
    """
    dr.scatter(frozen.gradients, grad_picture, frozen.where)
    dr.eval(frozen.gradients)
    gradient = rows_of(frozen.gradients, frozen.slots, 4 * PIXELS)

    def body(pair: Any) -> tuple[Any]:
        weights = rows_of(frozen.weights, pair, PIXELS)
        totals = [weights[0] * gradient[c] for c in range(3)]
        for p in range(1, PIXELS):
            totals = [
                dr.fma(weights[p], gradient[4 * p + c], totals[c]) for c in range(3)
            ]
        row = dr.gather(mi.UInt32, frozen.pairs[1], pair)
        dr.scatter(frozen.sums, mi.ArrayXf([*totals, mi.Float(0)]), row)
        return (pair + GROUP,)

    start, stop = frozen.ranges
    dr.while_loop(
        (mi.UInt32(start),), lambda pair: pair < stop, body, label="colours backward"
    )
    dr.eval(frozen.sums)

    def add(row: Any, totals: list[Any]) -> tuple[Any, list[Any]]:
        values = rows_of(frozen.sums, row, 4)
        return row + 1, [totals[c] + values[c] for c in range(3)]

    first, last = frozen.rows
    zeros = [mi.Float(0) for _ in range(3)]
    _, totals = dr.while_loop(
        (mi.UInt32(first), zeros),
        lambda row, _: row < last,
        add,
        label="sum of colours",
    )
    colour = rows_of(colours, frozen.columns, 4)
    basis = _basis(frozen, terms)
    totals = [dr.select(colour[c] > 0.0, totals[c], 0.0) for c in range(3)]
    dr.scatter(
        grad_sh,
        mi.ArrayXf([basis[k] * totals[c] for k in range(terms) for c in range(3)]),
        frozen.columns,
    )
    dr.eval(grad_sh)


def _basis(frozen: FrozenPairs, terms: int) -> Any:
    """The SH basis functions of each free Gaussian."""
    x, y, z, _ = rows_of(frozen.directions, frozen.columns, 4)
    return dr.sh_eval(mi.Vector3f(x, y, z), math.isqrt(terms) - 1)
