"""What stands around the objects in training images: the project's own streets, parks
and rooms, or random things.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from mi_splat.capture.daylight import Light
from mi_splat.capture.ground import grass, road, speckle
from mi_splat.capture.mesh import Asset, Floats, Mesh, rotation, transform, translation
from scenes.recipes.objects import street, textures
from scenes.recipes.objects.primitives import box, ellipsoid, lathe, quad, sheet

Pixels = NDArray[np.float32]

CLEARANCE = 7.5
"""Metres around the origin without a wall, where the houses of a street begin; cameras
in it see what is there.
"""


def noise(
    rng: Generator,
    size: int = 128,
    *,
    cells: int = 3,
    octaves: int = 5,
    gain: float = 0.6,
) -> Pixels:
    """(size, size) smooth random values in [0, 1] that tile, coarse ones mixed with
    ever finer ones.

    Sums of value noise at doubling frequencies, as in Ebert et al., "Texturing and
    Modeling", 1994.
    """
    total = np.zeros((size, size))
    for octave in range(octaves):
        count = cells << octave
        grid = rng.random((count, count))
        at = np.arange(size) * count / size
        i = at.astype(int)
        f = at - i
        f = f * f * (3 - 2 * f)
        j = (i + 1) % count
        rows = grid[i % count] * (1 - f)[:, None] + grid[j] * f[:, None]
        total += (rows[:, i % count] * (1 - f) + rows[:, j] * f) * gain**octave
    low = total.min()
    high = total.max()
    return np.asarray((total - low) / max(high - low, 1e-9), np.float32)


def colour(rng: Generator) -> Pixels:
    """(3,) sRGB: now and then saturated, more often the dull colours that most of the
    world has.
    """
    hue = rng.random(3)
    grey = rng.uniform(0.1, 0.9)
    weight = rng.beta(1.2, 2.0)
    return np.asarray(
        np.clip(grey * (1 - weight) + hue * weight, 0.03, 0.95), np.float32
    )


def pattern(rng: Generator) -> Pixels:
    """(h, w, 3) random texture: plain, noise, stripes, checks, bricks, or grain."""
    first = colour(rng)
    second = colour(rng)
    kind = rng.integers(6)
    if kind == 0:
        return first.reshape(1, 1, 3)
    size = 128
    y, x = np.mgrid[:size, :size] / size
    count = int(rng.integers(2, 12))
    if kind == 1:
        mask = noise(rng, cells=int(rng.integers(2, 9)), gain=rng.uniform(0.4, 0.9))
    elif kind == 2:
        mask = (np.sin(2 * np.pi * count * x) > rng.uniform(-0.8, 0.8)).astype(
            np.float32
        )
    elif kind == 3:
        mask = ((np.floor(x * 2 * count) + np.floor(y * 2 * count)) % 2).astype(
            np.float32
        )
    elif kind == 4:
        shift = (np.floor(y * 2 * count) % 2) * 0.5
        mask = (((x * count + shift) % 1 < 0.06) | (y * 2 * count % 1 < 0.1)).astype(
            np.float32
        )
    else:
        mask = np.clip(0.5 + 0.3 * rng.standard_normal((size, size)), 0, 1).astype(
            np.float32
        )
    picture = first + (second - first) * np.asarray(mask, np.float32)[..., None]
    picture = picture * (1 - 0.3 * rng.random() * noise(rng)[..., None])
    return np.asarray(np.clip(picture, 0.02, 0.98), np.float32)


def ground_texture(rng: Generator) -> Pixels:
    """(h, w, 3) texture in the colours that grounds have: asphalt, grass, soil, sand,
    snow; or any pattern at all.
    """
    palette = {
        "asphalt": ((0.18, 0.18, 0.19), (0.4, 0.4, 0.41)),
        "grass": ((0.1, 0.2, 0.05), (0.42, 0.52, 0.2)),
        "soil": ((0.22, 0.15, 0.1), (0.5, 0.38, 0.27)),
        "sand": ((0.6, 0.52, 0.38), (0.85, 0.77, 0.6)),
        "snow": ((0.75, 0.78, 0.82), (0.95, 0.95, 0.97)),
    }
    kind = rng.choice([*palette, "pattern"], p=[0.22, 0.22, 0.14, 0.1, 0.07, 0.25])
    if kind == "pattern":
        return pattern(rng)
    low, high = (np.array(c, np.float32) for c in palette[str(kind)])
    mix = noise(
        rng, 256, cells=int(rng.integers(2, 7)), octaves=6, gain=rng.uniform(0.6, 1.0)
    )
    grain = rng.normal(0, rng.uniform(0.01, 0.07), (256, 256, 1))
    return np.asarray(
        np.clip(low + (high - low) * mix[..., None] + grain, 0.02, 0.98), np.float32
    )


def ground(rng: Generator, extent: float) -> Mesh:
    """A textured square on z = 0 that reaches `extent` metres from the origin each
    way.
    """
    corners = [
        [[-extent, -extent, 0], [extent, -extent, 0]],
        [[-extent, extent, 0], [extent, extent, 0]],
    ]
    repeat = float(rng.uniform(3, 25))
    turned = rotation("z", float(rng.uniform(0, 360)))
    return transform(
        sheet(corners, ground_texture(rng), repeat=(repeat, repeat), smooth=False),
        turned,
    )


def wall(rng: Generator, distance: float) -> Mesh:
    """An upright wall `distance` metres from the origin."""
    half = distance * rng.uniform(0.8, 4)
    height = distance * rng.uniform(0.4, 2.5)
    x = -distance
    corners = [[x, -half, 0], [x, half, 0], [x, half, height], [x, -half, height]]
    return transform(
        quad(corners, pattern(rng)), rotation("z", float(rng.uniform(0, 360)))
    )


def clutter(rng: Generator, size: float) -> Mesh:
    """A box, ball, cylinder or cone of random texture standing on the ground at the
    origin, about `size` metres big.
    """
    width, depth, height = size * rng.uniform(0.25, 1.0, 3)
    roughness = None if rng.random() < 0.6 else float(rng.uniform(0.05, 0.4))
    kind = rng.integers(4)
    if kind == 0:
        mesh = box(
            (width, depth, height),
            pattern(rng),
            centre=(0, 0, height / 2),
            roughness=roughness,
        )
    elif kind == 1:
        mesh = ellipsoid(
            (width, depth, height),
            pattern(rng),
            centre=(0, 0, height / 2),
            roughness=roughness,
        )
    else:
        top = width / 2 if kind == 2 else width * rng.uniform(0, 0.3)
        profile = [(0, 0), (width / 2, 0), (top, height), (0, height)]
        mesh = lathe(profile, pattern(rng), segments=16, roughness=roughness)
    return transform(mesh, rotation("z", float(rng.uniform(0, 360))))


def scatter(rng: Generator, radius: float) -> list[Mesh]:
    """Clutter in a ring around things that reach `radius` metres from the origin."""
    meshes = []
    for _ in range(int(rng.integers(0, 5))):
        size = radius * rng.uniform(0.2, 1.1)
        angle = rng.uniform(0, 2 * np.pi)
        away = radius + size * 0.75 + radius * rng.exponential(0.6)
        meshes.append(
            transform(
                clutter(rng, size),
                translation(away * np.cos(angle), away * np.sin(angle), 0),
            )
        )
    return meshes


def random_surroundings(rng: Generator, radius: float) -> Asset:
    """Random surroundings of objects that reach `radius` metres from the origin."""
    meshes = scatter(rng, radius)
    if rng.random() < 0.9:
        meshes.append(ground(rng, radius * rng.uniform(15, 40)))
    if rng.random() < 0.35:
        meshes.append(wall(rng, radius * rng.uniform(1.6, 6)))
    if not meshes:
        meshes.append(transform(clutter(rng, radius), translation(0, 0, -3 * radius)))
    return Asset("surroundings", tuple(meshes))


def daylight(seed: int) -> Light:
    """A plausible light for `seed`: bright sun at any time of the day, haze, or an
    overcast sky.
    """
    rng = np.random.default_rng([seed, 0x11647])
    overcast = float(np.clip(rng.normal(0.35, 0.4), 0, 1))
    elevation = float(rng.uniform(12, 75))
    warm = math.exp(-elevation / 22)
    exposure = float(rng.uniform(0.75, 1.15))
    grey = np.array([0.86, 0.9, 0.95])
    zenith = np.array([0.32, 0.55, 1.0]) * (1 - overcast) + grey * overcast
    horizon = (
        np.array([0.85 + 0.15 * warm, 0.92 - 0.05 * warm, 1.0 - 0.3 * warm])
        * (1 - overcast)
        + grey * overcast
    )
    return Light(
        sun_azimuth=float(rng.uniform(0, 360)),
        sun_elevation=elevation,
        sun_strength=exposure * 2.8 * (1 - overcast) ** 1.5 * (1 - 0.4 * warm),
        sun_colour=(1.0, 0.96 - 0.25 * warm, 0.9 - 0.5 * warm),
        sky_strength=exposure * (0.55 + 0.7 * overcast),
        zenith=(float(zenith[0]), float(zenith[1]), float(zenith[2])),
        horizon=(float(horizon[0]), float(horizon[1]), float(horizon[2])),
        clouds=float(rng.uniform(0, 0.8)),
        seed=seed,
    )


def park(seed: int = 0, *, clearance: float = 8.0) -> Asset:
    """Grass with trees around and often a path."""
    rng = np.random.default_rng([seed, 0x9A])
    parts = [street.ground(240, grass(256, seed), tile=rng.uniform(2.5, 5))]
    for _ in range(int(rng.integers(5, 16))):
        angle = rng.uniform(0, 2 * np.pi)
        reach = clearance + 3 + rng.uniform(0, 25)
        parts += street.stood(
            street.tree(rng),
            reach * np.cos(angle),
            reach * np.sin(angle),
            rng.uniform(0, 360),
        )
    if rng.random() < 0.6:
        gravel = speckle((128, 128), (0.62, 0.55, 0.45), rng, grain=0.15, patch=0.2)
        offset = rng.uniform(-4, 4)
        width = rng.uniform(1.5, 3)
        path = street.strip(
            (offset - width / 2, offset + width / 2), 0.01, gravel, tile=1.5
        )
        parts.append(transform(path, rotation("z", rng.uniform(0, 360))))
    return Asset("park", tuple(parts))


def plain(seed: int = 0) -> Asset:
    """Open ground of one kind: asphalt, paving, sand, earth, snow, concrete or
    grass.
    """
    rng = np.random.default_rng([seed, 0x91])
    tone = rng.uniform(0.8, 1.15)
    makers: tuple[Callable[[], Floats], ...] = (
        lambda: road(256, seed),
        lambda: textures.marked_road(256, seed),
        lambda: textures.tiles(
            256, seed, colour=rng.uniform(0.4, 0.7, 3), rows=8, columns=6, joint=0.03
        ),
        lambda: speckle(
            (256, 256), np.array((0.76, 0.66, 0.48)) * tone, rng, grain=0.05, patch=0.2
        ),
        lambda: speckle(
            (256, 256), np.array((0.4, 0.3, 0.21)) * tone, rng, grain=0.1, patch=0.4
        ),
        lambda: speckle((256, 256), (0.88, 0.9, 0.93), rng, grain=0.015, patch=0.07),
        lambda: speckle(
            (256, 256), np.array((0.6, 0.6, 0.58)) * tone, rng, grain=0.05, patch=0.2
        ),
        lambda: grass(256, seed),
    )
    number = int(rng.integers(len(makers)))
    return Asset(
        "ground",
        (
            street.ground(
                260, makers[number](), tile=7.0 if number == 1 else rng.uniform(2.5, 6)
            ),
        ),
    )


def room(seed: int = 0, *, size: float = 14.0) -> Asset:
    """The floor and two walls of a large room without a ceiling, daylight coming from
    above.
    """
    rng = np.random.default_rng([seed, 0x90])
    colour = np.array(
        [(0.55, 0.38, 0.22), (0.7, 0.55, 0.36), (0.35, 0.22, 0.13), (0.75, 0.74, 0.7)][
            rng.integers(4)
        ]
    )
    boards = textures.tiles(
        256, seed, colour=colour, rows=16, columns=2, joint=0.02, spread=0.09
    )
    parts = [street.ground(size * 3, boards, tile=rng.uniform(1.8, 3))]
    wall = np.clip(rng.uniform(0.45, 0.9) + rng.uniform(-0.12, 0.12, 3), 0, 1)
    paper = speckle((64, 64), wall, rng, grain=0.01, patch=0.05)
    if rng.random() < 0.4:
        paper[:, ::8] *= 0.85
    for turn in (0.0, 90.0, 180.0, 270.0)[: int(rng.integers(1, 4))]:
        side = box((0.2, 3 * size, 2.8), paper, centre=(-size, 0, 1.4))
        skirting = box(
            (0.05, 3 * size, 0.14), (0.9, 0.9, 0.88), centre=(-size + 0.12, 0, 0.07)
        )
        parts += [transform(m, rotation("z", turn)) for m in (side, skirting)]
    return Asset("room", tuple(parts))


def backdrop(seed: int = 0, *, clearance: float = 8.0) -> Asset:
    """Surroundings by chance, turned and shifted: a street, a park, open ground, a
    room.
    """
    rng = np.random.default_rng([seed, 0xBAC])
    kind = rng.random()
    if kind < 0.35 and clearance <= 7.5:
        shift = rng.uniform(-15, 15)
        return street.build(seed, clearance=clearance, centre=-shift).transformed(
            translation(shift, rng.uniform(-0.5, 0.5), 0)
        )
    turn = rotation("z", rng.uniform(0, 360))
    if kind < 0.5:
        return park(seed, clearance=clearance).transformed(turn)
    return (plain(seed) if kind < 0.85 else room(seed, size=clearance + 2)).transformed(
        turn
    )


def of_kind(kind: str, seed: int, rng: Generator, radius: float) -> Asset:
    """Surroundings of one kind that leave their middle free."""
    if kind == "street":
        shift = rng.uniform(-15, 15)
        return street.build(seed, clearance=CLEARANCE, centre=-shift).transformed(
            translation(shift, 0, 0)
        )
    if kind == "park":
        return park(seed, clearance=CLEARANCE)
    if kind == "room":
        return room(seed, size=CLEARANCE + 2)
    if kind == "ground":
        return plain(seed)
    return random_surroundings(rng, radius)
