"""Trains: box-cab locomotives, streamlined railcars, and short locomotives with a
carriage.
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.capture.mesh import Floats, Mesh, rotation, transform, translation
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.primitives import (
    Points,
    box,
    ellipsoid,
    lathe,
    loft,
    smooth_interpolate,
    sweep,
)

LIVERIES = (
    ((0.7, 0.07, 0.08), (0.93, 0.92, 0.88)),
    ((0.08, 0.22, 0.5), (0.92, 0.8, 0.2)),
    ((0.9, 0.9, 0.9), (0.75, 0.08, 0.1)),
    ((0.1, 0.36, 0.24), (0.9, 0.85, 0.6)),
    ((0.92, 0.55, 0.1), (0.2, 0.22, 0.26)),
    ((0.75, 0.77, 0.8), (0.1, 0.35, 0.65)),
    ((0.92, 0.78, 0.12), (0.12, 0.14, 0.2)),
    ((0.35, 0.1, 0.14), (0.88, 0.82, 0.66)),
    ((0.45, 0.7, 0.85), (0.95, 0.95, 0.95)),
)
GLASS = (0.05, 0.06, 0.075)
BLACK = (0.05, 0.05, 0.055)
STEEL = (0.45, 0.45, 0.46)
GREY = (0.4, 0.41, 0.42)


@dataclass(frozen=True, kw_only=True)
class _Car:
    """One vehicle: centre x, length, half width, floor and roof heights, how far its
    front leans back, livery.
    """

    x: float
    length: float
    half: float
    floor: float
    roof: float
    lean: float
    body: Floats
    stripe: Floats
    roof_colour: Floats


def _profile(c: _Car) -> Points:
    """(P, 2) outline of the body across (y, z), counter-clockwise seen from the
    front.
    """
    side = c.roof - 0.75
    y = np.array([0.97, 1.0, 1.0, 0.97, 0.86, 0.62, 0.32]) * c.half
    z = np.array(
        [
            c.floor,
            c.floor + 0.2,
            side,
            side + 0.32,
            side + 0.55,
            side + 0.7,
            side + 0.75,
        ]
    )
    right = np.stack([y, z], -1)
    return np.concatenate([right, right[::-1] * (-1, 1)])


def _lean(c: _Car, level: ArrayLike) -> Points:
    """How far back a cab's front leans at relative heights (0 floor, 1 roof)."""
    return smooth_interpolate(level, [0, 0.3, 0.55, 1], [0, 0, 0.25, 1]) * c.lean


def _body(c: _Car, cab: tuple[bool, bool]) -> list[Mesh]:
    """Body shell; an end with a cab narrows and leans back, the other is flat."""
    outline = _profile(c)
    tall = (outline[:, 1] - c.floor) / (c.roof - c.floor)
    rings = []
    for t in np.r_[
        np.linspace(0, 0.12, 7), np.linspace(0.14, 0.86, 5), np.linspace(0.88, 1, 7)
    ]:
        end = min(t, 1 - t) / 0.12
        has_cab = cab[0] if t < 0.5 else cab[1]
        narrow = 1 - (0.16 if has_cab else 0.02) * max(0.0, 1 - end) ** 2.2
        low = _lean(c, tall) * (max(0.0, 1 - end) if has_cab else 0.0)
        x = c.x + (t - 0.5) * c.length - np.sign(t - 0.5) * low
        z = c.floor + (outline[:, 1] - c.floor) * (1 - 0.05 * (1 - narrow) / 0.16)
        rings.append(np.stack([x, outline[:, 0] * narrow, z], 1))
    shell = loft(np.array(rings), c.body, roughness=0.2)
    skirt = box(
        (c.length * 0.97, c.half * 1.85, 0.25),
        BLACK,
        centre=(c.x, 0, c.floor - 0.1),
    )
    roof = np.stack(
        [
            np.linspace(-0.44, 0.44, 8) * c.length + c.x,
            np.zeros(8),
            np.full(8, c.roof - 0.06),
        ],
        1,
    )
    cap = sweep(
        roof,
        np.tile([c.half * 0.78, 0.12], (8, 1)),
        c.roof_colour,
        segments=20,
    )
    return [shell, skirt, cap]


def _front(c: _Car, sign: float, rng: np.random.Generator) -> list[Mesh]:
    """Windscreen, lights, buffers and coupling of a cab at one end (sign of x)."""
    end = c.x + sign * c.length / 2
    height = c.roof - c.floor

    def on_front(y: float, t: float, out: float = 0.0) -> tuple[float, float, float]:
        return end - sign * (float(_lean(c, t)) - out), y, c.floor + t * height * 0.95

    low = 0.5
    high = 0.8
    wide = c.half * 0.74
    parts = []
    panes = ((-1.0, 1.0),) if rng.random() < 0.5 else ((-1.0, -0.05), (0.05, 1.0))
    for left, right in panes:
        corners = [on_front(left * wide, low, 0.03), on_front(right * wide, low, 0.03)]
        middle = [
            on_front(right * wide * 0.98, 0.66, 0.03),
            on_front(left * wide * 0.98, 0.66, 0.03),
        ]
        top = [
            on_front(right * wide * 0.92, high, 0.03),
            on_front(left * wide * 0.92, high, 0.03),
        ]
        for quad_corners in ((*corners, *middle), (middle[1], middle[0], *top)):
            ring = np.array(quad_corners)
            parts.append(
                loft(
                    np.array([ring - (sign * 0.06, 0, 0), ring])[:: int(sign)],
                    GLASS,
                    roughness=0.08,
                    smooth=False,
                )
            )
    for y in (-1, 1):
        x, py, z = on_front(y * c.half * 0.62, 0.24)
        parts.append(
            ellipsoid(
                (0.14, 0.32, 0.24),
                (0.95, 0.94, 0.85),
                centre=(x, py, z),
                roughness=0.08,
            )
        )
        parts.append(
            ellipsoid(
                (0.12, 0.16, 0.14),
                (0.75, 0.04, 0.04),
                centre=(x, py * 0.62, z),
                roughness=0.08,
            )
        )
        buffer = lathe(
            [[0.09, 0], [0.09, 0.28], [0.22, 0.3], [0.22, 0.36], [0, 0.37]],
            BLACK,
            segments=16,
        )
        place = translation(end - sign * 0.02, y * 0.85, c.floor - 0.02)
        parts.append(transform(buffer, place @ rotation("y", sign * 90)))
    x, _, z = on_front(0, 0.9)
    parts.append(
        ellipsoid(
            (0.2, 0.3, 0.2),
            (0.95, 0.94, 0.85),
            centre=(x - sign * 0.02, 0, z),
            roughness=0.08,
        )
    )
    parts.append(
        box(
            (0.3, 0.2, 0.2),
            BLACK,
            centre=(end + sign * 0.12, 0, c.floor - 0.05),
        )
    )
    sides = [[end - sign * 0.25, y * c.half * 0.85, 0.25] for y in (-1, 1)]
    plough = [sides[0], [end + sign * 0.1, 0, 0.2], sides[1]]
    return [
        *parts,
        sweep(
            plough,
            np.tile([0.05, 0.22], (3, 1)),
            BLACK,
            segments=6,
        ),
    ]


def _sides(
    c: _Car, rng: np.random.Generator, *, cab: tuple[bool, bool], passengers: bool
) -> list[Mesh]:
    """Stripes, windows, doors and grilles of both sides."""
    parts = []
    left = c.x - c.length * (0.37 if cab[0] else 0.47)
    right = c.x + c.length * (0.37 if cab[1] else 0.47)
    height = c.roof - c.floor
    for y in (-c.half, c.half):
        for z, tall in (
            ((0.13, 0.1), (0.3, 0.05))
            if rng.random() < 0.5
            else ((0.26, 0.16), (0.67, 0.05))
        ):
            centre = ((left + right) / 2, y, c.floor + z * height)
            parts.append(
                box(
                    (right - left, 0.03, tall * height),
                    c.stripe,
                    centre=centre,
                )
            )
        if passengers:
            count = max(3, int((right - left) / 1.5))
            level = c.floor + 0.52 * height
            for x in np.linspace(left + 1.3, right - 1.3, count):
                parts.append(
                    box(
                        (0.95, 0.05, 0.3 * height),
                        GLASS,
                        centre=(x, y, level),
                        roughness=0.08,
                    )
                )
            doors = (left + 0.45, right - 0.45)
        else:
            for x in np.linspace(left + 1.0, right - 1.0, 5):
                for k in range(5):
                    parts.append(
                        box(
                            (0.9, 0.04, 0.05),
                            GREY,
                            centre=(x, y, c.floor + (0.42 + 0.045 * k) * height),
                        )
                    )
                parts.append(
                    box(
                        (0.95, 0.025, 0.24 * height),
                        BLACK,
                        centre=(x, y, c.floor + 0.51 * height),
                    )
                )
            doors = (left + 0.1, right - 0.1)
        for x in doors:
            parts.append(
                box(
                    (0.75, 0.04, 0.66 * height),
                    c.stripe * 0.8,
                    centre=(x, y, c.floor + 0.36 * height),
                )
            )
            parts.append(
                box(
                    (0.5, 0.06, 0.24 * height),
                    GLASS,
                    centre=(x, y, c.floor + 0.53 * height),
                    roughness=0.08,
                )
            )
    return parts


def _bogies(c: _Car, *, axles: int) -> list[Mesh]:
    parts: list[Mesh] = []
    radius = 0.46
    rim = [
        [0.12, -0.07],
        [radius, -0.07],
        [radius + 0.02, -0.05],
        [radius, 0.06],
        [radius * 0.8, 0.03],
    ]
    wheel = lathe(
        [*rim, [0.15, 0.05], [0, 0.1]],
        (0.3, 0.29, 0.28),
        segments=20,
    )
    for centre in (c.x - c.length * 0.31, c.x + c.length * 0.31):
        span = 1.25 * (axles - 1)
        for offset in np.linspace(-span / 2, span / 2, axles):
            for side in (-1, 1):
                turn = translation(
                    centre + offset, side * 0.8, radius + 0.02
                ) @ rotation("x", -90 * side)
                parts.append(transform(wheel, turn))
                parts.append(
                    box(
                        (0.26, 0.14, 0.26),
                        BLACK,
                        centre=(centre + offset, side * 1.02, radius),
                    )
                )
        for side in (-1, 1):
            parts.append(
                box(
                    (span + 1.1, 0.1, 0.26),
                    GREY,
                    centre=(centre, side * 1.0, radius + 0.18),
                )
            )
    parts.append(
        box(
            (c.length * 0.22, 2.0, 0.5),
            GREY,
            centre=(c.x, 0, 0.62),
        )
    )
    return parts


def _roof(c: _Car, rng: np.random.Generator, *, electric: bool) -> list[Mesh]:
    """Grilles, fans and boxes along the roof; a pantograph on electric ones."""
    parts = []
    count = int(rng.integers(3, 6))
    for x in np.linspace(-0.34, 0.34, count) * c.length + c.x:
        kind = rng.integers(3)
        if kind == 0:
            parts.append(
                box(
                    (c.length * 0.1, 1.3, 0.28),
                    GREY,
                    centre=(x, 0, c.roof + 0.1),
                )
            )
            for k in (-0.4, 0.0, 0.4):
                parts.append(
                    box(
                        (c.length * 0.09, 0.16, 0.02),
                        BLACK,
                        centre=(x, k, c.roof + 0.25),
                    )
                )
        elif kind == 1:
            for y in (-0.38, 0.38):
                fan = lathe(
                    [[0.36, 0], [0.36, 0.14], [0.3, 0.16], [0.29, 0.1], [0, 0.09]],
                    BLACK,
                    segments=18,
                )
                parts.append(transform(fan, translation(x, y, c.roof + 0.02)))
        else:
            parts.append(
                box(
                    (c.length * 0.13, 0.7, 0.2),
                    c.roof_colour * 0.75,
                    centre=(x, 0, c.roof + 0.1),
                )
            )
    if electric:
        x = c.x - 0.15 * c.length
        top = c.roof + rng.uniform(0.7, 1.1)
        for y in (-0.5, 0.5):
            path = [
                [x - 0.8, y * 0.8, c.roof],
                [x + 0.6, y * 0.6, (c.roof + top) / 2],
                [x - 0.5, y * 0.7, top],
            ]
            parts.append(
                sweep(
                    path,
                    np.full(3, 0.045),
                    BLACK,
                    segments=6,
                    up=(0, 1, 0),
                )
            )
        for dx in (-0.65, -0.35):
            parts.append(
                sweep(
                    [[x + dx, -0.85, top], [x + dx, 0.85, top]],
                    [0.04, 0.04],
                    BLACK,
                    segments=6,
                )
            )
        parts.append(
            box(
                (1.9, 1.5, 0.1),
                STEEL,
                centre=(x, 0, c.roof + 0.05),
            )
        )
    return parts


def build(seed: int = 0) -> Model:
    """A train 12 to 18 m long that faces +x: a locomotive, a railcar, or a short
    locomotive with one carriage.
    """
    rng = np.random.default_rng([seed, 0x7A1])
    body, stripe = (
        np.array(c, np.float32) for c in LIVERIES[rng.integers(len(LIVERIES))]
    )
    if rng.random() < 0.25:
        body, stripe = stripe, body
    body = np.clip(body * rng.uniform(0.85, 1.08), 0.02, 0.95).astype(np.float32)
    roof_colour = np.array(
        [(0.42, 0.43, 0.45), (0.25, 0.26, 0.27), (0.62, 0.63, 0.64)][rng.integers(3)],
        np.float32,
    )
    kind = str(rng.choice(["locomotive", "railcar", "pair"], p=[0.45, 0.25, 0.3]))
    length = rng.uniform(12.5, 17.5)
    lean = {
        "locomotive": rng.uniform(0.15, 0.7),
        "railcar": rng.uniform(0.9, 1.6),
        "pair": rng.uniform(0.2, 1.0),
    }[kind]
    half = rng.uniform(1.38, 1.5)
    height = rng.uniform(3.75, 4.1)
    electric = bool(rng.random() < 0.5)
    car = functools.partial(
        _Car,
        half=half,
        floor=1.08,
        lean=lean,
        body=body,
        stripe=stripe,
        roof_colour=roof_colour,
    )
    if kind == "pair":
        first = length * rng.uniform(0.48, 0.56)
        engine = car(x=(length - first) / 2, length=first, roof=height)
        coach = car(
            x=-(first + 0.5) / 2, length=length - first - 0.5, roof=height * 0.98
        )
        bellows = box(
            (0.7, 1.6, 2.2),
            BLACK,
            centre=(length / 2 - first - 0.25, 0, 2.2),
        )
        parts = [
            *_body(coach, (False, False)),
            *_sides(coach, rng, cab=(False, False), passengers=True),
            bellows,
        ]
        parts += [*_bogies(coach, axles=2), *_roof(coach, rng, electric=False)]
        cab = (False, True)
    else:
        engine = car(x=0.0, length=length, roof=height)
        parts = []
        cab = (True, True)
    parts += [
        *_body(engine, cab),
        *_sides(engine, rng, cab=cab, passengers=kind == "railcar"),
    ]
    for sign in (1.0, -1.0) if cab[0] else (1.0,):
        parts += _front(engine, sign, rng)
    parts += _bogies(
        engine, axles=3 if kind == "locomotive" and rng.random() < 0.5 else 2
    )
    return Model("train", (*parts, *_roof(engine, rng, electric=electric)))
