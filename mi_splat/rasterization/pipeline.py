"""The rasteriser as two calls: a picture with what its derivative needs, and the derivative.

Tracing the kernels in Python costs several times their run time, so each stage is a frozen function that Dr.Jit
replays. Three rules keep a replay right when sizes change (README.md says how we know): every kernel reads at least
one array of its own length element by element, since the replay takes the kernel's length from it and would otherwise
guess; buffers that are scattered into are made outside and passed in; and `dr.argsort` stays outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.errors import MiSplatError, message
from mi_splat.rasterization import binning, blending, pinhole
from mi_splat.rasterization.binning import TILE
from mi_splat.rasterization.blending import RECORD
from mi_splat.rasterization.frozen import buffer, numbers, run
from mi_splat.rasterization.layouts import Layout
from mi_splat.rasterization.pinhole import Pinhole
from mi_splat.rasterization.projection import Gaussians, Splat, project

MAX_PAIRS = 1 << 28

_EMPTY = 0xFFFFFFFF
_LN2 = 0.6931471805599453


@dataclass(eq=False)
class PictureBuffers:
    """The picture that is made: its size, its tiles, and the arrays that it is written to."""

    size: Any  # Int32, width and height
    tiles: Any  # UInt32, 0, 1, 2, ...
    pixels: Any  # UInt32, 0, 1, 2, ...
    background: Any  # Float, 3 values
    colour: Any  # Float, row-major, 3 a pixel
    opacity: Any  # Float, row-major


@dataclass(frozen=True, eq=False)
class BackwardState:
    """What the backward pass needs of the forward pass."""

    frame: PictureBuffers
    view: Any
    records: tuple[Any, Any]
    places: tuple[Any, Any, Any]  # Gaussians in depth order, their first and one-past-last rows
    pairs: tuple[Any, Any]  # in tile order: Gaussian, and row before the sort by tile
    span: tuple[Any, ...]  # first and one-past-last pair of each tile


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What the forward pass returns and the backward pass needs again.

    Attributes:
        colour: Float, height x width x 3 values, row-major, background blended in.
        opacity: Float, height x width values of 1 - transmittance.
        state: What to hand to `rasterize_backward`, or None where nothing is visible.
    """

    colour: Any
    opacity: Any
    state: BackwardState | None


def _size(size: Any) -> tuple[Any, Any]:
    # At least 1: the idle lanes of the last packet read 0, and an integer division by that stops the process.
    width, height = (dr.gather(mi.Int32, size, mi.UInt32(i)) for i in range(2))
    return dr.maximum(width, 1), dr.maximum(height, 1)


def _project(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    index: Any,
    frame: PictureBuffers,
    view: Any,
    records: tuple[Any, Any],
) -> tuple[Any, Any]:
    """Stage 1: fill the Gaussians' records; return their sort keys and the number of tiles that each touches."""
    camera = pinhole.unpack(view)
    splat, extent, depth = project(layout.read(arrays, index, terms), camera)
    visible = (depth >= camera.near) & (extent.x >= 0.0)
    visible &= dr.isfinite(splat.u0 + splat.u1 + splat.v1 + splat.centre.x + splat.centre.y)
    width, height = _size(frame.size)
    count = binning.count_tiles(splat, extent, visible, width, height)
    components = splat.components()
    dr.scatter(records[0], mi.ArrayXf(components[:RECORD]), index)
    dr.scatter(records[1], components[RECORD], index)
    # Depths that count are positive, and positive floats sort like their bits.
    return dr.select(count > 0, dr.reinterpret_array(mi.UInt32, depth), _EMPTY), count


def _place(count: Any, order: Any) -> tuple[Any, Any, Any]:
    """Stage 2: first and one-past-last pair of the Gaussians in depth order, and the number of pairs."""
    counts = dr.gather(mi.UInt32, count, order)
    first = dr.prefix_sum(counts)
    return first, first + counts, dr.sum(counts)


def _splat_of(records: Any, index: Any) -> Splat:
    v = dr.gather(mi.ArrayXf, records, index, shape=(RECORD, dr.width(index)))
    return Splat(mi.Point2f(v[0], v[1]), v[2], v[3], v[4], v[5], mi.Color3f(0))


def _emit(records: Any, order: Any, first: Any, last: Any, size: Any, pairs: tuple[Any, Any]) -> None:
    """Stage 3: write the pairs' tiles and Gaussians, Gaussian by Gaussian from near to far."""
    binning.emit_pairs(_splat_of(records, order), order, (first, last), _size(size), *pairs)


def _columns(width: Any) -> Any:
    return (width + (TILE - 1)) // TILE


def _cell(pixel: Any, width: Any) -> Any:
    """Where a pixel lies in a buffer that holds the tiles one after another, 16 pixels each."""
    x, y = pixel % width, pixel // width
    tile = (y // TILE) * _columns(width) + x // TILE
    return mi.UInt32(tile * TILE * TILE + (y % TILE) * TILE + x % TILE)


def _blend(
    records: tuple[Any, Any],
    pairs: tuple[Any, Any],
    rows: Any,
    total: Any,
    frame: PictureBuffers,
    canvas: Any,
) -> tuple[Any, ...]:
    """Stage 4: blend every tile into `canvas`, then develop that to a row-major picture."""
    gaussians, keys = dr.gather(mi.UInt32, pairs[1], rows), dr.gather(mi.UInt32, pairs[0], rows)
    dr.eval(gaussians, keys)
    tile = frame.tiles
    start = binning.lower_bound(keys, total, tile)
    stop = binning.lower_bound(keys, total, tile + 1)
    dr.eval(start, stop)
    width, _ = _size(frame.size)
    place = blending.origin(mi.Int32(tile), _columns(width))
    colours, transmittances = blending.forward(records, gaussians, (start, stop), place)
    n = TILE * TILE
    values = [v for p in range(n) for v in (colours[p], colours[n + p], colours[2 * n + p], transmittances[p])]
    dr.scatter(canvas, mi.ArrayXf(values), tile)
    dr.eval(canvas)

    pixel = frame.pixels
    cell = _cell(mi.Int32(pixel), width)
    value = dr.gather(mi.ArrayXf, canvas, cell, shape=(4, dr.width(cell)))
    rgb = [dr.fma(value[3], dr.gather(mi.Float, frame.background, mi.UInt32(c)), value[c]) for c in range(3)]
    dr.scatter(frame.colour, mi.ArrayXf(rgb), pixel)
    dr.scatter(frame.opacity, 1.0 - value[3], pixel)
    dr.eval(frame.colour, frame.opacity)
    return gaussians, start, stop


def _spread(frame: PictureBuffers, grads: tuple[Any, ...], cells: tuple[Any, ...]) -> None:
    """Stage 5: the gradient of the picture, tile by tile: dL/dcolour and its product with what reached the pixel."""
    width, _ = _size(frame.size)
    pixel = frame.pixels
    cell = _cell(mi.Int32(pixel), width)
    grad_colour = dr.gather(mi.ArrayXf, grads[0], pixel, shape=(3, dr.width(pixel)))
    value = dr.gather(mi.ArrayXf, frame.colour, pixel, shape=(3, dr.width(pixel)))
    rest = grad_colour[0] * value[0] + grad_colour[1] * value[1] + grad_colour[2] * value[2]
    if len(grads) > 1:
        grad_alpha = dr.gather(mi.Float, grads[1], pixel)
        rest += grad_alpha * dr.gather(mi.Float, frame.opacity, pixel)
        dr.scatter(cells[1], grad_alpha, cell)
    dr.scatter(cells[0], mi.ArrayXf([*grad_colour, rest]), cell)
    dr.eval(cells)


def _blend_backward(
    records: tuple[Any, Any],
    pairs: tuple[Any, Any],
    span: tuple[Any, Any],
    frame: PictureBuffers,
    cells: tuple[Any, ...],
    moments: tuple[Any, Any],
) -> None:
    """Stage 6: each pair's moments of the gradient."""
    width, _ = _size(frame.size)
    lane = frame.tiles
    n = TILE * TILE
    c = dr.gather(mi.ArrayXf, cells[0], lane, shape=(4 * n, dr.width(lane)))
    grad_alpha = list(dr.gather(mi.ArrayXf, cells[1], lane, shape=(n, dr.width(lane)))) if len(cells) > 1 else []
    grads = [c[4 * p + channel] for channel in range(3) for p in range(n)]
    blending.backward(
        records,
        pairs,
        span,
        blending.origin(mi.Int32(lane), _columns(width)),
        (grads, grad_alpha, [c[4 * p + 3] for p in range(n)]),
        moments,
    )
    dr.eval(moments)


def _sum_rows(span: tuple[Any, Any], moments: tuple[Any, Any]) -> list[Any]:
    """Add the rows of each Gaussian in their fixed order: nine Floats a lane."""

    def body(row: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        m = dr.gather(mi.ArrayXf, moments[0], row, shape=(RECORD, dr.width(row)))
        extra = dr.gather(mi.Float, moments[1], row)
        return row + 1, [s + v for s, v in zip(sums, [*m, extra], strict=True)]

    zeros = [mi.Float(0) for _ in range(RECORD + 1)]
    _, sums = dr.while_loop((mi.UInt32(span[0]), zeros), lambda row, _: row < span[1], body, label="sum of moments")
    return list(sums)


def _splat_gradient(splat: Splat, sums: list[Any]) -> list[Any]:
    """dL/d(components of a splat) from the moments of h = alpha dL/dalpha: log2 alpha has the grad_colour h ln 2."""
    h, hx, hy, hxx, hxy, hyy = (_LN2 * s for s in sums[:6])
    u0, u1, v1 = (dr.detach(v) for v in (splat.u0, splat.u1, splat.v1))
    along = u0 * hx + u1 * hy
    return [
        2.0 * u0 * along,
        2.0 * (u1 * along + v1 * v1 * hy),
        -2.0 * (u0 * hxx + u1 * hxy),
        -2.0 * (u0 * hxy + u1 * hyy),
        -2.0 * v1 * hyy,
        h,
        *sums[6:9],
    ]


def _benign(gaussians: Gaussians, visible: Any, view: Any) -> Gaussians:
    """Invisible lanes made harmless, so that no infinity of theirs meets the zero of their gradient."""
    ahead = view.position + mi.Vector3f(view.rotation[2, 0], view.rotation[2, 1], view.rotation[2, 2])
    one = mi.Float(1.0)
    return Gaussians(
        mean=dr.select(visible, gaussians.mean, mi.Point3f(ahead)),
        scale=dr.select(visible, gaussians.scale, mi.Vector3f(1.0)),
        rotation=[dr.select(visible, q, one) for q in gaussians.rotation],
        opacity=dr.select(visible, gaussians.opacity, one),
        sh=gaussians.sh,
    )


def _leaves(gaussians: Gaussians) -> list[Any]:
    return [gaussians.mean, gaussians.scale, *gaussians.rotation, gaussians.opacity, *gaussians.sh]


def _project_backward(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    view: Any,
    places: tuple[Any, Any, Any],
    moments: tuple[Any, Any],
    gradients: tuple[Any, ...],
    screen: Any | None,
) -> None:
    """Stage 7: sum every Gaussian's moments and take them back through the projection."""
    index, first, last = places
    span = (first, last)
    sums = _sum_rows(span, moments)
    camera = pinhole.unpack(view)
    gaussians = _benign(layout.read(arrays, index, terms), span[1] > span[0], camera)
    leaves = _leaves(gaussians)
    dr.enable_grad(leaves)
    splat, _, _ = project(gaussians, camera)
    grads = _splat_gradient(splat, sums)
    if screen is not None:
        seen = dr.select(span[1] > span[0], mi.Float(1), mi.Float(0))
        dr.scatter(screen, mi.ArrayXf([grads[0], grads[1], seen]), index)
    total = mi.Float(0)
    for value, grad_colour in zip(splat.components(), grads, strict=True):
        total += value * grad_colour
    dr.backward(total)
    gradient = Gaussians(
        mean=dr.grad(gaussians.mean),
        scale=dr.grad(gaussians.scale),
        rotation=[dr.grad(q) for q in gaussians.rotation],
        opacity=dr.grad(gaussians.opacity),
        sh=[dr.grad(c) for c in gaussians.sh],
    )
    layout.write(gradients, index, gradient)
    dr.eval(gradients, screen)


def rasterize(
    layout: Layout, arrays: tuple[Any, ...], camera: Pinhole, background: tuple[float, float, float]
) -> Picture:
    """Render Gaussians to a picture.

    Args:
        layout: What lies where in `arrays`.
        arrays: Flat Float arrays, detached and evaluated; the one before the last has one entry a Gaussian.
        camera: The camera.
        background: Colour behind everything.

    Raises:
        MiSplatError: The picture needs more than MAX_PAIRS (tile, Gaussian) pairs.
    """
    width, height = camera.size
    pixels = width * height
    frame = PictureBuffers(
        size=mi.Int32([width, height]),
        tiles=numbers(mi.variant(), -(-width // TILE) * -(-height // TILE)),
        pixels=numbers(mi.variant(), pixels),
        background=mi.Float(background),
        colour=buffer(3 * pixels),
        opacity=buffer(pixels, value=0.0),
    )
    count = len(arrays[-2])
    if count == 0:
        return Picture(_empty(frame), frame.opacity, None)
    terms, view = len(arrays[-1]) // (3 * count), camera.numbers()
    records = (buffer(RECORD * count), buffer(count))
    index = numbers(mi.variant(), count)
    key, touched = run(_project, layout, terms, arrays, index, frame, view, records)
    # Not inside a frozen function: a recorded argsort keeps the size that it was recorded with.
    order = dr.argsort(key)
    first, last, total = run(_place, touched, order)
    number = int(total[0])
    if number == 0:
        return Picture(_empty(frame), frame.opacity, None)
    if number > MAX_PAIRS:
        raise MiSplatError(
            message("picture", f"at most {MAX_PAIRS} tile touches", number, "render it smaller or shrink the Gaussians")
        )
    pairs = (buffer(number, mi.UInt32, _EMPTY), buffer(number, mi.UInt32, 0))
    run(_emit, records[0], order, first, last, frame.size, pairs)
    rows = dr.argsort(pairs[0])
    canvas = buffer(4 * TILE * TILE * len(frame.tiles))
    gaussians, *span = run(_blend, records, pairs, rows, total, frame, canvas)
    state = BackwardState(frame, view, records, (order, first, last), (gaussians, rows), tuple(span))
    return Picture(frame.colour, frame.opacity, state)


def _empty(frame: PictureBuffers) -> Any:
    return dr.tile(frame.background, len(frame.opacity))


def rasterize_backward(
    layout: Layout,
    arrays: tuple[Any, ...],
    picture: Picture,
    colour: Any,
    opacity: Any | None = None,
    *,
    screen: Any | None = None,
) -> tuple[Any, ...]:
    """Gradient of a scalar with respect to the Gaussians, from its gradient with respect to the picture.

    Args:
        layout: As in the forward call.
        arrays: As in the forward call.
        picture: What the forward call returned.
        colour: Float, dL/d(picture.colour).
        opacity: Float, dL/d(picture.opacity), if that output is used.
        screen: Float of three zeros a Gaussian (see `buffer`), to be filled with dL/d(centre on the screen) in pixels
            and 1 where the Gaussian touches a tile.

    Returns:
        One Float array for each of `arrays`. The same bits every time, on any number of threads.
    """
    state = picture.state
    gradients = tuple(buffer(len(array), value=0.0) for array in arrays)
    if state is None:
        return gradients
    grads = (colour,) if opacity is None else (colour, opacity)
    dr.make_opaque(grads)
    tiles = len(state.frame.tiles) * TILE * TILE
    cells = tuple(buffer(width * tiles, value=0.0) for width in ((4,) if opacity is None else (4, 1)))
    pairs = len(state.pairs[0])
    moments = (buffer(RECORD * pairs), buffer(pairs))
    terms = len(arrays[-1]) // (3 * len(arrays[-2]))
    run(_spread, state.frame, grads, cells)
    run(_blend_backward, state.records, state.pairs, state.span, state.frame, cells, moments)
    run(_project_backward, layout, terms, arrays, state.view, state.places, moments, gradients, screen)
    return gradients
