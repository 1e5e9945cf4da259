"""Stop signs: a red octagon with a white border and the word STOP on a pole."""

import numpy as np

from mi_splat.capture.mesh import rotation, transform, translation
from scenes.recipes.objects import textures
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import (
    box,
    ellipsoid,
    extrude,
    lathe,
    regular_polygon,
    rounded_rectangle,
    sweep,
)

STEEL = (0.55, 0.56, 0.57)


def build(seed: int = 0) -> Model:
    """A stop sign about 2.4 m tall whose face, 0.75 m across, looks along +x; the post
    counts as its support.
    """
    rng = np.random.default_rng([seed, 0x570B])
    width = 0.75 * rng.uniform(0.93, 1.1)
    top = 2.4 * rng.uniform(0.92, 1.08)
    outline = regular_polygon(8, width / 2 / np.cos(np.pi / 8), turn=22.5)
    face = extrude(
        outline,
        0.012,
        textures.stop_sign(256, seed),
        roughness=0.25 if rng.random() < 0.6 else None,
    )
    back = extrude(
        outline * 0.995,
        0.01,
        np.array(STEEL) * rng.uniform(0.7, 1.2),
    )
    upright = (
        translation(0.045, 0, top - width / 2 - 0.02)
        @ rotation("z", 90)
        @ rotation("x", 90)
    )
    tilt = rotation("x", float(rng.normal(0, 1.5)))
    plate = [
        transform(face, upright),
        transform(back, translation(-0.011, 0, 0) @ upright),
    ]
    parts = []
    pole = np.array(
        [
            STEEL,
            (0.38, 0.39, 0.4),
            (0.3, 0.36, 0.32),
            (0.75, 0.75, 0.74),
            (0.4, 0.3, 0.22),
        ][rng.integers(5)]
    )
    if rng.random() < 0.5:
        parts.append(
            sweep(
                [[0.0, 0.0, 0.0], [0.0, 0.0, top - 0.05]],
                [0.032, 0.032],
                pole,
                segments=14,
                roughness=0.3,
            )
        )
        parts.append(
            ellipsoid(
                (0.066, 0.066, 0.03),
                pole,
                centre=(0, 0, top - 0.05),
            )
        )
    else:
        post = extrude(rounded_rectangle(0.05, 0.075, 0.008, corner=2), top, pole)
        parts.append(post)
    for height in (0.18, -0.18):
        z = top - width / 2 - 0.02 + height
        parts.append(
            box(
                (0.05, 0.24, 0.03),
                np.array(STEEL) * 0.8,
                centre=(0.012, 0, z),
            )
        )
    base = lathe(
        [[0.13, 0], [0.12, 0.03], [0.05, 0.045], [0.035, 0.08]],
        (0.45, 0.45, 0.44),
        segments=16,
    )
    parts.append(base)
    return Model(
        "stop sign",
        tuple(transform(part, tilt) for part in (*plate, *parts)),
        supports=len(parts),
    )
