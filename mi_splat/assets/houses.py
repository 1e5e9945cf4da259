"""Houses: a facade with windows and a door, walls, and one of three roofs."""

from __future__ import annotations

import numpy as np

from mi_splat.assets import textures
from mi_splat.assets.mesh import Floats, Mesh, rotation, transform, translation
from mi_splat.assets.primitives import box, extrude, quad, sheet

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
    height, width = floors * per, bays * per
    wall = np.array(WALLS[rng.integers(len(WALLS))]) * rng.uniform(0.85, 1.1)
    if rng.random() < 0.45:
        bricks = textures.tiles(per * 2, int(rng.integers(1 << 30)), colour=wall, rows=16, columns=6, joint=0.08)
        picture = np.tile(bricks, (floors // 2 + 1, bays // 2 + 1, 1))[:height, :width].copy()
    else:
        picture = textures.speckle((height, width), wall, rng, grain=0.015, patch=0.12)
    frame = ((0.93, 0.92, 0.9), (0.3, 0.2, 0.14), (0.2, 0.27, 0.25))[rng.integers(3)]
    door_at = int(rng.integers(bays))
    shutters = rng.random() < 0.3
    colour = rng.uniform(0.08, 0.5, 3)
    for floor in range(floors):
        for bay in range(bays):
            x0, y0 = bay * per, (floors - 1 - floor) * per
            if floor == 0 and bay == door_at:
                picture[y0 + 8 : y0 + per, x0 + 16 : x0 + 42] = frame
                picture[y0 + 11 : y0 + per, x0 + 19 : x0 + 39] = colour
                picture[y0 + 15 : y0 + 26, x0 + 23 : x0 + 35] = (0.12, 0.15, 0.18)
                picture[y0 + 32 : y0 + 35, x0 + 35 : x0 + 37] = (0.8, 0.7, 0.3)
                continue
            picture[y0 + 12 : y0 + 43, x0 + 14 : x0 + 43] = frame
            for left in (16, 30):
                pane = picture[y0 + 14 : y0 + 40, x0 + left : x0 + left + 11]
                pane[:] = (0.09, 0.12, 0.16) + np.linspace(0.28, 0, 26)[:, None, None] * rng.uniform(0.2, 1)
                if rng.random() < 0.4:
                    pane[:, : int(rng.integers(2, 8))] = (0.75, 0.72, 0.66)
            picture[y0 + 43 : y0 + 46, x0 + 12 : x0 + 45] = np.clip(np.array(frame) * 0.8, 0, 1)
            if shutters:
                picture[y0 + 12 : y0 + 43, x0 + 6 : x0 + 13] = colour
                picture[y0 + 12 : y0 + 43, x0 + 44 : x0 + 51] = colour
    picture[-5:] = picture[-5:] * 0.25 + 0.25
    return np.asarray(np.clip(picture, 0, 1), np.float32)


def house(rng: np.random.Generator, *, width: float) -> list[Mesh]:
    """A house whose front lies in the plane y = 0 and looks along -y, from x = -width / 2 to width / 2."""
    floors, bays = int(rng.integers(2, 4)), max(2, round(width / 2.6))
    tall, deep = floors * 2.8, 7.0
    front = facade(rng, floors=floors, bays=bays)
    plain = textures.speckle((32, 32), front[3, 3], rng, grain=0.02, patch=0.1)
    w = width / 2
    parts = [quad([[-w, 0, 0], [w, 0, 0], [w, 0, tall], [-w, 0, tall]], front)]
    parts.append(box((width - 0.01, deep, tall), plain, centre=(0, deep / 2 + 0.02, tall / 2)))
    tiles = textures.tiles(96, int(rng.integers(1 << 30)), colour=ROOFS[rng.integers(len(ROOFS))], rows=12, columns=10)
    style = rng.integers(3)
    if style == 0:
        parts.append(box((width + 0.3, deep + 0.3, 0.35), (0.55, 0.54, 0.52), centre=(0, deep / 2, tall + 0.17)))
        parts.append(box((1.6, 1.6, 0.9), (0.5, 0.5, 0.5), centre=(rng.uniform(-w / 2, w / 2), deep / 2, tall + 0.7)))
    elif style == 1:
        rise, over = rng.uniform(1.6, 2.8), 0.35
        for y0, y1 in ((-over, deep / 2), (deep + over, deep / 2)):
            grid = np.array(
                [
                    [[-w - 0.2, y0, tall - 0.1], [w + 0.2, y0, tall - 0.1]],
                    [[-w - 0.2, y1, tall + rise], [w + 0.2, y1, tall + rise]],
                ]
            )
            parts.append(sheet(grid, tiles, repeat=(width / 2.2, 2.0), smooth=False))
        gable = extrude([[0.0, 0.0], [deep, 0.0], [deep / 2, rise]], width, plain)
        parts.append(transform(gable, translation(-w, 0, tall) @ rotation("x", 90) @ rotation("y", 90)))
        parts.append(box((0.6, 0.6, 1.5), (0.45, 0.25, 0.2), centre=(w * 0.5, deep * 0.45, tall + rise)))
    else:
        rise = rng.uniform(1.8, 3.0)
        for sign in (-1, 1):
            grid = np.array(
                [
                    [[sign * (w + 0.25), -0.3, tall - 0.15], [sign * (w + 0.25), deep, tall - 0.15]],
                    [[0, -0.3, tall + rise], [0, deep, tall + rise]],
                ]
            )
            parts.append(sheet(grid, tiles, repeat=(deep / 2.2, 2.0), smooth=False))
        gable = extrude([[-w, 0.0], [w, 0.0], [0.0, rise]], 0.1, plain)
        parts.append(transform(gable, translation(0, 0.1, tall) @ rotation("x", 90)))
        parts.append(box((0.6, 0.6, 1.4), (0.45, 0.25, 0.2), centre=(w * 0.45, deep * 0.6, tall + rise * 0.7)))
    return parts
