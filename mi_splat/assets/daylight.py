"""Daylight: a sun, and a sky with clouds."""

from dataclasses import dataclass

import numpy as np

from mi_splat.assets.mesh import Floats
from mi_splat.assets.textures import between

Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """Daylight: a sun far away and a sky with clouds."""

    sun_azimuth: float = 40.0  # degrees from world +x towards +y, where the sun stands
    sun_elevation: float = 45.0  # degrees above the horizon
    sun_strength: float = 2.6  # irradiance of the sun on a surface that faces it
    sun_colour: Colour = (1.0, 0.95, 0.87)  # linear RGB factor
    sky_strength: float = 0.6  # radiance of the sky's zenith
    zenith: Colour = (0.45, 0.68, 1.0)  # linear RGB of the sky overhead
    horizon: Colour = (0.85, 0.93, 1.0)  # linear RGB of the sky at the horizon
    clouds: float = 0.3  # fraction of the sky covered with clouds, 0 to 1
    seed: int = 0  # which clouds


def sky_map(light: Light) -> Floats:
    """(h, w, 3) linear latitude-longitude picture of the sky, zenith first, ground
    below the horizon.
    """
    height = 96
    width = 192
    elevation = np.linspace(90, -90, height, dtype=np.float64)[:, None, None]
    blend = np.exp(-np.maximum(elevation, 0) / 22)
    sky = np.array(light.zenith) * (1 - blend) + np.array(light.horizon) * blend * 1.15
    rng = np.random.default_rng([light.seed, 0xC10D])
    noise = np.zeros((height, width))
    for octave in range(5):
        rows = 3 << octave
        columns = 6 << octave
        y = np.linspace(0, rows - 1, height)
        x = np.arange(width) * columns / width
        noise += between(rng.random((rows, columns)), y, x) / 1.7**octave
    noise = (noise - noise.min()) / max(float(np.ptp(noise)), 1e-9)
    cover = np.clip((noise - (1 - light.clouds)) * 4, 0, 1)[..., None] * np.clip(
        elevation / 12, 0, 1
    )
    white = max(light.horizon) * 1.25
    sky = sky * (1 - cover) + cover * white * (0.75 + 0.25 * noise[..., None])
    ground = np.array([0.2, 0.19, 0.17]) * (0.5 + light.sun_strength / 5)
    return (light.sky_strength * np.where(elevation < 0, ground, sky)).astype(
        np.float32
    )
