"""The few shapes from which every asset is built: quads, boxes, sheets, lofts, tubes,
ellipsoids, prisms.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.capture.mesh import Mesh, scaling, skin, transform, translation
from mi_splat.errors import InvalidValueError
from scenes.recipes.objects.model import join


def _mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    uvs: ArrayLike,
    colour: ArrayLike,
    roughness: float | None,
    smooth: bool,
) -> Mesh:
    """A mesh from arrays of any number type."""
    return Mesh(
        np.asarray(vertices, np.float32),
        np.asarray(faces, np.uint32),
        np.asarray(uvs, np.float32),
        skin(colour),
        roughness,
        smooth,
    )


def quad(
    corners: ArrayLike, colour: ArrayLike, *, roughness: float | None = None
) -> Mesh:
    """A flat quadrilateral from (4, 3) corners: bottom left, bottom right, top right,
    top left seen from its front.
    """
    uvs = [[0, 0], [1, 0], [1, 1], [0, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return _mesh(np.asarray(corners), faces, np.array(uvs), colour, roughness, False)


def box(
    size: Sequence[float],
    colour: ArrayLike,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    roughness: float | None = None,
) -> Mesh:
    """A box with edge lengths `size`; each face shows the whole texture, upright on the
    four sides.
    """
    sides = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)):
        normal = np.eye(3)[axis] * sign
        up = np.array([0.0, 0.0, 1.0]) if axis < 2 else np.array([1.0, 0.0, 0.0])
        right = np.cross(up, normal)
        sides.append(
            np.array(
                [
                    normal - right - up,
                    normal + right - up,
                    normal + right + up,
                    normal - right + up,
                ]
            )
        )
    vertices = np.concatenate(sides) * np.asarray(size) / 2 + np.asarray(centre)
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(6)])
    uvs = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (6, 1))
    return _mesh(vertices, faces, uvs, colour, roughness, False)


def sheet(
    points: ArrayLike,
    colour: ArrayLike,
    *,
    repeat: tuple[float, float] = (1.0, 1.0),
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A surface through an (n, m, 3) grid of points; u runs along m (right) and v along
    n (up).
    """
    grid = np.asarray(points, np.float64)
    n, m = grid.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, 1:]
    d = index[1:, :-1]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    flat = grid.reshape(-1, 3)
    corner = flat[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    v, u = np.meshgrid(
        np.linspace(0, repeat[1], n), np.linspace(0, repeat[0], m), indexing="ij"
    )
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return _mesh(flat, faces[area > 1e-12], uvs, colour, roughness, smooth)


def loft(
    sections: ArrayLike,
    colour: ArrayLike,
    *,
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A closed body through (S, P, 3) cross sections of P points each.

    Points run counter-clockwise seen against the direction from the first section to
    the last. u runs once around and v from the first section to the last; the caps are
    fans about the centre of the end sections.
    """
    rings = np.asarray(sections, np.float64)
    rings = np.concatenate([rings, rings[:, :1]], 1)
    parts = [sheet(rings, colour, roughness=roughness, smooth=smooth)]
    count = rings.shape[1] - 1
    fan = np.array([[0, i + 1, (i + 1) % count + 1] for i in range(count)])
    for ring, faces, v in (
        (rings[0, :-1], fan[:, ::-1], 0.0),
        (rings[-1, :-1], fan, 1.0),
    ):
        if np.ptp(ring, axis=0).max() < 1e-6:
            continue
        vertices = np.concatenate([ring.mean(0, keepdims=True), ring])
        uvs = np.stack([np.r_[0.5, np.arange(count) / count], np.full(count + 1, v)], 1)
        parts.append(_mesh(vertices, faces, uvs, colour, roughness, smooth))
    return join(*parts)


def lathe(
    profile: ArrayLike,
    colour: ArrayLike,
    *,
    segments: int = 24,
    roughness: float | None = None,
) -> Mesh:
    """A body of revolution about z from a (P, 2) profile of (radius, z), from the
    bottom up along the outside.
    """
    radius, z = np.asarray(profile, np.float64).T
    angle = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = [at_height(r * ring, height) for r, height in zip(radius, z, strict=True)]
    return loft(rings, colour, roughness=roughness)


def sweep(
    path: ArrayLike,
    radii: ArrayLike,
    colour: ArrayLike,
    *,
    segments: int = 12,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    roughness: float | None = None,
) -> Mesh:
    """A tube along an (n, 3) polyline with closed ends."""
    points = np.asarray(path, np.float64)
    size = np.broadcast_to(
        np.asarray(radii, np.float64).reshape(len(np.atleast_1d(radii)), -1),
        (len(points), 2),
    )
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    hint = np.asarray(up, np.float64)
    if np.abs(tangent @ hint).max() > 0.99 * np.linalg.norm(hint):
        if abs(tangent[0, 0]) < 0.9:
            hint = np.array([1.0, 0.0, 0.0])
        else:
            hint = np.array([0.0, 1.0, 0.0])
    first = np.cross(hint, tangent)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    angle = 2 * np.pi * np.arange(segments) / segments
    rings = (
        points[:, None]
        + (size[:, 0, None] * np.cos(angle))[..., None] * first[:, None]
        + (size[:, 1, None] * np.sin(angle))[..., None] * second[:, None]
    )
    return loft(rings, colour, roughness=roughness)


def ellipsoid(
    size: Sequence[float],
    colour: ArrayLike,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    segments: int = 20,
    roughness: float | None = None,
) -> Mesh:
    """An ellipsoid with the three diameters `size`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([np.maximum(np.cos(angle), 0) / 2, np.sin(angle) / 2], -1)
    profile[[0, -1], 0] = 0
    ball = lathe(profile, colour, segments=segments, roughness=roughness)
    return transform(ball, translation(*centre) @ scaling(*size))


def extrude(
    polygon: ArrayLike,
    depth: float,
    colour: ArrayLike,
    *,
    roughness: float | None = None,
) -> Mesh:
    """A prism over a simple (P, 2) polygon (concave allowed) in the x-y plane, from z =
    0 to `depth`.
    """
    outline = np.asarray(polygon, np.float64)
    x, y = outline.T
    if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):
        outline = outline[::-1]
    count = len(outline)
    low = outline.min(0)
    span = np.maximum(np.ptp(outline, axis=0), 1e-9)
    uvs = (outline - low) / span
    levels = [at_height(outline, z) for z in (0.0, depth)]
    i = np.arange(count)
    j = (np.arange(count) + 1) % count
    sides = np.concatenate(
        [np.stack([i, j, j + count], 1), np.stack([i, j + count, i + count], 1)]
    )
    ends = triangulate(outline)
    faces = np.concatenate([sides, ends[:, ::-1] + 2 * count, ends + 3 * count])
    return _mesh(
        np.concatenate(levels * 2),
        faces,
        np.tile(uvs, (4, 1)),
        colour,
        roughness,
        False,
    )


Points = NDArray[np.float64]


def _arc(
    x: float, y: float, rx: float, ry: float, start: float, end: float, count: int = 9
) -> list[tuple[float, float]]:
    angle = np.radians(np.linspace(start, end, count))
    return [(x + rx * float(np.cos(a)), y + ry * float(np.sin(a))) for a in angle]


_S = [*_arc(0.5, 0.74, 0.4, 0.26, 25, 270), *_arc(0.5, 0.26, 0.4, 0.26, 90, -155)]
_O = _arc(0.5, 0.5, 0.42, 0.5, 90, 450, 25)
_THREE = [
    *_arc(0.45, 0.75, 0.4, 0.25, 150, -90),
    *_arc(0.45, 0.25, 0.42, 0.25, 90, -150),
]
GLYPHS: dict[str, list[list[tuple[float, float]]]] = {
    "S": [_S],
    "T": [[(0.02, 1), (0.98, 1)], [(0.5, 1), (0.5, 0)]],
    "O": [_O],
    "P": [
        [
            (0.12, 0),
            (0.12, 1),
            (0.5, 1),
            *_arc(0.55, 0.74, 0.37, 0.26, 90, -90),
            (0.12, 0.48),
        ]
    ],
    "A": [[(0, 0), (0.5, 1), (1, 0)], [(0.2, 0.35), (0.8, 0.35)]],
    "E": [[(0.95, 1), (0.1, 1), (0.1, 0), (0.95, 0)], [(0.1, 0.52), (0.8, 0.52)]],
    "H": [[(0.1, 0), (0.1, 1)], [(0.9, 0), (0.9, 1)], [(0.1, 0.5), (0.9, 0.5)]],
    "K": [[(0.1, 0), (0.1, 1)], [(0.9, 1), (0.1, 0.45), (0.95, 0)]],
    "M": [[(0.05, 0), (0.05, 1), (0.5, 0.4), (0.95, 1), (0.95, 0)]],
    "0": [_O],
    "1": [[(0.25, 0.8), (0.55, 1), (0.55, 0)]],
    "2": [[*_arc(0.5, 0.72, 0.4, 0.28, 160, -30), (0.1, 0), (0.92, 0)]],
    "3": [_THREE],
    "4": [[(0.72, 0), (0.72, 1), (0.05, 0.3), (0.98, 0.3)]],
    "5": [
        [(0.88, 1), (0.2, 1), (0.14, 0.55), *_arc(0.48, 0.31, 0.42, 0.31, 120, -150)]
    ],
    "6": [[(0.75, 1), *_arc(0.5, 0.32, 0.38, 0.32, 160, 520, 17)]],
    "7": [[(0.08, 1), (0.92, 1), (0.4, 0)]],
    "8": [
        _arc(0.5, 0.76, 0.34, 0.24, -90, 270, 17),
        _arc(0.5, 0.26, 0.42, 0.26, 90, 450, 17),
    ],
    "9": [[(0.3, 0), *_arc(0.5, 0.68, 0.38, 0.32, -20, 340, 17)]],
}
"""Strokes of the letters and digits in a unit square, y up."""


def strokes(
    text: str, *, centre: Sequence[float], height: float, width: float, gap: float
) -> list[Points]:
    """Polylines of `text` around `centre`; `width` and `gap` are those of one letter,
    all in the unit of `height`.
    """
    total = len(text) * width + (len(text) - 1) * gap
    lefts = [
        centre[0] - total / 2 + position * (width + gap)
        for position in range(len(text))
    ]
    return [
        np.asarray(line) * (width, height) + (left, centre[1] - height / 2)
        for left, letter in zip(lefts, text, strict=True)
        for line in GLYPHS.get(letter, [])
    ]


def at_height(outline: Points, z: float) -> Points:
    """(P, 3) the (P, 2) points of an outline at one height."""
    return np.concatenate([outline, np.full((len(outline), 1), z)], 1)


def rounded_rectangle(
    length: float, width: float, radius: float, *, corner: int = 6
) -> Points:
    """(4 * corner, 2) counter-clockwise outline centred at 0, from the right side's
    lower corner on.
    """
    x = length / 2 - radius
    y = width / 2 - radius
    centres = ((x, -y, -90), (x, y, 0), (-x, y, 90), (-x, -y, 180))
    return np.array(
        [
            p
            for cx, cy, start in centres
            for p in _arc(cx, cy, radius, radius, start, start + 90, corner)
        ]
    )


def regular_polygon(sides: int, radius: float, *, turn: float = 0.0) -> Points:
    """(sides, 2) counter-clockwise polygon with corners at `radius`; `turn` in
    degrees.
    """
    angle = np.radians(turn) + 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def smooth_interpolate(x: ArrayLike, knots: ArrayLike, values: ArrayLike) -> Points:
    """Piecewise cubic through (knots, values) that never overshoots: slopes are zero at
    every local extremum.

    Elsewhere they are the harmonic means of the neighbouring differences (Fritsch and
    Butland 1984).
    """
    t, k, v = (np.asarray(a, np.float64) for a in (x, knots, values))
    step = np.diff(k)
    slope = np.diff(v) / step
    inner = np.where(
        slope[1:] * slope[:-1] > 0,
        2 * slope[1:] * slope[:-1] / (slope[1:] + slope[:-1] + 1e-30),
        0,
    )
    tangent = np.concatenate([slope[:1], inner, slope[-1:]])
    i = np.clip(np.searchsorted(k, t, side="right") - 1, 0, len(step) - 1)
    s = np.clip((t - k[i]) / step[i], 0, 1)
    h = step[i]
    result: Points = (
        v[i] * (1 + 2 * s) * (1 - s) ** 2
        + h * tangent[i] * s * (1 - s) ** 2
        + v[i + 1] * s**2 * (3 - 2 * s)
        + h * tangent[i + 1] * s**2 * (s - 1)
    )
    return result


def triangulate(polygon: ArrayLike) -> NDArray[np.int64]:
    """(P - 2, 3) triangles of a simple counter-clockwise (P, 2) polygon, by cutting off
    ears (Meisters 1975).
    """
    points = np.asarray(polygon, np.float64)
    left = list(range(len(points)))
    triangles = []

    def cross(o: int, a: int, b: int) -> float:
        u = points[a] - points[o]
        v = points[b] - points[o]
        return float(u[0] * v[1] - u[1] * v[0])

    while len(left) > 3:
        for position in range(len(left)):
            a = left[position - 1]
            b = left[position]
            c = left[(position + 1) % len(left)]
            if cross(a, b, c) <= 0:
                continue
            others = [p for p in left if p not in (a, b, c)]
            if not any(
                cross(a, b, p) >= 0 and cross(b, c, p) >= 0 and cross(c, a, p) >= 0
                for p in others
            ):
                triangles.append((a, b, c))
                del left[position]
                break
        else:
            flat = [
                k
                for k in range(len(left))
                if abs(cross(left[k - 1], left[k], left[(k + 1) % len(left)])) < 1e-12
            ]
            if not flat:
                raise InvalidValueError.of(
                    "polygon",
                    "a simple outline",
                    "one that crosses itself",
                    "check the order of its points",
                )
            del left[flat[0]]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, np.int64)
