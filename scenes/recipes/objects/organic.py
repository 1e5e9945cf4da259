"""Organic bodies: the skins of implicit bodies, painted as solids.

A body is a sequence of layers (skin, shirt, hair, ...). Inside a layer the primitives
melt into each other; layers meet in a crease, and the layer on the outside gives the
surface its colour. Colours come from a function of the position in space: every quad of
the mesh owns a small tile of the texture, sampled at its own points, so that the
image has no seams and no stretched texels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.capture.mesh import Floats, Mesh
from scenes.recipes.objects.primitives import sheet

Doubles = NDArray[np.float64]
Distance = Callable[[Floats, Floats, Floats], Floats]

FAR = np.float32(1e3)


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """A primitive: its approximate signed distance as a function of x, y, z, and the
    (2, 3) box that holds it.
    """

    distance: Distance
    bounds: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Primitives of one material that melt into each other over about `blend`
    metres.
    """

    blobs: tuple[Blob, ...]
    blend: float


def cone(
    start: ArrayLike,
    end: ArrayLike,
    radii: tuple[float, float],
    *,
    flat: ArrayLike = (0.0, 0.0, 0.0),
) -> Blob:
    """A round cone between two points."""
    a, b, stretch = (np.asarray(v, np.float64) for v in (start, end, flat))
    amount = float(np.linalg.norm(stretch))
    wide = stretch / amount if amount else stretch
    shrink = np.float32(amount / (1 + amount))
    axis = b - a
    scale = axis / max(float(axis @ axis), 1e-12)
    reach = max(radii) * (1 + amount)
    w, o, d, s = (v.astype(np.float32) for v in (wide, a, axis, scale))
    first = np.float32(radii[0])
    growth = np.float32(radii[1] - radii[0])

    def distance(x: Floats, y: Floats, z: Floats) -> Floats:
        px = x - o[0]
        py = y - o[1]
        pz = z - o[2]
        t = np.clip(px * s[0] + py * s[1] + pz * s[2], 0, 1)
        qx = px - t * d[0]
        qy = py - t * d[1]
        qz = pz - t * d[2]
        square = qx * qx + qy * qy + qz * qz
        if amount:
            along = qx * w[0] + qy * w[1] + qz * w[2]
            square = square - along * along * (1 - (1 - shrink) ** 2)
        value: Floats = np.sqrt(square) - (first + t * growth)
        return value

    return Blob(
        distance, np.stack([np.minimum(a, b) - reach, np.maximum(a, b) + reach])
    )


def ellipsoid(
    centre: ArrayLike, radii: ArrayLike, axes: ArrayLike | None = None
) -> Blob:
    """An ellipsoid with radii along the rows of `axes` (3, 3), the world's axes by
    default.

    Its distance is the first-order bound near (near - 1) / |gradient| (Quilez 2008).
    """
    o = np.asarray(centre, np.float64)
    size = np.asarray(radii, np.float64)
    frame = np.eye(3) if axes is None else np.asarray(axes, np.float64)
    m = (frame / size[:, None]).astype(np.float32)
    c = o.astype(np.float32)
    inverse = (1 / size).astype(np.float32)
    reach = np.sqrt(((frame * size[:, None]) ** 2).sum(0))

    def distance(x: Floats, y: Floats, z: Floats) -> Floats:
        px = x - c[0]
        py = y - c[1]
        pz = z - c[2]
        u, v, w = (row[0] * px + row[1] * py + row[2] * pz for row in m)
        near = np.sqrt(u * u + v * v + w * w)
        slope = np.sqrt(
            (u * inverse[0]) ** 2 + (v * inverse[1]) ** 2 + (w * inverse[2]) ** 2
        )
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


def chain(
    points: ArrayLike, radii: Sequence[float], *, flat: ArrayLike = (0.0, 0.0, 0.0)
) -> list[Blob]:
    """Round cones along a polyline of (n, 3) points with n radii."""
    path = np.asarray(points, np.float64)
    return [
        cone(
            path[i],
            path[i + 1],
            (radii[i], radii[i + 1]),
            flat=flat,
        )
        for i in range(len(path) - 1)
    ]


def _melt(a: Floats, b: Floats, blend: float) -> Floats:
    """Smooth minimum, the quadratic polynomial of width `blend` (Quilez 2013)."""
    overlap = np.maximum(np.float32(blend) - np.abs(a - b), 0)
    value: Floats = np.minimum(a, b) - overlap * overlap * np.float32(0.25 / blend)
    return value


def _grid_distance(layer: Layer, axes: Sequence[Floats], margin: float) -> Floats:
    """(X, Y, Z) distance to a layer; exact only within `margin` of its surface."""
    field = np.full([len(axis) for axis in axes], FAR, np.float32)
    for blob in layer.blobs:
        low = blob.bounds[0] - margin
        high = blob.bounds[1] + margin
        span = [
            slice(int(np.searchsorted(a, lo)), int(np.searchsorted(a, hi)))
            for a, lo, hi in zip(axes, low, high, strict=True)
        ]
        x, y, z = (axis[part] for axis, part in zip(axes, span, strict=True))
        block = (span[0], span[1], span[2])
        field[block] = _melt(
            field[block],
            blob.distance(x[:, None, None], y[None, :, None], z),
            layer.blend,
        )
    return field


def point_distance(layer: Layer, points: Floats, margin: float) -> Floats:
    """(N,) distance of points (N, 3) to a layer; exact only within `margin` of its
    surface.
    """
    field = np.full(len(points), FAR, np.float32)
    for blob in layer.blobs:
        low = (blob.bounds[0] - margin).astype(np.float32)
        high = (blob.bounds[1] + margin).astype(np.float32)
        inside = np.flatnonzero(np.logical_and(points > low, points < high).all(1))
        x, y, z = points[inside].T
        field[inside] = _melt(field[inside], blob.distance(x, y, z), layer.blend)
    return field


def surface(layers: Sequence[Layer], cell: float) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and outward quads (Q, 4) of the union of `layers`, by surface
    nets of `cell` metres.
    """
    margin = 2.5 * cell + max(layer.blend for layer in layers)
    bounds = np.stack([blob.bounds for layer in layers for blob in layer.blobs])
    low = bounds[:, 0].min(0) - 2 * cell - margin / 2
    high = bounds[:, 1].max(0) + 2 * cell + margin / 2
    axes = [
        np.arange(a, b + cell, cell).astype(np.float32)
        for a, b in zip(low, high, strict=True)
    ]
    field = _grid_distance(layers[0], axes, margin)
    for layer in layers[1:]:
        np.minimum(field, _grid_distance(layer, axes, margin), out=field)
    np.minimum(field, np.float32(4 * cell), out=field)
    return _surface_nets(field, low, cell)


def _surface_nets(
    field: Floats, low: Doubles, cell: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices and quads of the zero level of a field (X, Y, Z) sampled from `low` in
    steps of `cell`.
    """
    inside = field < 0
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    shape = np.array(field.shape) - 1
    count = sum(
        inside[i : i + shape[0], j : j + shape[1], k : k + shape[2]].astype(np.int8)
        for i, j, k in corners
    )
    cells = np.argwhere((np.asarray(count) > 0) & (np.asarray(count) < 8))
    value = np.stack([field[tuple((cells + c).T)] for c in corners], 1)
    total = np.zeros((len(cells), 3))
    crossings = np.zeros(len(cells))
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
        ring = np.stack(
            [index[tuple((edges + step).T)] for step in (-u - v, -v, 0 * u, -u)], 1
        )
        leaving = before[tuple(edges.T)]
        quads.append(np.where(leaving[:, None], ring, ring[:, ::-1]))
    return vertices.astype(np.float32), np.concatenate(quads)


def normals(vertices: Floats, quads: NDArray[np.int64]) -> Floats:
    """(V, 3) unit normals of a quad mesh, weighted by area."""
    corner = vertices[quads]
    face = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    total = np.stack(
        [
            np.bincount(quads.ravel(), np.repeat(face[:, i], 4), len(vertices))
            for i in range(3)
        ],
        1,
    )
    unit: Floats = (
        total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    ).astype(np.float32)
    return unit


Paint = Callable[[Floats, NDArray[np.int64]], Floats]


def body(
    layers: Sequence[Layer],
    cell: float,
    paint: Paint,
    *,
    texels: int = 4,
    relief: Callable[[Floats], Floats] | None = None,
    roughness: float | None = None,
) -> Mesh:
    """The closed mesh of `layers`, painted."""
    vertices, quads = surface(layers, cell)
    margin = 2.5 * cell + max(layer.blend for layer in layers)
    step = np.linspace(0, 1, texels, dtype=np.float32)
    s, t = np.meshgrid(step, step, indexing="xy")
    weight = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], -1).reshape(
        -1, 4
    )
    points = (
        np.einsum("tc,qcd->qtd", weight, vertices[quads])
        .reshape(-1, 3)
        .astype(np.float32)
    )
    owner = np.argmin([point_distance(layer, points, margin) for layer in layers], 0)
    colours = np.clip(paint(points, owner), 0, 1).reshape(len(quads), texels, texels, 3)
    if relief is not None:
        vertices = vertices + normals(vertices, quads) * relief(vertices)[:, None]
    side = int(np.ceil(np.sqrt(len(quads))))
    atlas = np.zeros((side * side, texels, texels, 3), np.float32)
    atlas[: len(quads)] = colours
    texture = (
        atlas.reshape(side, side, texels, texels, 3)
        .swapaxes(1, 2)
        .reshape(side * texels, side * texels, 3)
    )
    tile = np.arange(len(quads))
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (texels - 1) + 0.5
    pixel = np.stack([tile % side, tile // side], 1)[:, None] * texels + corner
    uvs = (pixel / (side * texels)).reshape(-1, 2)
    uvs[:, 1] = 1 - uvs[:, 1]
    faces = (
        (4 * tile[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]]))
        .reshape(-1, 3)
        .astype(np.uint32)
    )
    return Mesh(
        vertices[quads].reshape(-1, 3),
        faces,
        uvs.astype(np.float32),
        texture,
        roughness,
    )


def blade(
    points: ArrayLike,
    thickness: float,
    texture: ArrayLike,
    *,
    roughness: float | None = None,
) -> Mesh:
    """A thin closed sheet (an ear, a wing) about an (n, m, 3) grid of points, sharp at
    the rim.

    Both sides show the texture: u along m, v along n; from the side where m runs right
    and n up it is not mirrored.
    """
    grid = np.asarray(points, np.float64)
    n, m = grid.shape[:2]
    across = np.gradient(grid, axis=1)
    along = np.gradient(grid, axis=0)
    normal = np.cross(across, along)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    v = np.linspace(-1, 1, n)[:, None]
    u = np.linspace(-1, 1, m)[None]
    bulge = np.sqrt(np.maximum((1 - u**2) * (1 - v**2), 0))[..., None]
    offset = normal * bulge * thickness / 2
    front = sheet(grid + offset, texture, roughness=roughness)
    back = sheet(grid - offset, texture, roughness=roughness)
    faces = np.concatenate(
        [front.faces, back.faces[:, ::-1] + np.uint32(len(front.vertices))]
    )
    return Mesh(
        np.concatenate([front.vertices, back.vertices]),
        faces,
        np.concatenate([front.uvs, back.uvs]),
        front.texture,
        roughness,
    )


class Noise:
    """Smooth solid value noise in [-1, 1] (Ebert et al. 2003), periodic over 24 units,
    drawn from a generator.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._lattice = rng.uniform(-1, 1, (25, 25, 25)).astype(np.float32)
        for axis in range(3):
            first: list[slice | int] = [slice(None)] * 3
            last = list(first)
            first[axis], last[axis] = 0, 24
            self._lattice[tuple(last)] = self._lattice[tuple(first)]

    def __call__(self, points: Floats, scale: float | ArrayLike) -> Floats:
        """(N,) noise at points (N, 3); `scale` is the size of a grain in metres, one or
        per axis.
        """
        cells = np.mod(points / np.asarray(scale, np.float32), 24).astype(np.float32)
        base = np.minimum(cells.astype(np.int64), 23)
        f = cells - base
        f = f * f * (3 - 2 * f)
        flat = self._lattice.ravel()
        start = (base[:, 0] * 25 + base[:, 1]) * 25 + base[:, 2]
        value = np.zeros(len(points), np.float32)
        for i in (0, 1):
            for j in (0, 1):
                plane = (f[:, 0] if i else 1 - f[:, 0]) * (
                    f[:, 1] if j else 1 - f[:, 1]
                )
                value += plane * (
                    flat[start + 625 * i + 25 * j] * (1 - f[:, 2])
                    + flat[start + 625 * i + 25 * j + 1] * f[:, 2]
                )
        return value


def mix(base: Floats, colour: ArrayLike, amount: ArrayLike) -> Floats:
    """Colours (N, 3) blended towards a colour (3,) or (N, 3) by (N,) amounts, clipped
    to [0, 1].
    """
    weight = np.clip(np.asarray(amount, np.float32), 0, 1)[:, None]
    return (base * (1 - weight) + np.asarray(colour, np.float32) * weight).astype(
        np.float32
    )


def spot(
    points: Floats, centre: ArrayLike, radii: ArrayLike, soft: float = 0.2
) -> Floats:
    """(N,) amount of an ellipsoidal spot: 1 inside, 0 outside, soft over a fraction of
    its radius.
    """
    offset = (points - np.asarray(centre, np.float32)) / np.asarray(radii, np.float32)
    value: Floats = np.clip(
        (1 - np.linalg.norm(offset, axis=1)) / soft + 0.5, 0, 1
    ).astype(np.float32)
    return value


def grounded(meshes: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """The meshes moved so that they stand on z = 0 and their common box is centred in x
    and y.
    """
    points = np.concatenate([mesh.vertices for mesh in meshes])
    low = points.min(0)
    high = points.max(0)
    shift = np.array(
        [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]], np.float32
    )
    return tuple(replace(mesh, vertices=mesh.vertices + shift) for mesh in meshes)
