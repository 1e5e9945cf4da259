"""Plane outlines for meshes and textures: rounded rectangles, polygons, vector letters, smooth curves."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.errors import InvalidValueError

Points = NDArray[np.float64]


def _arc(
    x: float, y: float, rx: float, ry: float, start: float, end: float, count: int = 9
) -> list[tuple[float, float]]:
    angle = np.radians(np.linspace(start, end, count))
    return [(x + rx * float(np.cos(a)), y + ry * float(np.sin(a))) for a in angle]


_S = [*_arc(0.5, 0.74, 0.4, 0.26, 25, 270), *_arc(0.5, 0.26, 0.4, 0.26, 90, -155)]
_O = _arc(0.5, 0.5, 0.42, 0.5, 90, 450, 25)
_THREE = [*_arc(0.45, 0.75, 0.4, 0.25, 150, -90), *_arc(0.45, 0.25, 0.42, 0.25, 90, -150)]
GLYPHS: dict[str, list[list[tuple[float, float]]]] = {
    "S": [_S],
    "T": [[(0.02, 1), (0.98, 1)], [(0.5, 1), (0.5, 0)]],
    "O": [_O],
    "P": [[(0.12, 0), (0.12, 1), (0.5, 1), *_arc(0.55, 0.74, 0.37, 0.26, 90, -90), (0.12, 0.48)]],
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
    "5": [[(0.88, 1), (0.2, 1), (0.14, 0.55), *_arc(0.48, 0.31, 0.42, 0.31, 120, -150)]],
    "6": [[(0.75, 1), *_arc(0.5, 0.32, 0.38, 0.32, 160, 520, 17)]],
    "7": [[(0.08, 1), (0.92, 1), (0.4, 0)]],
    "8": [_arc(0.5, 0.76, 0.34, 0.24, -90, 270, 17), _arc(0.5, 0.26, 0.42, 0.26, 90, 450, 17)],
    "9": [[(0.3, 0), *_arc(0.5, 0.68, 0.38, 0.32, -20, 340, 17)]],
}
"""Strokes of the letters and digits in a unit square, y up."""


def strokes(text: str, *, centre: Sequence[float], height: float, width: float, gap: float) -> list[Points]:
    """Polylines of `text` around `centre`; `width` and `gap` are those of one letter, all in the unit of `height`."""
    total = len(text) * width + (len(text) - 1) * gap
    lines = []
    for position, letter in enumerate(text):
        left = centre[0] - total / 2 + position * (width + gap)
        for line in GLYPHS.get(letter, []):
            lines.append(np.asarray(line) * (width, height) + (left, centre[1] - height / 2))
    return lines


def rounded_rectangle(length: float, width: float, radius: float, *, corner: int = 6) -> Points:
    """(4 * corner, 2) counter-clockwise outline centred at 0, from the right side's lower corner on."""
    x, y = length / 2 - radius, width / 2 - radius
    centres = ((x, -y, -90), (x, y, 0), (-x, y, 90), (-x, -y, 180))
    return np.array([p for cx, cy, start in centres for p in _arc(cx, cy, radius, radius, start, start + 90, corner)])


def regular_polygon(sides: int, radius: float, *, turn: float = 0.0) -> Points:
    """(sides, 2) counter-clockwise polygon with corners at `radius`; `turn` in degrees."""
    angle = np.radians(turn) + 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def smooth_interpolate(x: ArrayLike, knots: ArrayLike, values: ArrayLike) -> Points:
    """Piecewise cubic through (knots, values) that never overshoots: slopes are zero at every local extremum.

    Elsewhere they are the harmonic means of the neighbouring differences (Fritsch and Butland 1984).
    """
    t, k, v = (np.asarray(a, np.float64) for a in (x, knots, values))
    step = np.diff(k)
    slope = np.diff(v) / step
    inner = np.where(slope[1:] * slope[:-1] > 0, 2 * slope[1:] * slope[:-1] / (slope[1:] + slope[:-1] + 1e-30), 0)
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
    """(P - 2, 3) triangles of a simple counter-clockwise (P, 2) polygon, by cutting off ears (Meisters 1975)."""
    points = np.asarray(polygon, np.float64)
    left = list(range(len(points)))
    triangles = []

    def cross(o: int, a: int, b: int) -> float:
        u, v = points[a] - points[o], points[b] - points[o]
        return float(u[0] * v[1] - u[1] * v[0])

    while len(left) > 3:
        for position in range(len(left)):
            a, b, c = left[position - 1], left[position], left[(position + 1) % len(left)]
            if cross(a, b, c) <= 0:
                continue
            others = [p for p in left if p not in (a, b, c)]
            if not any(cross(a, b, p) >= 0 and cross(b, c, p) >= 0 and cross(c, a, p) >= 0 for p in others):
                triangles.append((a, b, c))
                del left[position]
                break
        else:
            flat = [k for k in range(len(left)) if abs(cross(left[k - 1], left[k], left[(k + 1) % len(left)])) < 1e-12]
            if not flat:
                raise InvalidValueError.of(
                    "polygon", "a simple outline", "one that crosses itself", "check the order of its points"
                )
            del left[flat[0]]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, np.int64)
