"""Fire hydrants: a painted barrel on a flange, with a bonnet, two hose outlets and one
for the engine.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.capture.mesh import Mesh, rotation, transform, translation
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import ellipsoid, extrude, lathe, regular_polygon

PAINTS = ((0.72, 0.08, 0.06), (0.88, 0.66, 0.06), (0.86, 0.3, 0.06), (0.68, 0.1, 0.1))


def build(seed: int = 0, colour: Sequence[float] | None = None) -> Model:
    """A hydrant about 0.75 m high whose large outlet faces +x, in a paint of its seed
    or of an sRGB colour.
    """
    rng = np.random.default_rng([seed, 0xF12E])
    height = 0.75 * rng.uniform(0.93, 1.08)
    radius = 0.105 * rng.uniform(0.94, 1.08)
    drawn = np.clip(
        np.array(PAINTS[rng.integers(len(PAINTS))]) + rng.uniform(-0.04, 0.04, 3),
        0.02,
        0.95,
    )
    paint = drawn if colour is None else np.asarray(colour, np.float64)
    if rng.random() < 0.5:
        caps = paint
    else:
        caps = np.array(
            [(0.8, 0.8, 0.8), (0.15, 0.25, 0.55), (0.9, 0.75, 0.1)][seed % 3]
        )
    shoulder = 0.72 * height
    flange = 1.55 * radius
    parts = [
        lathe(
            [[flange, 0], [flange, 0.035], [radius, 0.05], [radius, shoulder]],
            paint,
            segments=40,
            roughness=0.3,
        ),
        lathe(
            [
                [1.3 * radius, shoulder],
                [1.3 * radius, shoulder + 0.03],
                [1.08 * radius, shoulder + 0.035],
            ],
            paint * 0.9,
            segments=40,
            roughness=0.3,
        ),
        *_bonnet(1.08 * radius, shoulder + 0.035, height - 0.05, caps),
        *_bolts(flange * 0.87, 0.035),
        *_bolts(1.17 * radius, shoulder + 0.03),
    ]
    level = 0.57 * height
    parts += _outlet(0.078 * rng.uniform(0.9, 1.1), radius, level, 0.0, paint, caps)
    for side in (90.0, -90.0):
        parts += _outlet(
            0.05 * rng.uniform(0.9, 1.1), radius, level + 0.03, side, paint, caps
        )
    return Model("fire hydrant", tuple(parts))


def _bonnet(radius: float, low: float, high: float, colour: ArrayLike) -> list[Mesh]:
    """A dome from one height to another, with a nut on top."""
    angles = np.linspace(0, np.pi / 2, 8)
    dome = [[radius * np.cos(a), low + (high - low) * np.sin(a)] for a in angles]
    nut = extrude(regular_polygon(5, 0.03), 0.05, np.asarray(colour) * 0.8)
    return [
        lathe(dome, colour, segments=40, roughness=0.3),
        transform(nut, translation(0, 0, high - 0.005)),
    ]


def _bolts(radius: float, level: float) -> list[Mesh]:
    """Eight bolts on a flange."""
    bolt = ellipsoid((0.026, 0.026, 0.024), (0.3, 0.3, 0.3), segments=10)
    angles = 2 * np.pi * np.arange(8) / 8
    return [
        transform(bolt, translation(radius * np.cos(a), radius * np.sin(a), level))
        for a in angles
    ]


def _outlet(
    size: float,
    radius: float,
    level: float,
    azimuth: float,
    colour: ArrayLike,
    caps: ArrayLike,
) -> list[Mesh]:
    """A pipe from the barrel in a direction, degrees, with a cap and a nut."""
    end = radius + 0.05
    pipe = lathe(
        [[size, 0], [size, end]],
        colour,
        segments=28,
        roughness=0.3,
    )
    cap = lathe(
        [[1.22 * size, end], [1.22 * size, end + 0.04], [0.9 * size, end + 0.05]],
        caps,
        segments=28,
    )
    nut = transform(
        extrude(
            regular_polygon(5, 0.3 * size),
            0.03,
            np.asarray(caps) * 0.8,
        ),
        translation(0, 0, end + 0.045),
    )
    pose = translation(0, 0, level) @ rotation("z", azimuth) @ rotation("y", 90)
    return [transform(part, pose) for part in (pipe, cap, nut)]
