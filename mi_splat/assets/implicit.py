"""Implicit bodies: smooth unions of round cones and ellipsoids, meshed by surface nets (Gibson 1998)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.assets.mesh import Floats

Doubles = NDArray[np.float64]
Distance = Callable[[Floats, Floats, Floats], Floats]

FAR = np.float32(1e3)


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """A primitive: its approximate signed distance as a function of x, y, z, and the (2, 3) box that holds it."""

    distance: Distance
    bounds: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Primitives of one material that melt into each other over about `blend` metres."""

    blobs: tuple[Blob, ...]
    blend: float


def cone(start: ArrayLike, end: ArrayLike, radii: tuple[float, float], *, flat: ArrayLike = (0.0, 0.0, 0.0)) -> Blob:
    """A round cone between two points."""
    a, b, stretch = (np.asarray(v, np.float64) for v in (start, end, flat))
    amount = float(np.linalg.norm(stretch))
    wide = stretch / amount if amount else stretch
    shrink = np.float32(amount / (1 + amount))
    axis = b - a
    scale = axis / max(float(axis @ axis), 1e-12)
    reach = max(radii) * (1 + amount)
    w, o, d, s = (v.astype(np.float32) for v in (wide, a, axis, scale))
    first, growth = np.float32(radii[0]), np.float32(radii[1] - radii[0])

    def distance(x: Floats, y: Floats, z: Floats) -> Floats:
        px, py, pz = x - o[0], y - o[1], z - o[2]
        t = np.clip(px * s[0] + py * s[1] + pz * s[2], 0, 1)
        qx, qy, qz = px - t * d[0], py - t * d[1], pz - t * d[2]
        square = qx * qx + qy * qy + qz * qz
        if amount:
            along = qx * w[0] + qy * w[1] + qz * w[2]
            square = square - along * along * (1 - (1 - shrink) ** 2)
        value: Floats = np.sqrt(square) - (first + t * growth)
        return value

    return Blob(distance, np.stack([np.minimum(a, b) - reach, np.maximum(a, b) + reach]))


def ellipsoid(centre: ArrayLike, radii: ArrayLike, axes: ArrayLike | None = None) -> Blob:
    """An ellipsoid with radii along the rows of `axes` (3, 3), the world's axes by default.

    Its distance is the first-order bound near (near - 1) / |gradient| (Quilez 2008).
    """
    o, size = np.asarray(centre, np.float64), np.asarray(radii, np.float64)
    frame = np.eye(3) if axes is None else np.asarray(axes, np.float64)
    m = (frame / size[:, None]).astype(np.float32)
    c = o.astype(np.float32)
    inverse = (1 / size).astype(np.float32)
    reach = np.sqrt(((frame * size[:, None]) ** 2).sum(0))

    def distance(x: Floats, y: Floats, z: Floats) -> Floats:
        px, py, pz = x - c[0], y - c[1], z - c[2]
        u, v, w = (row[0] * px + row[1] * py + row[2] * pz for row in m)
        near = np.sqrt(u * u + v * v + w * w)
        slope = np.sqrt((u * inverse[0]) ** 2 + (v * inverse[1]) ** 2 + (w * inverse[2]) ** 2)
        value: Floats = near * (near - 1) / np.maximum(slope, np.float32(1e-6))
        return value

    return Blob(distance, np.stack([o - reach, o + reach]))


def above(blob: Blob, level: float) -> Blob:
    """`blob` cut off flat below z = `level`: the hem of a shirt."""
    bounds = blob.bounds.copy()
    bounds[0, 2] = max(bounds[0, 2], level)

    def distance(x: Floats, y: Floats, z: Floats) -> Floats:
        value: Floats = np.maximum(blob.distance(x, y, z), np.float32(level) - z)
        return value

    return Blob(distance, bounds)


def chain(points: ArrayLike, radii: Sequence[float], *, flat: ArrayLike = (0.0, 0.0, 0.0)) -> list[Blob]:
    """Round cones along a polyline of (n, 3) points with n radii."""
    path = np.asarray(points, np.float64)
    return [cone(path[i], path[i + 1], (radii[i], radii[i + 1]), flat=flat) for i in range(len(path) - 1)]


def _melt(a: Floats, b: Floats, blend: float) -> Floats:
    """Smooth minimum, the quadratic polynomial of width `blend` (Quilez 2013)."""
    overlap = np.maximum(np.float32(blend) - np.abs(a - b), 0)
    value: Floats = np.minimum(a, b) - overlap * overlap * np.float32(0.25 / blend)
    return value


def _grid_distance(layer: Layer, axes: Sequence[Floats], margin: float) -> Floats:
    """(X, Y, Z) distance to a layer; exact only within `margin` of its surface."""
    field = np.full([len(axis) for axis in axes], FAR, np.float32)
    for blob in layer.blobs:
        low, high = blob.bounds[0] - margin, blob.bounds[1] + margin
        span = [
            slice(int(np.searchsorted(a, lo)), int(np.searchsorted(a, hi)))
            for a, lo, hi in zip(axes, low, high, strict=True)
        ]
        x, y, z = (axis[part] for axis, part in zip(axes, span, strict=True))
        block = (span[0], span[1], span[2])
        field[block] = _melt(field[block], blob.distance(x[:, None, None], y[None, :, None], z), layer.blend)
    return field


def point_distance(layer: Layer, points: Floats, margin: float) -> Floats:
    """(N,) distance of points (N, 3) to a layer; exact only within `margin` of its surface."""
    field = np.full(len(points), FAR, np.float32)
    for blob in layer.blobs:
        low, high = (blob.bounds[0] - margin).astype(np.float32), (blob.bounds[1] + margin).astype(np.float32)
        inside = np.flatnonzero(np.logical_and(points > low, points < high).all(1))
        x, y, z = points[inside].T
        field[inside] = _melt(field[inside], blob.distance(x, y, z), layer.blend)
    return field


def surface(layers: Sequence[Layer], cell: float) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and outward quads (Q, 4) of the union of `layers`, by surface nets of `cell` metres."""
    margin = 2.5 * cell + max(layer.blend for layer in layers)
    bounds = np.stack([blob.bounds for layer in layers for blob in layer.blobs])
    low, high = bounds[:, 0].min(0) - 2 * cell - margin / 2, bounds[:, 1].max(0) + 2 * cell + margin / 2
    axes = [np.arange(a, b + cell, cell).astype(np.float32) for a, b in zip(low, high, strict=True)]
    field = _grid_distance(layers[0], axes, margin)
    for layer in layers[1:]:
        np.minimum(field, _grid_distance(layer, axes, margin), out=field)
    np.minimum(field, np.float32(4 * cell), out=field)
    return _surface_nets(field, low, cell)


def _surface_nets(field: Floats, low: Doubles, cell: float) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices and quads of the zero level of a field (X, Y, Z) sampled from `low` in steps of `cell`."""
    inside = field < 0
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    shape = np.array(field.shape) - 1
    count = sum(inside[i : i + shape[0], j : j + shape[1], k : k + shape[2]].astype(np.int8) for i, j, k in corners)
    cells = np.argwhere((np.asarray(count) > 0) & (np.asarray(count) < 8))
    value = np.stack([field[tuple((cells + c).T)] for c in corners], 1)
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a in range(8):
        for b in range(a + 1, 8):
            if np.abs(corners[a] - corners[b]).sum() != 1:
                continue
            crossed = (value[:, a] < 0) != (value[:, b] < 0)
            t = value[crossed, a] / (value[crossed, a] - value[crossed, b])
            total[crossed] += corners[a] + t[:, None] * (corners[b] - corners[a])
            crossings[crossed] += 1
    vertices = low + cell * (cells + total / crossings[:, None])
    index = np.full(tuple(shape), -1, np.int64)
    index[tuple(cells.T)] = np.arange(len(cells))
    quads = []
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        before = np.take(inside, range(inside.shape[axis] - 1), axis)
        after = np.take(inside, range(1, inside.shape[axis]), axis)
        edges = np.argwhere(before != after)
        ring = np.stack([index[tuple((edges + step).T)] for step in (-u - v, -v, 0 * u, -u)], 1)
        leaving = before[tuple(edges.T)]
        quads.append(np.where(leaving[:, None], ring, ring[:, ::-1]))
    return vertices.astype(np.float32), np.concatenate(quads)


def normals(vertices: Floats, quads: NDArray[np.int64]) -> Floats:
    """(V, 3) unit normals of a quad mesh, weighted by area."""
    corner = vertices[quads]
    face = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    total = np.stack([np.bincount(quads.ravel(), np.repeat(face[:, i], 4), len(vertices)) for i in range(3)], 1)
    unit: Floats = (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    return unit
