"""Suitcases: hard-shell trolleys with ribs, wheels and a telescopic handle, and leather
ones with straps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.ground import speckle
from mi_splat.capture.mesh import Floats, Mesh, rotation, transform, translation
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import (
    at_height,
    box,
    lathe,
    loft,
    rounded_rectangle,
    sweep,
)

SHELLS = (
    (0.1, 0.35, 0.6),
    (0.75, 0.1, 0.14),
    (0.08, 0.08, 0.09),
    (0.6, 0.62, 0.64),
    (0.9, 0.55, 0.1),
    (0.1, 0.5, 0.45),
    (0.85, 0.72, 0.2),
    (0.5, 0.2, 0.5),
    (0.85, 0.45, 0.5),
    (0.15, 0.2, 0.35),
    (0.35, 0.6, 0.3),
    (0.9, 0.88, 0.82),
)
METAL = (0.62, 0.63, 0.65)
BLACK = (0.05, 0.05, 0.055)
BRASS = (0.75, 0.62, 0.3)
LEATHERS = (
    (0.45, 0.25, 0.12),
    (0.6, 0.38, 0.2),
    (0.3, 0.14, 0.09),
    (0.35, 0.3, 0.2),
    (0.2, 0.22, 0.25),
)
Point = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class _Size:
    """Depth along x, width along y and height of the shell, and how high it stands,
    metres.
    """

    depth: float
    width: float
    height: float
    low: float

    @property
    def top(self) -> float:
        """Height of the shell's upper side."""
        return self.low + self.height


def _shell(s: _Size, colour: Point) -> Mesh:
    """A box with rounded edges all around."""
    rings = []
    edge = min(s.depth, s.width) * 0.22
    for angle in np.linspace(-90, 90, 13):
        inset = edge * (1 - np.cos(np.radians(angle)))
        if angle < 0:
            z = edge * (1 + np.sin(np.radians(angle)))
        else:
            z = s.height - edge * (1 - np.sin(np.radians(angle)))
        outline = rounded_rectangle(
            s.depth - 2 * inset,
            s.width - 2 * inset,
            max(edge - 0.55 * inset, 0.01),
            corner=6,
        )
        rings.append(at_height(outline, s.low + z))
    return loft(np.array(rings), colour, roughness=0.2)


def _ribs(s: _Size, colour: Point, count: int, *, upright: bool) -> list[Mesh]:
    """Ribs on both broad sides that run upright or across, and a seam around the
    middle.
    """
    bend = ((-0.4, -0.012), (-0.36, 0.002), (0.36, 0.002), (0.4, -0.012))
    parts = []
    for position in (
        np.linspace(-0.36, 0.36, count) if upright else np.linspace(0.16, 0.84, count)
    ):
        for side in (1, -1):
            if upright:
                path = [
                    [
                        side * (s.depth / 2 + d),
                        position * s.width,
                        s.low + (0.5 + t) * s.height,
                    ]
                    for t, d in bend
                ]
            else:
                path = [
                    [side * (s.depth / 2 + d), t * s.width, s.low + position * s.height]
                    for t, d in bend
                ]
            radius = 0.2 * (s.width if upright else s.height) / count
            up = (1, 0, 0) if upright else (0, 0, 1)
            parts.append(
                sweep(
                    path,
                    np.full(4, radius),
                    colour * 0.92,
                    segments=8,
                    up=up,
                    roughness=0.2,
                )
            )
    seam = rounded_rectangle(s.height + 0.004, s.width + 0.004, 0.075, corner=6)
    ring = np.array(
        [
            [0.0, y, s.low + s.height / 2 + z]
            for z, y in np.concatenate([seam, seam[:2]])
        ]
    )
    parts.append(
        sweep(
            ring,
            np.full(len(ring), 0.008),
            np.array(BLACK) * 1.5,
            segments=6,
            up=(1, 0, 0),
        )
    )
    return parts


def _wheels(s: _Size, rng: np.random.Generator) -> list[Mesh]:
    """Four castors, each turned somehow, with guards on the corners above them (one is
    missing now and then).
    """
    parts = []
    tyre = lathe(
        [[0.012, -0.012], [0.028, -0.012], [0.028, 0.012], [0.012, 0.012]],
        BLACK,
        segments=14,
    )
    fork = box((0.05, 0.04, 0.045), BLACK, centre=(0, 0, 0.058))
    for x in (1, -1):
        for y in (1, -1):
            corner = (x * (s.depth / 2 - 0.045), y * (s.width / 2 - 0.045))
            shift = translation(corner[0], y * (s.width / 2 - 0.055), 0)
            turn = (
                translation(0, 0, 0.028)
                @ rotation("z", float(rng.uniform(0, 180)))
                @ rotation("x", 90)
            )
            parts += [transform(transform(tyre, turn), shift), transform(fork, shift)]
            missing = rng.random(2) >= 0.99
            if not missing[0]:
                parts.append(
                    box(
                        (0.06, 0.06, 0.05),
                        BLACK,
                        centre=(*corner, s.low + 0.035),
                    )
                )
    return parts


def _handles(s: _Size, rng: np.random.Generator) -> list[Mesh]:
    """Handles on top and on one side, the telescopic one (drawn out or not), and a
    badge.
    """
    above = [
        [0.02, y, s.top + z]
        for y, z in ((-0.1, -0.01), (-0.085, 0.022), (0.085, 0.022), (0.1, -0.01))
    ]
    bend = ((-0.01, 0.4), (0.022, 0.43), (0.022, 0.57), (-0.01, 0.6))
    beside = [[0, s.width / 2 + y, s.low + s.height * t] for y, t in bend]
    parts = [
        sweep(above, np.full(4, 0.012), BLACK, segments=8),
        sweep(beside, np.full(4, 0.011), BLACK, segments=8),
    ]
    reach = rng.uniform(0.2, 0.42) if rng.random() < 0.65 else 0.03
    back = -s.depth / 2 + 0.035
    end = s.top + reach
    for y in (0.1, -0.1):
        parts.append(
            sweep(
                [[back, y, s.top - 0.03], [back, y, end]],
                [0.011, 0.009],
                METAL,
                segments=8,
                roughness=0.2,
            )
        )
    grip = [
        [back, -0.13, end],
        [back, -0.1, end + 0.015],
        [back, 0.1, end + 0.015],
        [back, 0.13, end],
    ]
    parts.append(sweep(grip, np.full(4, 0.016), BLACK, segments=8))
    badge = (s.depth / 2 + 0.008, 0, s.low + s.height * 0.88)
    return [*parts, box((0.006, 0.09, 0.03), METAL, centre=badge, roughness=0.2)]


def _trolley(rng: np.random.Generator) -> list[Mesh]:
    height = rng.uniform(0.56, 0.7)
    width = rng.uniform(0.4, 0.48)
    depth = rng.uniform(0.23, 0.29)
    s = _Size(depth=depth, width=width, height=height, low=0.065)
    colour = np.clip(
        np.array(SHELLS[rng.integers(len(SHELLS))]) * rng.uniform(0.85, 1.12),
        0.03,
        0.95,
    )
    count = int(rng.integers(4, 8))
    ribs = _ribs(s, colour, count, upright=bool(rng.random() < 0.75))
    return [_shell(s, colour), *ribs, *_wheels(s, rng), *_handles(s, rng)]


def _box_with_edges(s: _Size, hide: Floats, dark: Point) -> list[Mesh]:
    """A flat box with rounded corners and piping along its edges and around its
    middle.
    """
    outline = rounded_rectangle(s.width, s.height, 0.035, corner=5)
    middle = s.low + s.height / 2
    rings = [
        np.stack(
            [
                np.full(len(outline), x * s.depth),
                outline[:, 0] * k,
                middle + outline[:, 1] * k,
            ],
            1,
        )
        for x, k in (
            (-0.5, 0.955),
            (-0.47, 0.99),
            (-0.42, 1),
            (0.42, 1),
            (0.47, 0.99),
            (0.5, 0.955),
        )
    ]
    parts = [loft(np.array(rings), hide, roughness=0.35)]
    around = np.concatenate([outline, outline[:2]])
    for x in (-0.42, 0.0, 0.42):
        edge = np.array(
            [[x * s.depth, y * 1.003, middle + z * 1.005] for y, z in around]
        )
        parts.append(
            sweep(
                edge,
                np.full(len(edge), 0.007 if x else 0.005),
                dark,
                segments=6,
                up=(1, 0, 0),
            )
        )
    return parts


def _straps(s: _Size, dark: Point) -> list[Mesh]:
    """Two belts around the case with brass buckles."""
    parts = []
    for y in (-0.27 * s.width, 0.27 * s.width):
        belt = rounded_rectangle(s.depth + 0.012, s.height + 0.012, 0.02, corner=3)
        loops = [
            [[px, y + side, s.low + s.height / 2 + pz] for px, pz in belt]
            for side in (0.022, -0.022)
        ]
        parts.append(loft(np.array(loops), dark * 1.15))
        buckle = (s.depth / 2 + 0.008, y, s.low + s.height * 0.72)
        parts.append(box((0.012, 0.06, 0.05), BRASS, centre=buckle, roughness=0.2))
    return parts


def _leather(rng: np.random.Generator) -> list[Mesh]:
    height = rng.uniform(0.4, 0.48)
    width = rng.uniform(0.6, 0.74)
    depth = rng.uniform(0.18, 0.24)
    s = _Size(depth=depth, width=width, height=height, low=0.012)
    tone = np.array(LEATHERS[rng.integers(len(LEATHERS))])
    dark = tone * 0.45
    hide = speckle((128, 128), tone, rng, grain=0.06, patch=0.35)
    parts = [*_box_with_edges(s, hide, dark), *_straps(s, dark)]
    guard = (0.72, 0.6, 0.32) if tone.mean() < 0.35 else dark
    middle = s.low + height / 2
    for y in (1, -1):
        for z in (1, -1):
            for x in (1, -1):
                corner = (
                    x * (depth / 2 - 0.012),
                    y * (width / 2 - 0.034),
                    middle + z * (height / 2 - 0.034),
                )
                parts.append(
                    box((0.03, 0.075, 0.075), guard, centre=corner, roughness=0.2)
                )
    arch = (
        (-0.09, 0),
        (-0.085, 0.035),
        (-0.05, 0.05),
        (0.05, 0.05),
        (0.085, 0.035),
        (0.09, 0),
    )
    parts.append(
        sweep(
            [[0, y, s.top + z] for y, z in arch],
            np.full(6, 0.015),
            dark,
            segments=8,
        )
    )
    for lock in (0.12, -0.12):
        parts.append(
            box(
                (0.05, 0.05, 0.02),
                BRASS,
                centre=(0.02, lock, s.top),
                roughness=0.2,
            )
        )
    return parts


def build(seed: int = 0) -> Model:
    """A suitcase about 0.7 m high (trolley) or wide (leather), its broad face along
    +x.
    """
    rng = np.random.default_rng([seed, 0x5C])
    parts = _trolley(rng) if rng.random() < 0.68 else _leather(rng)
    lying = rng.random() < 0.15
    if lying:
        points = np.concatenate([part.vertices for part in parts])
        middle = float(points[:, 2].max()) / 2
        parts = [
            transform(part, rotation("y", -90) @ translation(0, 0, -middle))
            for part in parts
        ]
        floor = min(float(part.vertices[:, 2].min()) for part in parts)
        parts = [transform(part, translation(0, 0, -floor)) for part in parts]
    return Model("suitcase", tuple(parts))
