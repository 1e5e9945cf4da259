"""Daylight: a sun, and a sky with clouds."""

from dataclasses import dataclass

import numpy as np

from mi_splat.capture.mesh import Doubles, Floats

Colour = tuple[float, float, float]

_HEIGHT, _WIDTH = 96, 192
"""Of the map of the sky, pixels."""
_CLOUDS = 0xC10D
"""Keeps the draws of clouds apart from those of others with the same seed."""
_GROUND = (0.2, 0.19, 0.17)
"""Linear RGB below the horizon."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """Daylight: a sun far away and a sky with clouds."""

    # degrees from world +x towards +y, where the sun stands
    sun_azimuth: float = 40.0
    sun_elevation: float = 45.0  # degrees above the horizon
    sun_strength: float = 2.6  # irradiance of the sun on a surface that faces it
    sun_colour: Colour = (1.0, 0.95, 0.87)  # linear RGB factor
    sky_strength: float = 0.6  # radiance of the sky's zenith
    zenith: Colour = (0.45, 0.68, 1.0)  # linear RGB of the sky overhead
    horizon: Colour = (0.85, 0.93, 1.0)  # linear RGB of the sky at the horizon
    clouds: float = 0.3  # fraction of the sky covered with clouds, 0 to 1
    seed: int = 0  # which clouds


def sky_map(light: Light) -> Floats:
    """(h, w, 3) linear latitude-longitude image of the sky, zenith first, ground below
    the horizon.
    """
    angles = np.linspace(90, -90, _HEIGHT, dtype=np.float64)
    elevation = angles[:, None, None]
    blend = np.exp(-np.maximum(elevation, 0) / 22)
    overhead = np.array(light.zenith) * (1 - blend)
    sky = overhead + np.array(light.horizon) * blend * 1.15
    noise = _cloud_noise(light.seed)
    thickness = np.clip((noise - (1 - light.clouds)) * 4, 0, 1)
    cover = thickness[..., None] * np.clip(elevation / 12, 0, 1)
    white = max(light.horizon) * 1.25
    sky = sky * (1 - cover) + cover * white * (0.75 + 0.25 * noise[..., None])
    ground = np.array(_GROUND) * (0.5 + light.sun_strength / 5)
    both = np.where(elevation < 0, ground, sky)
    return (light.sky_strength * both).astype(np.float32)


def _cloud_noise(seed: int) -> Doubles:
    """(h, w) noise in [0, 1] that repeats from left to right."""
    rng = np.random.default_rng([seed, _CLOUDS])
    noise = np.zeros((_HEIGHT, _WIDTH))
    for octave in range(5):
        rows = 3 << octave
        columns = 6 << octave
        y = np.linspace(0, rows - 1, _HEIGHT)
        x = np.arange(_WIDTH) * columns / _WIDTH
        noise += between(rng.random((rows, columns)), y, x) / 1.7**octave
    span = max(float(np.ptp(noise)), 1e-9)
    scaled: Doubles = (noise - noise.min()) / span
    return scaled


def between(cells: Doubles, y: Doubles, x: Doubles) -> Doubles:
    """Smooth values between the cells of a grid at fractional rows and columns; the
    grid repeats.
    """
    rows, columns = cells.shape
    i = y.astype(int)
    j = x.astype(int)
    down = _eased(y - i)[:, None]
    across = _eased(x - j)[None]

    def along(row: Doubles) -> Doubles:
        return row[:, j] * (1 - across) + row[:, (j + 1) % columns] * across

    top = along(cells[i])
    bottom = along(cells[(i + 1) % rows])
    return np.asarray(top * (1 - down) + bottom * down, np.float64)


def _eased(t: Doubles) -> Doubles:
    """From 0 to 1 with no slope at both ends."""
    return t * t * (3 - 2 * t)
