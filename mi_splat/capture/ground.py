"""A square of ground: asphalt or a lawn, drawn by code in any size.

Textures are (h, w, 3) float32 sRGB in [0, 1], the same for the same seed.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.capture.daylight import between
from mi_splat.capture.mesh import Asset, Doubles, Floats, Mesh

Kind = Literal["road", "grass", "asphalt"]

SIZE = 256
"""Edge of a texture that repeats, pixels."""
_FLAT_FACES = ((0, 1, 3), (0, 3, 2))


def square_of_ground(
    kind: Kind,
    *,
    side: float,
    tile: float,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Asset:
    """A flat square with a texture that covers `tile` metres; asphalt repeats
    nowhere.
    """
    repeat = side / tile
    if kind == "asphalt":
        texture = road(round(SIZE * repeat))
        repeat = 1.0
    elif kind == "road":
        texture = road()
    else:
        texture = grass()
    x, y, z = centre
    half = side / 2
    corners = [
        (x - half, y - half, z),
        (x + half, y - half, z),
        (x - half, y + half, z),
        (x + half, y + half, z),
    ]
    uvs = [(0.0, 0.0), (repeat, 0.0), (0.0, repeat), (repeat, repeat)]
    mesh = Mesh(
        np.array(corners, np.float32),
        np.array(_FLAT_FACES, np.uint32),
        np.array(uvs, np.float32),
        texture,
        smooth=False,
    )
    return Asset("ground", (mesh,))


def road(size: int = SIZE, seed: int = 0) -> Floats:
    """A road without markings."""
    return asphalt(size, np.random.default_rng([seed, 1]))


def asphalt(size: int, rng: np.random.Generator) -> Floats:
    """Asphalt with cracks."""
    grey = rng.uniform(0.27, 0.42)
    colour = (grey, grey, grey * 1.02)
    texture = speckle((size, size), colour, rng, grain=0.12, patch=0.3)
    middle = fractal_noise((size, size), rng, cells=3) - 0.5
    crack = np.clip(1 - np.abs(middle) / 0.006, 0, 1)
    paint(texture, 0.45 * crack, (0.12, 0.12, 0.12))
    return texture


def grass(size: int = SIZE, seed: int = 0) -> Floats:
    """A lawn: short blades in many greens over darker ground."""
    rng = np.random.default_rng([seed, 2])
    red = rng.uniform(0.22, 0.42)
    green = rng.uniform(0.42, 0.55)
    blue = rng.uniform(0.12, 0.2)
    base = np.array([red, green, blue])
    value = 0.75 + 0.5 * fractal_noise((size, size), rng, cells=5)
    texture = np.clip(base * value[..., None], 0, 1).astype(np.float32)
    blades = size * size // 10
    rows, columns = rng.integers(0, size, (2, blades))
    length = rng.integers(2, 7, blades)
    lean = rng.uniform(-0.8, 0.8, blades)
    shade = rng.uniform(0.55, 1.6, (blades, 1))
    tint = base * shade + rng.uniform(-0.05, 0.05, (blades, 3))
    for step in range(7):
        on = length > step
        row = (rows[on] - step) % size
        column = np.round(columns[on] + lean[on] * step).astype(int) % size
        texture[row, column] = np.clip(tint[on], 0, 1) * (0.7 + 0.06 * step)
    return np.asarray(np.clip(texture, 0, 1), np.float32)


def speckle(
    size: tuple[int, int],
    colour: ArrayLike,
    rng: np.random.Generator,
    *,
    grain: float,
    patch: float,
) -> Floats:
    """A rough mineral surface: `grain` is the amplitude of single grains, `patch` that
    of large stains.
    """
    value = 1 + grain * rng.normal(size=size)
    value += patch * (fractal_noise(size, rng) - 0.5)
    value += grain * 2 * (fractal_noise(size, rng, cells=48, octaves=2) - 0.5)
    return np.clip(np.asarray(colour) * value[..., None], 0, 1).astype(np.float32)


def paint(texture: Floats, mask: Doubles, colour: ArrayLike) -> None:
    """Blend `colour` (3,) or (h, w, 3) into `texture`, in place."""
    weight = mask[..., None].astype(np.float32)
    texture *= 1 - weight
    texture += weight * np.asarray(colour, np.float32)


def fractal_noise(
    size: tuple[int, int],
    rng: np.random.Generator,
    *,
    cells: int = 4,
    octaves: int = 5,
) -> Doubles:
    """(h, w) smooth noise in [0, 1] that repeats at its edges: value noise summed over
    octaves (Ebert et al. 2003).
    """
    height, width = size
    total = np.zeros(size)
    for octave in range(octaves):
        count = cells << octave
        if count > min(size):
            break
        y = np.arange(height) * count / height
        x = np.arange(width) * count / width
        total += between(rng.random((count, count)), y, x) / 2**octave
    span = float(np.ptp(total)) or 1.0
    scaled: Doubles = (total - total.min()) / span
    return scaled
