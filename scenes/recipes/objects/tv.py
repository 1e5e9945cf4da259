"""Flat television sets: a thin screen with a bezel on a foot, dark or showing an
image.
"""

import numpy as np

from mi_splat.capture.ground import paint
from mi_splat.capture.mesh import Floats, Mesh, rotation, transform, translation
from scenes.recipes.objects import textures
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import (
    at_height,
    box,
    loft,
    quad,
    rounded_rectangle,
    sweep,
)


def _landscape(rng: np.random.Generator) -> Floats:
    """Sky, sun, hills and a lake."""
    picture = textures.canvas((144, 256), (0, 0, 0))
    x, y = textures.grid((144, 256))
    low = rng.uniform(0.6, 1.0, 3)
    high = rng.uniform(0.15, 0.7, 3) * (0.6, 0.8, 1.3)
    picture[:] = low * (1 - y[..., None]) + np.clip(high, 0, 1) * y[..., None]
    sun = np.hypot((x - rng.uniform(0.15, 0.85)) * 16 / 9, y - rng.uniform(0.65, 0.85))
    paint(
        picture,
        textures.cover(sun - 0.07, 0.01),
        (1.0, 0.95, 0.7),
    )
    for level in (0.55, 0.42, 0.28):
        ridge = level + 0.09 * np.sin(x * rng.uniform(4, 9) + rng.uniform(0, 6))
        ridge += 0.03 * np.sin(x * 23 + rng.uniform(0, 6))
        paint(
            picture,
            textures.cover(y - ridge, 0.01),
            rng.uniform(0.05, 0.6, 3) * (0.7, 1.0, 0.7),
        )
    return np.clip(picture, 0, 1)


def _match(rng: np.random.Generator) -> Floats:
    """A football pitch with stripes, lines and players as small dots."""
    picture = textures.canvas((144, 256), (0.12, 0.45, 0.16))
    x, y = textures.grid((144, 256))
    paint(
        picture,
        np.where((x * 10) % 1 < 0.5, 0.3, 0.0),
        (0.2, 0.6, 0.2),
    )
    circle = np.abs(np.hypot((x - 0.5) * 16 / 9, y - 0.5) - 0.2)
    for line in (np.abs(x - 0.5), circle, np.abs(y - 0.05), np.abs(y - 0.95)):
        paint(
            picture,
            textures.cover(line - 0.006, 0.008),
            (0.9, 0.95, 0.9),
        )
    for _ in range(14):
        where = np.hypot(
            (x - rng.uniform(0.08, 0.92)) * 16 / 9, (y - rng.uniform(0.1, 0.9)) * 0.55
        )
        shirt = ((0.85, 0.1, 0.1), (0.95, 0.95, 0.95))[rng.integers(2)]
        paint(picture, textures.cover(where - 0.02, 0.01), shirt)
    return picture


def _bars() -> Floats:
    """A test card: vertical colour bars."""
    colours = [
        (1, 1, 1),
        (1, 1, 0),
        (0, 1, 1),
        (0, 1, 0),
        (1, 0, 1),
        (1, 0, 0),
        (0, 0, 1),
        (0.05, 0.05, 0.05),
    ]
    picture = np.repeat(np.array(colours, np.float32)[None] * 0.8, 32, 1)
    return np.repeat(picture, 144, 0).astype(np.float32)


def _dark(rng: np.random.Generator) -> Floats:
    """A screen that is off, with the pale reflection of a window."""
    picture = textures.canvas((144, 256), (0.02, 0.022, 0.028))
    x, y = textures.grid((144, 256))
    glow = np.clip(y + 0.3 * x - 0.4, 0, 1) * rng.uniform(0.08, 0.2)
    paint(picture, glow, (0.6, 0.7, 0.8))
    left = rng.uniform(0.1, 0.7)
    slant = rng.uniform(-0.2, 0.2)
    pane = np.abs(x - left - slant * y) - 0.09
    cross = np.minimum(np.abs(x - left - slant * y), np.abs(y - 0.68) * 0.6)
    window = textures.cover(np.maximum(pane, np.abs(y - 0.68) - 0.2), 0.01) * (
        1 - textures.cover(cross - 0.008, 0.01)
    )
    paint(picture, window * 0.28, (0.75, 0.85, 0.95))
    return picture


def screen(rng: np.random.Generator) -> Floats:
    """A (144, 256, 3) image for a screen; half of all screens are off."""
    kind = rng.random()
    if kind < 0.55:
        return _dark(rng)
    if kind < 0.78:
        return _landscape(rng)
    if kind < 0.95:
        return _match(rng)
    return _bars()


def _foot(
    rng: np.random.Generator, width: float, low: float, colour: Floats
) -> list[Mesh]:
    style = rng.integers(3)
    if style == 0:
        plate = rounded_rectangle(0.24, 0.45 * width, 0.04)
        rings = [
            at_height(plate * s, z) for s, z in ((1, 0.0), (1, 0.012), (0.96, 0.018))
        ]
        neck = sweep(
            [[-0.03, 0, 0.01], [-0.02, 0, low + 0.06]],
            [[0.05, 0.02], [0.045, 0.018]],
            colour,
            up=(1, 0, 0),
        )
        return [loft(rings, colour, roughness=0.2), neck]
    spread = (0.32 if style == 1 else 0.4) * width
    legs = []
    for side in (1, -1):
        y = side * spread
        for end in (0.14, -0.14):
            path = [
                [0, y, low + 0.03],
                [end * 0.8, y + side * 0.01, 0.03],
                [end, y + side * 0.012, 0.008],
            ]
            legs.append(sweep(path, [0.014, 0.012, 0.01], colour, segments=8))
    return legs


def build(seed: int = 0) -> Model:
    """A flat television about 1 m wide whose screen looks along +x."""
    rng = np.random.default_rng([seed, 0x7E1E])
    width = rng.uniform(0.88, 1.15)
    height = width * 0.5625 * rng.uniform(0.98, 1.05)
    low = rng.uniform(0.05, 0.1)
    bezel = rng.uniform(0.01, 0.03)
    casings = [
        (0.03, 0.03, 0.035),
        (0.06, 0.06, 0.065),
        (0.45, 0.46, 0.48),
        (0.85, 0.85, 0.84),
    ]
    colour = np.array(casings[rng.choice(4, p=[0.5, 0.25, 0.15, 0.1])], np.float32)
    middle = low + height / 2
    outline = rounded_rectangle(width, height, 0.012, corner=3)
    slab = [
        np.stack(
            [
                np.full(len(outline), depth),
                outline[:, 0] * shrink,
                middle + outline[:, 1] * shrink,
            ],
            1,
        )
        for depth, shrink in (
            (-0.025, 0.985),
            (-0.02, 1.0),
            (0.018, 1.0),
            (0.02, 0.995),
        )
    ]
    parts = [loft(slab, colour, roughness=0.2)]
    half_w = width / 2 - bezel
    half_h = height / 2 - bezel
    lift = 0.3 * bezel
    y = np.array([-half_w, half_w, half_w, -half_w])
    z = middle + lift + np.array([-half_h, -half_h, half_h, half_h])
    parts.append(
        quad(
            np.stack([np.full(4, 0.0215), y, z], 1),
            screen(rng),
            roughness=0.08,
        )
    )
    parts.append(
        box(
            (0.035, width * 0.62, height * 0.5),
            colour * 0.8,
            centre=(-0.035, 0, low + height * 0.35),
        )
    )
    for row in np.linspace(-0.12, 0.12, 5):
        slot = (-0.053, 0, low + height * 0.38 + row * height)
        parts.append(box((0.004, width * 0.4, 0.012), colour * 0.3, centre=slot))
    parts.append(
        box(
            (0.003, 0.05, 0.006),
            (0.7, 0.7, 0.72),
            centre=(0.0215, 0, low + bezel * 0.55),
        )
    )
    parts += _foot(rng, width, low, colour)
    lean = (
        translation(0, 0, low)
        @ rotation("y", float(rng.uniform(-3, 3)))
        @ translation(0, 0, -low)
    )
    return Model(
        "tv",
        tuple(transform(part, lean) if i < 8 else part for i, part in enumerate(parts)),
    )
