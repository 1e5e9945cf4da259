"""Textures drawn by code: (h, w, 3) float32 arrays of sRGB reflectance in [0, 1], the
same for the same seed.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.capture.ground import asphalt, fractal_noise, grass, paint
from mi_splat.capture.mesh import Doubles, Floats
from scenes.recipes.objects.primitives import Points, regular_polygon, strokes


def canvas(size: tuple[int, int], colour: ArrayLike) -> Floats:
    """(h, w, 3) image of one colour."""
    return np.array(np.broadcast_to(np.asarray(colour, np.float32), (*size, 3)))


def grid(size: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """(h, w) x and y of the pixel centres, in [0, 1], y up."""
    height, width = size
    y, x = np.meshgrid(
        1 - (np.arange(height) + 0.5) / height,
        (np.arange(width) + 0.5) / width,
        indexing="ij",
    )
    return x, y


def cover(distance: Doubles, pixel: float) -> Doubles:
    """Fraction of each pixel inside a shape from the signed distance to its edge
    (negative inside).
    """
    return np.clip(0.5 - distance / pixel, 0, 1)


def line_distance(x: Doubles, y: Doubles, line: Points) -> Doubles:
    """(h, w) distance to a polyline of (P, 2) points."""
    best = np.full(x.shape, np.inf)
    for (ax, ay), (bx, by) in itertools.pairwise(line):
        dx = bx - ax
        dy = by - ay
        t = np.clip(
            ((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1
        )
        best = np.minimum(best, np.hypot(x - ax - t * dx, y - ay - t * dy))
    return best


def write(
    picture: Floats,
    text: str,
    colour: ArrayLike,
    *,
    box: Sequence[float],
    weight: float = 0.16,
) -> None:
    """Draw `text` in place into `box` (left, bottom, right, top, in [0, 1] of the
    image's height and y up).
    """
    height, width = picture.shape[:2]
    x, y = grid((height, width))
    x = x * width / height
    left, bottom, right, top = box
    letter = (right - left) / (len(text) + 0.32 * (len(text) - 1))
    pen = weight * min(letter, top - bottom) / 2
    middle = ((left + right) / 2, (bottom + top) / 2)
    lines = strokes(
        text,
        centre=middle,
        height=top - bottom - 2 * pen,
        width=letter,
        gap=0.32 * letter,
    )
    distance = np.full(x.shape, np.inf)
    for line in lines:
        distance = np.minimum(distance, line_distance(x, y, line))
    paint(picture, cover(distance - pen, 1 / height), colour)


def polygon_distance(x: Doubles, y: Doubles, polygon: Points) -> Doubles:
    """Signed distance bound to a convex counter-clockwise polygon, negative inside."""
    best = np.full(x.shape, -np.inf)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        length = float(np.hypot(bx - ax, by - ay))
        best = np.maximum(best, ((x - ax) * (by - ay) - (y - ay) * (bx - ax)) / length)
    return best


def marked_road(size: int = 256, seed: int = 0) -> Floats:
    """Asphalt with a dashed white line up the middle and solid ones at both edges."""
    rng = np.random.default_rng([seed, 1])
    picture = asphalt(size, rng)
    x, y = grid((size, size))
    wear = 0.8 + 0.2 * fractal_noise((size, size), rng, cells=16)
    stripe = cover(np.abs(x - 0.5) - 0.02, 1 / size)
    gaps = np.abs((y * 2) % 1 - 0.5) - 0.28
    dash = stripe * cover(gaps, 2 / size)
    edge = cover(np.abs(np.abs(x - 0.5) - 0.45) - 0.014, 1 / size)
    paint(
        picture,
        np.maximum(dash, edge) * wear,
        (0.9, 0.9, 0.87),
    )
    return picture


def tiles(
    size: int,
    seed: int,
    *,
    colour: ArrayLike,
    rows: int,
    columns: int,
    joint: float = 0.04,
    spread: float = 0.12,
) -> Floats:
    """Bricks, paving stones or roof tiles, every other row moved by half a tile; an
    even number of rows repeats.
    """
    rng = np.random.default_rng([seed, 3])
    x, y = grid((size, size))
    v = y * rows
    row = np.floor(v).astype(int)
    u = x * columns + (row % 2) * 0.5
    column = np.floor(u).astype(int) % columns
    tone = 1 + spread * rng.normal(size=(rows, columns))[row % rows, column]
    picture = np.clip(np.asarray(colour) * tone[..., None], 0, 1).astype(np.float32)
    picture *= (0.93 + 0.14 * rng.random((size, size, 1))).astype(np.float32)
    edge = np.minimum(
        np.minimum(u % 1, 1 - u % 1) / columns * rows, np.minimum(v % 1, 1 - v % 1)
    )
    mortar = cover(edge - joint, rows / size)
    paint(
        picture,
        mortar * 0.85,
        np.asarray(colour) * 0.45 + 0.22,
    )
    return np.asarray(np.clip(picture, 0, 1), np.float32)


def stop_sign(size: int = 256, seed: int = 0) -> Floats:
    """A stop sign that fills the square: red octagon, white border, STOP in white."""
    rng = np.random.default_rng([seed, 4])
    red = np.array(
        [rng.uniform(0.68, 0.8), rng.uniform(0.05, 0.11), rng.uniform(0.07, 0.13)]
    )
    picture = canvas((size, size), (0.93, 0.93, 0.92))
    x, y = grid((size, size))
    octagon = regular_polygon(8, 0.5 / np.cos(np.pi / 8), turn=22.5)
    paint(
        picture,
        cover(polygon_distance(x - 0.5, y - 0.5, octagon * 0.93), 1 / size),
        red,
    )
    write(
        picture,
        "STOP",
        (0.95, 0.95, 0.94),
        box=(0.13, 0.33, 0.87, 0.67),
        weight=0.3,
    )
    return picture


def clock(size: int = 256, seed: int = 0) -> Floats:
    """A wall clock seen from the front: pale face, dark rim, twelve numbers, two
    hands.
    """
    rng = np.random.default_rng([seed, 5])
    x, y = grid((size, size))
    radius = np.hypot(x - 0.5, y - 0.5)
    picture = canvas((size, size), (0.78, 0.76, 0.72))
    paint(
        picture,
        cover(radius - 0.48, 1 / size),
        rng.uniform(0.04, 0.3, 3),
    )
    paint(
        picture,
        cover(radius - 0.43, 1 / size),
        (0.96, 0.95, 0.91),
    )
    ink = (0.07, 0.07, 0.08)
    for minute in range(60):
        direction = np.array([np.sin(np.pi * minute / 30), np.cos(np.pi * minute / 30)])
        inner = 0.385 if minute % 5 == 0 else 0.4
        line = np.stack([0.5 + direction * inner, 0.5 + direction * 0.418])
        width = 0.007 if minute % 5 == 0 else 0.0025
        paint(
            picture,
            cover(line_distance(x, y, line) - width, 1 / size),
            ink,
        )
        if minute % 5 == 0:
            text, (cx, cy) = str(minute // 5 or 12), 0.5 + direction * 0.325
            half = 0.021 * len(text) + 0.007 * (len(text) - 1)
            write(
                picture,
                text,
                ink,
                box=(cx - half, cy - 0.04, cx + half, cy + 0.04),
                weight=0.26,
            )
    hour = rng.uniform(0, 12)
    minutes = rng.uniform(0, 60)
    for turn, reach, width in ((hour / 12, 0.21, 0.014), (minutes / 60, 0.32, 0.009)):
        direction = np.array([np.sin(2 * np.pi * turn), np.cos(2 * np.pi * turn)])
        line = np.stack([0.5 - direction * 0.05, 0.5 + direction * reach])
        paint(
            picture,
            cover(line_distance(x, y, line) - width, 1 / size),
            ink,
        )
    paint(
        picture,
        cover(radius - 0.022, 1 / size),
        (0.7, 0.1, 0.1),
    )
    return picture


def football(size: int = 256, seed: int = 0) -> Floats:
    """A football on grass: white ball with black pentagons and seams between its
    hexagons, lightly shaded.
    """
    rng = np.random.default_rng([seed, 6])
    picture = grass(size, seed)
    x, y = grid((size, size))
    x = (x - 0.5) / 0.46
    y = (y - 0.5) / 0.46
    radius = np.hypot(x, y)
    normal = np.stack([x, y, np.sqrt(np.clip(1 - radius**2, 0, 1))], -1)
    spin, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    golden = (1 + 5**0.5) / 2
    corners = np.array([(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)])
    twelve = np.concatenate([np.roll(corners, k, 1) for k in range(3)])
    twelve /= np.linalg.norm(twelve, axis=1, keepdims=True)
    close = twelve @ twelve.T > 0.4
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    near = [
        [i, j, k] for i, j, k in triples if close[i, j] and close[i, k] and close[j, k]
    ]
    twenty = np.array([twelve[t].sum(0) for t in near])
    twenty /= np.linalg.norm(twenty, axis=1, keepdims=True)
    # Planes of the truncated icosahedron: pentagons lie a little further out than
    # hexagons.
    heights = (normal @ spin) @ np.concatenate([twelve / 0.9393, twenty / 0.9150]).T
    order = np.argsort(heights, axis=-1)
    first = order[..., -1]
    second = order[..., -2]
    margin = np.take_along_axis(heights, first[..., None], -1) - np.take_along_axis(
        heights, second[..., None], -1
    )
    ball = np.where((first < 12)[..., None], 0.06, 0.95) * np.ones(3)
    seam = cover(margin[..., 0] - 0.025, 0.02) * (first >= 12) * (second >= 12)
    ball = ball * (1 - 0.75 * seam[..., None])
    shade = 0.45 + 0.55 * np.clip(normal @ np.array([-0.35, 0.5, 0.79]), 0, 1)
    paint(
        picture,
        cover(radius - 1, 2 / size),
        (ball * shade[..., None]).astype(np.float32),
    )
    return np.asarray(np.clip(picture, 0, 1), np.float32)
