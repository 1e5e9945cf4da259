"""Surroundings: a street with houses, trees and lamps."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.ground import grass, road, speckle
from mi_splat.capture.mesh import Asset, Floats, Mesh, rotation, transform, translation
from scenes.recipes.objects import textures
from scenes.recipes.objects.primitives import (
    box,
    ellipsoid,
    extrude,
    quad,
    sheet,
    sweep,
)

REACH = 45.0
"""Half of the length of a street, metres."""


def ground(size: float, texture: Floats, *, tile: float, height: float = 0.0) -> Mesh:
    """A square of edge `size` around the origin whose texture covers `tile` metres."""
    half = size / 2
    grid = np.array(
        [
            [[-half, -half, height], [half, -half, height]],
            [[-half, half, height], [half, half, height]],
        ]
    )
    return sheet(
        grid,
        texture,
        repeat=(size / tile, size / tile),
        smooth=False,
    )


def strip(
    y: tuple[float, float], height: float, texture: Floats, *, tile: float
) -> Mesh:
    """A band of ground along the street between two values of y; u of the texture runs
    across it once.
    """
    low, high = y
    grid = np.array(
        [
            [[-REACH, high, height], [-REACH, low, height]],
            [[REACH, high, height], [REACH, low, height]],
        ]
    )
    return sheet(
        grid,
        texture,
        repeat=((high - low) / tile, 2 * REACH / tile),
        smooth=False,
    )


def tree(rng: np.random.Generator) -> list[Mesh]:
    """A broad-leaved tree or a conifer, 3 to 7 m tall, at the origin."""
    bark = np.array((0.3, 0.22, 0.15)) * rng.uniform(0.7, 1.2)
    green = np.array(
        [rng.uniform(0.16, 0.34), rng.uniform(0.32, 0.48), rng.uniform(0.08, 0.16)]
    )
    leaves = (
        grass(64, int(rng.integers(1 << 30))) * 0.5 + green.astype(np.float32) * 0.5
    )
    tall = rng.uniform(3.5, 6.5)
    trunk = [
        [0, 0, -0.1],
        [rng.normal(0, 0.1), 0, tall * 0.35],
        [0, rng.normal(0, 0.2), tall * 0.7],
    ]
    parts = [sweep(trunk, [0.16, 0.12, 0.06], bark, segments=8)]
    if rng.random() < 0.7:
        for _ in range(9):
            x, y, z = rng.normal(0, 1, 3) * (0.75, 0.75, 0.5)
            size = rng.uniform(1.2, 2.2) * tall / 5
            blob = ellipsoid(
                (size, size, size * 0.85),
                leaves,
                centre=(x, y, tall * 0.72 + z),
                segments=14,
            )
            bumps = 1 + 0.13 * rng.normal(size=(len(blob.vertices), 1))
            middle = blob.vertices.mean(0)
            rough = middle + (blob.vertices - middle) * bumps
            parts.append(Mesh(rough, blob.faces, blob.uvs * 2, leaves, None, False))
    else:
        for level in np.linspace(0.2, 0.85, 5):
            cone = [[0, 0, tall * level], [0, 0, tall * (level + 0.28)]]
            parts.append(
                sweep(
                    cone,
                    [(1.05 - level) * tall * 0.3, 0.02],
                    leaves,
                    segments=12,
                )
            )
    return parts


def lamp(rng: np.random.Generator) -> list[Mesh]:
    """A street lamp at the origin whose arm reaches along +y."""
    iron = np.array((0.22, 0.24, 0.24)) * rng.uniform(0.7, 1.8)
    path = [[0.0, 0.0, 0.0], [0.0, 0.0, 4.6], [0.0, 0.25, 5.2], [0.0, 1.1, 5.4]]
    return [
        sweep(
            path,
            [0.08, 0.055, 0.045, 0.04],
            iron,
            segments=10,
            up=(1, 0, 0),
        ),
        ellipsoid(
            (0.26, 0.7, 0.16),
            (0.85, 0.85, 0.8),
            centre=(0, 1.35, 5.38),
        ),
    ]


def stood(parts: Sequence[Mesh], x: float, y: float, turn: float = 0.0) -> list[Mesh]:
    """Parts turned about z and moved on the ground."""
    return [
        transform(part, translation(x, y, 0) @ rotation("z", turn)) for part in parts
    ]


def _markings(rng: np.random.Generator, right: float, left: float) -> list[Mesh]:
    """A dashed line along the middle of the road, and often lines along its edges."""
    white = np.array((0.88, 0.88, 0.85)) * rng.uniform(0.85, 1.05)
    period = rng.uniform(4, 7)

    def line(x0: float, x1: float, y: float, half: float) -> Mesh:
        corners = ((x0, y - half), (x1, y - half), (x1, y + half), (x0, y + half))
        return quad([(*corner, 0.004) for corner in corners], white)

    middle = (right + left) / 2
    parts = [
        line(x, x + period * 0.5, middle, 0.07)
        for x in np.arange(-REACH + 1, REACH - 1, period)
    ]
    if rng.random() < 0.6:
        parts += [line(-REACH, REACH, y, 0.06) for y in (right + 0.25, left - 0.25)]
    return parts


def _kerb(edge: float, out: float, colour: NDArray[np.float64]) -> list[Mesh]:
    """Kerb stones a metre long in two tones."""
    stones = np.linspace(-REACH, REACH, 91)
    return [
        box(
            (0.99, 0.16, 0.22),
            colour * 1.12 * tone,
            centre=(x + 0.5, edge + out * 0.08, 0.01),
        )
        for kerb, tone in ((stones[:-1:2], 1.0), (stones[1::2], 0.9))
        for x in kerb
    ]


def _row(
    rng: np.random.Generator, out: float, front: float, verge: float
) -> list[Mesh]:
    """Houses side by side whose fronts are at y = `front`, with gaps, and trees at y =
    `verge`; `out` is -1 or 1.
    """
    parts: list[Mesh] = []
    x = -REACH * 0.8
    while x < REACH * 0.8:
        width = rng.uniform(6.5, 10)
        if rng.random() < 0.85:
            home = house(rng, width=width)
            parts += stood(
                home,
                x + width / 2,
                front + out * rng.uniform(0, 1),
                0.0 if out > 0 else 180.0,
            )
        if rng.random() < 0.5:
            parts += stood(tree(rng), x + rng.uniform(0, 2), verge, rng.uniform(0, 360))
        x += width + rng.uniform(0.0, 3.0)
    return parts


def build(seed: int = 0, *, clearance: float = 6.0, centre: float = 0.0) -> Asset:
    """A street along x; the origin is the middle of its right-hand lane, houses stand
    on both sides.
    """
    rng = np.random.default_rng([seed, 0x57])
    lane = rng.uniform(3.2, 3.8)
    right = -lane / 2
    left = 1.5 * lane
    colour = np.array((0.62, 0.6, 0.57)) * rng.uniform(0.8, 1.15)
    paving = textures.tiles(
        192,
        seed,
        colour=colour,
        rows=6,
        columns=4,
        joint=0.03,
        spread=0.06,
    )
    lawn = grass(256, seed)
    asphalt = road(256, seed)
    parts = [
        ground(6 * REACH, lawn, tile=4.0, height=-0.03),
        strip((right, left), 0.0, asphalt, tile=3.0),
    ]
    parts += _markings(rng, right, left)
    walk = rng.uniform(1.6, 2.4)
    verge = rng.uniform(1.0, 2.5)
    for edge, out in ((right, -1.0), (left, 1.0)):
        parts += _kerb(edge, out, colour)
        inner = edge + out * 0.16
        outer = edge + out * walk
        parts.append(
            strip((min(inner, outer), max(inner, outer)), 0.115, paving, tile=1.8)
        )
        parts += _row(
            rng,
            out,
            edge + out * (walk + verge + 2.5),
            edge + out * (walk + verge * 0.6),
        )
        for x in np.arange(-REACH * 0.8, REACH * 0.8, 17.0):
            foot = (x + rng.uniform(3, 8), edge + out * 0.5)
            if np.hypot(foot[0] - centre, foot[1]) > clearance + 1.5:
                parts += stood(lamp(rng), *foot, 180.0 if out > 0 else 0.0)
    return Asset("street", tuple(parts))


WALLS = (
    (0.82, 0.76, 0.64),
    (0.88, 0.86, 0.82),
    (0.62, 0.36, 0.28),
    (0.75, 0.62, 0.45),
    (0.6, 0.68, 0.72),
    (0.8, 0.55, 0.42),
    (0.7, 0.72, 0.62),
    (0.5, 0.27, 0.22),
)
ROOFS = ((0.5, 0.2, 0.14), (0.28, 0.27, 0.29), (0.42, 0.27, 0.2), (0.35, 0.37, 0.4))


def facade(rng: np.random.Generator, *, floors: int, bays: int) -> Floats:
    """The front of a house: wall, windows with frames and bars, a door, a plinth."""
    per = 56
    height = floors * per
    width = bays * per
    wall = np.array(WALLS[rng.integers(len(WALLS))]) * rng.uniform(0.85, 1.1)
    if rng.random() < 0.45:
        bricks = textures.tiles(
            per * 2,
            int(rng.integers(1 << 30)),
            colour=wall,
            rows=16,
            columns=6,
            joint=0.08,
        )
        picture = np.tile(bricks, (floors // 2 + 1, bays // 2 + 1, 1))[
            :height, :width
        ].copy()
    else:
        picture = speckle((height, width), wall, rng, grain=0.015, patch=0.12)
    frame = ((0.93, 0.92, 0.9), (0.3, 0.2, 0.14), (0.2, 0.27, 0.25))[rng.integers(3)]
    door_at = int(rng.integers(bays))
    shutters = rng.random() < 0.3
    colour = rng.uniform(0.08, 0.5, 3)
    for floor in range(floors):
        for bay in range(bays):
            x0 = bay * per
            y0 = (floors - 1 - floor) * per
            if floor == 0 and bay == door_at:
                picture[y0 + 8 : y0 + per, x0 + 16 : x0 + 42] = frame
                picture[y0 + 11 : y0 + per, x0 + 19 : x0 + 39] = colour
                picture[y0 + 15 : y0 + 26, x0 + 23 : x0 + 35] = (0.12, 0.15, 0.18)
                picture[y0 + 32 : y0 + 35, x0 + 35 : x0 + 37] = (0.8, 0.7, 0.3)
                continue
            picture[y0 + 12 : y0 + 43, x0 + 14 : x0 + 43] = frame
            for left in (16, 30):
                pane = picture[y0 + 14 : y0 + 40, x0 + left : x0 + left + 11]
                pane[:] = (0.09, 0.12, 0.16) + np.linspace(0.28, 0, 26)[
                    :, None, None
                ] * rng.uniform(0.2, 1)
                if rng.random() < 0.4:
                    pane[:, : int(rng.integers(2, 8))] = (0.75, 0.72, 0.66)
            picture[y0 + 43 : y0 + 46, x0 + 12 : x0 + 45] = np.clip(
                np.array(frame) * 0.8, 0, 1
            )
            if shutters:
                picture[y0 + 12 : y0 + 43, x0 + 6 : x0 + 13] = colour
                picture[y0 + 12 : y0 + 43, x0 + 44 : x0 + 51] = colour
    picture[-5:] = picture[-5:] * 0.25 + 0.25
    return np.asarray(np.clip(picture, 0, 1), np.float32)


def house(rng: np.random.Generator, *, width: float) -> list[Mesh]:
    """A house whose front lies in the plane y = 0 and looks along -y, from x = -width /
    2 to width / 2.
    """
    floors = int(rng.integers(2, 4))
    bays = max(2, round(width / 2.6))
    tall = floors * 2.8
    deep = 7.0
    front = facade(rng, floors=floors, bays=bays)
    plain = speckle(
        (32, 32),
        front[3, 3],
        rng,
        grain=0.02,
        patch=0.1,
    )
    w = width / 2
    parts = [quad([[-w, 0, 0], [w, 0, 0], [w, 0, tall], [-w, 0, tall]], front)]
    parts.append(
        box(
            (width - 0.01, deep, tall),
            plain,
            centre=(0, deep / 2 + 0.02, tall / 2),
        )
    )
    tiles = textures.tiles(
        96,
        int(rng.integers(1 << 30)),
        colour=ROOFS[rng.integers(len(ROOFS))],
        rows=12,
        columns=10,
    )
    style = rng.integers(3)
    if style == 0:
        parts.append(
            box(
                (width + 0.3, deep + 0.3, 0.35),
                (0.55, 0.54, 0.52),
                centre=(0, deep / 2, tall + 0.17),
            )
        )
        parts.append(
            box(
                (1.6, 1.6, 0.9),
                (0.5, 0.5, 0.5),
                centre=(rng.uniform(-w / 2, w / 2), deep / 2, tall + 0.7),
            )
        )
    elif style == 1:
        rise = rng.uniform(1.6, 2.8)
        over = 0.35
        for y in (-over, deep + over):
            edges = ((y, tall - 0.1), (deep / 2, tall + rise))
            grid = [[[x, *edge] for x in (-w - 0.2, w + 0.2)] for edge in edges]
            parts.append(sheet(grid, tiles, repeat=(width / 2.2, 2.0), smooth=False))
        gable = extrude(
            [[0.0, 0.0], [deep, 0.0], [deep / 2, rise]],
            width,
            plain,
        )
        parts.append(
            transform(
                gable, translation(-w, 0, tall) @ rotation("x", 90) @ rotation("y", 90)
            )
        )
        parts.append(
            box(
                (0.6, 0.6, 1.5),
                (0.45, 0.25, 0.2),
                centre=(w * 0.5, deep * 0.45, tall + rise),
            )
        )
    else:
        rise = rng.uniform(1.8, 3.0)
        for sign in (-1, 1):
            edges = ((sign * (w + 0.25), tall - 0.15), (0, tall + rise))
            grid = [[[x, y, z] for y in (-0.3, deep)] for x, z in edges]
            parts.append(sheet(grid, tiles, repeat=(deep / 2.2, 2.0), smooth=False))
        gable = extrude(
            [[-w, 0.0], [w, 0.0], [0.0, rise]],
            0.1,
            plain,
        )
        parts.append(transform(gable, translation(0, 0.1, tall) @ rotation("x", 90)))
        parts.append(
            box(
                (0.6, 0.6, 1.4),
                (0.45, 0.25, 0.2),
                centre=(w * 0.45, deep * 0.6, tall + rise * 0.7),
            )
        )
    return parts
