"""Cars: hatchbacks, saloons, estates and off-roaders with wheel arches, wheels, glass,
lights, plates and mirrors.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.capture.mesh import (
    Floats,
    Mesh,
    rotation,
    scaling,
    transform,
    translation,
)
from scenes.recipes.objects import textures
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import (
    Points,
    at_height,
    box,
    ellipsoid,
    lathe,
    loft,
    rounded_rectangle,
    smooth_interpolate,
    sweep,
)

GLASS = (0.05, 0.065, 0.075)
BLACK = (0.045, 0.045, 0.05)
CHROME = (0.72, 0.73, 0.75)


@dataclass(frozen=True, kw_only=True)
class Proportions:
    """Proportions of a car, metres."""

    length: float
    half: float  # half of the width
    belt: float  # height of the window line
    nose: float  # height of the bonnet's front edge
    tail: float  # height of the boot's or tailgate's upper edge
    roof: float
    clearance: float  # height of the sill above the ground
    wheel: float  # radius
    base: tuple[float, float]  # x of the glass at the belt line, rear and front
    top: tuple[float, float]  # x of the roof's ends, rear and front

    @property
    def axles(self) -> tuple[float, float]:
        """X of the rear and the front axle."""
        return -0.295 * self.length, 0.31 * self.length

    def half_width(self, x: float) -> float:
        """Half of the body's width at `x`."""
        t = abs(2 * x / self.length)
        return self.half * (
            1 - (0.1 if x > 0 else 0.07) * t**3 - 0.12 * max(0.0, t - 0.9) / 0.1
        )


def proportions(kind: str, rng: np.random.Generator) -> Proportions:
    """A car of one kind: saloon, hatchback, estate or offroad."""
    length = {"saloon": 4.5, "hatchback": 4.0, "estate": 4.6, "offroad": 4.4}[
        kind
    ] * rng.uniform(0.95, 1.05)
    high = kind == "offroad"
    roof = (1.72 if high else 1.45) * rng.uniform(0.97, 1.04)
    belt = (1.08 if high else 0.92) * rng.uniform(0.97, 1.03)
    front = rng.uniform(0.2, 0.25)
    rear = {"saloon": -0.33, "hatchback": -0.47, "estate": -0.485, "offroad": -0.475}[
        kind
    ]
    roof_rear = {
        "saloon": -0.19,
        "hatchback": -0.36,
        "estate": -0.42,
        "offroad": -0.43,
    }[kind] * rng.uniform(0.95, 1.03)
    return Proportions(
        length=length,
        half=(0.93 if high else 0.88) * rng.uniform(0.97, 1.04),
        belt=belt,
        nose=belt * rng.uniform(0.76, 0.84) + (0.1 if high else 0),
        tail=belt * (rng.uniform(0.98, 1.04) if kind == "saloon" else 1.0),
        roof=roof,
        clearance=(0.27 if high else 0.19) * rng.uniform(0.95, 1.1),
        wheel=(0.37 if high else 0.32) * rng.uniform(0.97, 1.05),
        base=(rear * length, front * length),
        top=(
            roof_rear * length,
            (front - rng.uniform(0.15, 0.19) + (0.05 if high else 0)) * length,
        ),
    )


def top_edge(s: Proportions, x: ArrayLike) -> Points:
    """Height of bonnet, window line and boot along the car."""
    knots = (
        np.array(
            [
                -0.5,
                -0.47,
                s.base[0] / s.length + 0.02,
                s.base[1] / s.length,
                0.4,
                0.475,
                0.5,
            ]
        )
        * s.length
    )
    knots[2] = max(knots[2], -0.46 * s.length)
    values = [
        s.tail * 0.9,
        s.tail,
        s.belt,
        s.belt,
        (s.belt * 0.3 + s.nose * 0.7) * 1.02,
        s.nose,
        s.nose * 0.86,
    ]
    return smooth_interpolate(x, knots, values)


def half_width_at(s: Proportions, x: float, level: float) -> float:
    """Half width of the body at `x` and a relative height (0 sill, 1 top edge)."""
    return s.half_width(x) * float(
        smooth_interpolate(
            level,
            [0, 0.12, 0.35, 0.6, 0.85, 0.97, 1],
            [0.93, 0.97, 0.99, 1, 0.965, 0.91, 0.8],
        )
    )


def bottom_edge(s: Proportions, x: float) -> float:
    """Height of the body's lower edge at `x`: the sill, the bumpers, and the arches
    over the wheels.
    """
    low = s.clearance + 0.06 * max(0.0, abs(2 * x / s.length) - 0.8) / 0.2
    for axle in s.axles:
        reach = (s.wheel * 1.17) ** 2 - (x - axle) ** 2
        if reach > 0:
            low = max(low, s.wheel + reach**0.5)
    return low


def body(s: Proportions, paint: ArrayLike) -> list[Mesh]:
    """The painted shell below the windows, with open wheel arches, over a black
    floor.
    """
    arch = s.wheel * 1.17
    around = arch * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 17))
    stations = [np.linspace(-s.length / 2, s.length / 2, 61)]
    for axle in s.axles:
        stations += [axle + around, np.array([axle - arch - 1e-3, axle + arch + 1e-3])]
    x = np.unique(np.round(np.concatenate(stations), 4))
    tops = top_edge(s, x)
    levels = np.array([0.0, 0.12, 0.25, 0.42, 0.6, 0.75, 0.88, 0.95, 1.0])
    rings = []
    for position, top in zip(x, tops, strict=True):
        low = bottom_edge(s, position)
        sill = s.clearance
        z = low + levels * (top - low)
        width = np.array(
            [
                half_width_at(s, position, max(0.0, (level - sill) / (top - sill)))
                for level in z
            ]
        )
        inner = np.array([0.75, 0.4])
        y = np.concatenate([width, s.half_width(position) * inner, [0.0]])
        crown = np.array([0.012, 0.022, 0.026])
        height = np.concatenate([z, top + crown])
        right = np.stack([np.full_like(y, position), -y, height], -1)
        left = np.stack([np.full_like(y, position), y, height], -1)[::-1][1:]
        rings.append(np.concatenate([right, left])[::-1])
    shell = loft(np.array(rings), paint, roughness=0.08)
    floor = box(
        (s.length * 0.9, s.half * 1.42, 0.3),
        BLACK,
        centre=(0, 0, s.clearance + 0.2),
    )
    return [shell, floor]


def cabin(
    s: Proportions, paint: ArrayLike, roof_paint: ArrayLike, glass_roof: bool
) -> list[Mesh]:
    """Windows as one dark glass body with painted pillars and roof."""
    levels = np.array([-0.12, 0.0, 0.3, 0.6, 0.85, 0.95, 1.0])
    height = s.belt + levels * (s.roof - 0.07 - s.belt)
    bulge = np.clip(levels, 0, 1) ** 1.35

    def ring(level: int, grow: float) -> Points:
        t = float(bulge[level])
        rear, front = ((1 - t) * np.array(s.base) + t * np.array(s.top)).tolist()
        half = s.half * ((1 - t) * 0.86 + t * 0.66) + grow
        loop = rounded_rectangle(
            front - rear + 2 * grow, 2 * half, 0.1 + 0.1 * t, corner=5
        )
        loop[:, 0] += (front + rear) / 2
        bow = 0.09 * (1 - (loop[:, 1] / half) ** 2)
        loop[:, 0] += np.where(loop[:, 0] > 0, bow, -bow * 0.6)
        return at_height(loop, height[level])

    glass = loft(
        np.array([ring(i, 0.0) for i in range(7)]),
        GLASS,
        roughness=0.08,
    )
    roof_rings = [ring(4, 0.006), ring(5, 0.008), ring(6, 0.004)]
    centre = np.array([(s.top[0] + s.top[1]) / 2, 0, 0])
    for shrink, rise in ((0.965, 0.028), (0.85, 0.05), (0.6, 0.062), (0.3, 0.068)):
        last = ring(6, 0.0)
        last[:, :2] = centre[:2] + (last[:, :2] - centre[:2]) * shrink
        last[:, 2] += rise
        roof_rings.append(last)
    parts = [glass, loft(np.array(roof_rings), roof_paint, roughness=0.08)]
    if glass_roof:
        pane = (
            rounded_rectangle(0.5 * (s.top[1] - s.top[0]), 0.85 * s.half, 0.06)
            + centre[:2]
        )
        parts.append(
            loft(
                [at_height(pane, height[6] + z) for z in (0.06, 0.075)],
                GLASS,
                roughness=0.08,
            )
        )
    outside = [ring(i, 0.002) for i in range(7)]
    corner = len(outside[0]) // 4
    for start in range(4):
        path = np.array([loop[start * corner + 2] for loop in outside[1:]])
        parts.append(
            sweep(
                path,
                np.full(len(path), 0.045),
                paint,
                segments=8,
                roughness=0.08,
            )
        )
    span = s.base[1] * 0.5 + s.top[1] * 0.5 - s.top[0] * 0.6 - s.base[0] * 0.4
    for fraction in (0.44, 0.62) if s.base[0] < -0.42 * s.length else (0.42,):
        x = s.top[0] * 0.6 + s.base[0] * 0.4 + fraction * span
        for side in (1, -1):
            edges = [side * (np.abs(loop[:, 1]).max() - 0.012) for loop in outside[1:]]
            pillar = [[x, y, z] for y, z in zip(edges, height[1:], strict=True)]
            parts.append(
                sweep(
                    pillar,
                    np.tile([0.035, 0.022], (6, 1)),
                    BLACK,
                    segments=6,
                )
            )
    return parts


PAINTS = (
    (0.72, 0.05, 0.06),
    (0.08, 0.2, 0.52),
    (0.82, 0.82, 0.83),
    (0.55, 0.57, 0.6),
    (0.07, 0.07, 0.08),
    (0.1, 0.34, 0.22),
    (0.85, 0.62, 0.08),
    (0.35, 0.55, 0.75),
    (0.92, 0.92, 0.9),
    (0.4, 0.08, 0.12),
    (0.82, 0.36, 0.1),
    (0.52, 0.45, 0.36),
)


def _wheel(s: Proportions, rng: np.random.Generator) -> list[Mesh]:
    """One wheel around the origin, its outside towards +y."""
    r = s.wheel
    w = 0.105
    tread = [
        [r * 0.66, -w],
        [r * 0.93, -w],
        [r, -w * 0.7],
        [r, w * 0.7],
        [r * 0.93, w],
        [r * 0.68, w],
    ]
    tyre = lathe(
        [*tread, [r * 0.64, w * 0.55]],
        (0.06, 0.06, 0.065),
        segments=32,
    )
    metal = CHROME if rng.random() < 0.75 else (0.2, 0.2, 0.22)
    bowl = [
        [r * 0.66, w * 0.2],
        [r * 0.67, w * 0.75],
        [r * 0.6, w * 0.8],
        [r * 0.56, w * 0.45],
        [0, w * 0.42],
    ]
    dish = lathe(bowl, np.array(metal) * 0.45, segments=32)
    edge = [
        [r * 0.6, w * 0.5],
        [r * 0.68, w * 0.6],
        [r * 0.68, w * 0.98],
        [r * 0.6, w * 0.9],
        [r * 0.585, w * 0.5],
    ]
    rim = lathe(edge, metal, segments=32, roughness=0.2)
    hub = lathe(
        [[0.07, w * 0.4], [0.07, w * 0.92], [0.045, w], [0, w]],
        metal,
        segments=16,
        roughness=0.2,
    )
    spokes = int(rng.choice([5, 6, 8, 10]))
    size = (r * 0.56, 0.3 * r * (5 / spokes) ** 0.8, 0.03)
    spoke = box(
        size,
        metal,
        centre=(r * 0.32, 0, w * 0.82),
        roughness=0.2,
    )
    turned = [transform(spoke, rotation("z", 360 * i / spokes)) for i in range(spokes)]
    return [
        transform(part, rotation("x", -90)) for part in (tyre, dish, rim, hub, *turned)
    ]


def plate(rng: np.random.Generator) -> Floats:
    """A number plate with six signs."""
    back = (0.95, 0.95, 0.92) if rng.random() < 0.7 else (0.95, 0.8, 0.2)
    picture = textures.canvas((32, 144), back)
    text = "".join(rng.choice(list("AEHKMOPST0123456789"), 6))
    textures.write(
        picture,
        text,
        (0.05, 0.05, 0.15),
        box=(0.35, 0.14, 4.15, 0.86),
        weight=0.28,
    )
    return picture


def _front(s: Proportions, rng: np.random.Generator) -> list[Mesh]:
    x = s.length / 2
    w = s.half
    lamp_z = s.nose * rng.uniform(0.86, 0.9)
    lamp_y = w * 0.6
    lamp = (rng.uniform(0.2, 0.4), rng.uniform(0.34, 0.46), rng.uniform(0.11, 0.19))
    parts = []
    for side in (1, -1):
        centre = (x - 0.09, side * lamp_y, lamp_z)
        turn = translation(*centre) @ rotation("z", side * 17) @ rotation("y", 12)
        parts.append(
            transform(ellipsoid(lamp, (0.9, 0.92, 0.95), roughness=0.08), turn)
        )
        frame = ellipsoid((lamp[0] * 0.98, lamp[1] * 1.1, lamp[2] * 1.22), BLACK)
        parts.append(transform(frame, translation(-0.016, 0, 0) @ turn))
        fog = (x - 0.05, side * w * 0.62, s.clearance + 0.2)
        parts.append(
            ellipsoid(
                (0.1, 0.16, 0.09),
                (0.9, 0.9, 0.85),
                centre=fog,
                roughness=0.08,
            )
        )
    grille_h = rng.uniform(0.1, 0.2)
    grille_z = s.nose * rng.uniform(0.66, 0.76)
    parts.append(
        _bulge(
            (x - 0.045, grille_z), (0.1, w * rng.uniform(0.8, 1.05), grille_h), BLACK
        )
    )
    for bar in np.linspace(-0.3, 0.3, 3):
        parts.append(
            _bulge(
                (x - 0.042, grille_z + bar * grille_h), (0.1, w * 0.8, 0.012), CHROME
            )
        )
    parts.append(_bulge((x - 0.035, s.clearance + 0.14), (0.12, w * 1.5, 0.14), BLACK))
    parts.append(
        box(
            (0.02, 0.52, 0.115),
            plate(rng),
            centre=(x + 0.02, 0, s.clearance + 0.3),
        )
    )
    return parts


def _bulge(
    position: tuple[float, float],
    size: tuple[float, float, float],
    colour: Sequence[float],
) -> Mesh:
    """A rounded bar across the car at (x, z)."""
    outline = rounded_rectangle(size[0], size[1], size[0] * 0.45, corner=4) + np.array(
        (position[0], 0.0)
    )
    return loft(
        [at_height(outline, position[1] + side * size[2] / 2) for side in (-1, 1)],
        colour,
    )


def _rear(s: Proportions, rng: np.random.Generator, kind: str) -> list[Mesh]:
    x = -s.length / 2
    w = s.half
    parts = []
    tall = kind != "saloon" and rng.random() < 0.6
    for side in (1, -1):
        size = (0.16, 0.2, 0.42) if tall else (0.2, 0.42, 0.17)
        z = s.tail * (0.8 if tall else 0.84)
        lamp = (x + 0.07, side * w * (0.83 if tall else 0.68), z)
        signal = (x + 0.01, side * w * 0.7, z - size[2] * 0.45)
        parts.append(ellipsoid(size, (0.7, 0.02, 0.03), centre=lamp, roughness=0.08))
        parts.append(
            ellipsoid(
                (0.1, 0.12, 0.06),
                (0.95, 0.6, 0.15),
                centre=signal,
                roughness=0.08,
            )
        )
    parts.append(_bulge((x + 0.035, s.clearance + 0.15), (0.12, w * 1.6, 0.16), BLACK))
    parts.append(
        box(
            (0.02, 0.52, 0.115),
            plate(rng),
            centre=(x - 0.012, 0, s.tail * 0.66),
        )
    )
    exhaust = lathe(
        [[0.035, 0], [0.035, 0.08], [0.025, 0.08], [0.025, 0]],
        CHROME,
        segments=12,
    )
    pose = translation(x + 0.02, -w * 0.55, s.clearance + 0.06) @ rotation("y", -90)
    return [*parts, transform(exhaust, pose)]


def _trim(s: Proportions, paint: ArrayLike) -> list[Mesh]:
    """Door lines, handles, sills, mirrors, the bonnet's edges."""
    parts = []
    line = np.asarray(paint) * 0.25
    doors = (
        s.axles[0] + s.wheel * 1.25,
        (s.axles[0] + s.axles[1]) / 2 - 0.02 * s.length,
        s.axles[1] - s.wheel * 1.3,
    )
    levels = np.linspace(0.05, 0.95, 9)
    for side in (1, -1):
        for x in doors:
            top = float(top_edge(s, np.array([x]))[0])
            low = s.clearance
            path = [
                [x, side * half_width_at(s, x, t), low + t * (top - low)]
                for t in levels
            ]
            parts.append(
                sweep(
                    path,
                    np.full(9, 0.009),
                    line,
                    segments=4,
                    up=(1, 0, 0),
                )
            )
        for x in (doors[0] + 0.18, doors[1] + 0.18):
            y = side * (half_width_at(s, x, 0.78) + 0.012)
            z = s.clearance + 0.78 * (s.belt - s.clearance)
            parts.append(
                box(
                    (0.2, 0.035, 0.03),
                    CHROME,
                    centre=(x, y, z),
                    roughness=0.2,
                )
            )
        span = np.linspace(s.axles[0] + s.wheel * 1.25, s.axles[1] - s.wheel * 1.25, 8)
        path = [
            [x, side * (half_width_at(s, x, 0.05) - 0.005), s.clearance + 0.04]
            for x in span
        ]
        parts.append(sweep(path, np.full(8, 0.055), BLACK, segments=8))
        x = s.base[1] - 0.12
        mirror = (x, side * (s.half + 0.07), s.belt + 0.06)
        parts.append(ellipsoid((0.17, 0.2, 0.15), paint, centre=mirror, roughness=0.08))
        arm = [
            [x, side * s.half * 0.86, s.belt],
            [x, side * (s.half + 0.03), s.belt + 0.04],
        ]
        parts.append(sweep(arm, [0.03, 0.03], BLACK))
        front = np.linspace(s.base[1] + 0.1, s.length * 0.455, 8)
        path = [
            [
                x,
                side * s.half_width(x) * 0.72,
                float(top_edge(s, np.array([x]))[0]) + 0.013,
            ]
            for x in front
        ]
        parts.append(sweep(path, np.full(8, 0.009), line, segments=4))
    x = s.base[1] + 0.03
    z = s.belt + 0.03
    wiper = sweep(
        [[x + 0.09, -0.3, z], [x + 0.08, 0.3, z]],
        [0.012, 0.012],
        BLACK,
        segments=5,
    )
    return [*parts, wiper]


def build(seed: int = 0, colour: Sequence[float] | None = None) -> Model:
    """A car 3.8 to 4.8 m long that faces +x, in a paint of its seed or of an sRGB
    colour.
    """
    rng = np.random.default_rng([seed, 0xCA2])
    kind = str(
        rng.choice(
            ["saloon", "hatchback", "estate", "offroad"], p=[0.35, 0.3, 0.15, 0.2]
        )
    )
    s = proportions(kind, rng)
    drawn = np.array(PAINTS[rng.integers(len(PAINTS))]) * rng.uniform(
        0.85, 1.1
    ) + rng.uniform(-0.03, 0.03, 3)
    if colour is None:
        paint = np.clip(drawn, 0.02, 0.95)
    else:
        paint = np.asarray(colour, np.float64)
    roof = (
        paint
        if rng.random() < 0.85
        else np.array(BLACK if paint.mean() > 0.3 else (0.85, 0.85, 0.85))
    )
    parts = [
        *body(s, paint),
        *cabin(s, paint, roof, bool(rng.random() < 0.2)),
        *_front(s, rng),
        *_rear(s, rng, kind),
    ]
    parts += _trim(s, paint)
    wheel = _wheel(s, rng)
    steer = float(rng.uniform(-18, 18)) if rng.random() < 0.4 else 0.0
    for axle, turn in zip(s.axles, (0.0, steer), strict=True):
        for side in (1, -1):
            pose = (
                translation(axle, side * (s.half - 0.115), s.wheel)
                @ rotation("z", turn)
                @ scaling(1, side, 1)
            )
            parts += [transform(part, pose) for part in wheel]
    if kind in ("estate", "offroad"):
        x = np.linspace(s.top[0] + 0.1, s.top[1] - 0.1, 6)
        rise = np.array([-0.03, 0.04, 0.04, 0.04, 0.04, -0.03])
        for side in (1, -1):
            rail = np.stack(
                [x, np.full(6, side * s.half * 0.56), s.roof - 0.01 + rise], 1
            )
            parts.append(sweep(rail, np.full(6, 0.018), CHROME, segments=6))
    return Model("car", tuple(parts))
