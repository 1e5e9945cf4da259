"""Proportions of cars, and what follows from them alone: the painted shell and the cabin."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.assets.mesh import Mesh
from mi_splat.assets.outlines import Points, rounded_rectangle, smooth_interpolate
from mi_splat.assets.primitives import box, loft, sweep

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
        return self.half * (1 - (0.1 if x > 0 else 0.07) * t**3 - 0.12 * max(0.0, t - 0.9) / 0.1)


def proportions(kind: str, rng: np.random.Generator) -> Proportions:
    """A car of one kind: saloon, hatchback, estate or offroad."""
    length = {"saloon": 4.5, "hatchback": 4.0, "estate": 4.6, "offroad": 4.4}[kind] * rng.uniform(0.95, 1.05)
    high = kind == "offroad"
    roof = (1.72 if high else 1.45) * rng.uniform(0.97, 1.04)
    belt = (1.08 if high else 0.92) * rng.uniform(0.97, 1.03)
    front = rng.uniform(0.2, 0.25)
    rear = {"saloon": -0.33, "hatchback": -0.47, "estate": -0.485, "offroad": -0.475}[kind]
    roof_rear = {"saloon": -0.19, "hatchback": -0.36, "estate": -0.42, "offroad": -0.43}[kind] * rng.uniform(0.95, 1.03)
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
        top=(roof_rear * length, (front - rng.uniform(0.15, 0.19) + (0.05 if high else 0)) * length),
    )


def top_edge(s: Proportions, x: ArrayLike) -> Points:
    """Height of bonnet, window line and boot along the car."""
    knots = np.array([-0.5, -0.47, s.base[0] / s.length + 0.02, s.base[1] / s.length, 0.4, 0.475, 0.5]) * s.length
    knots[2] = max(knots[2], -0.46 * s.length)
    values = [s.tail * 0.9, s.tail, s.belt, s.belt, (s.belt * 0.3 + s.nose * 0.7) * 1.02, s.nose, s.nose * 0.86]
    return smooth_interpolate(x, knots, values)


def half_width_at(s: Proportions, x: float, level: float) -> float:
    """Half width of the body at `x` and a relative height (0 sill, 1 top edge)."""
    return s.half_width(x) * float(
        smooth_interpolate(level, [0, 0.12, 0.35, 0.6, 0.85, 0.97, 1], [0.93, 0.97, 0.99, 1, 0.965, 0.91, 0.8])
    )


def bottom_edge(s: Proportions, x: float) -> float:
    """Height of the body's lower edge at `x`: the sill, the bumpers, and the arches over the wheels."""
    low = s.clearance + 0.06 * max(0.0, abs(2 * x / s.length) - 0.8) / 0.2
    for axle in s.axles:
        reach = (s.wheel * 1.17) ** 2 - (x - axle) ** 2
        if reach > 0:
            low = max(low, s.wheel + reach**0.5)
    return low


def body(s: Proportions, paint: ArrayLike) -> list[Mesh]:
    """The painted shell below the windows, with open wheel arches, over a black floor."""
    arch = s.wheel * 1.17
    stations = [np.linspace(-s.length / 2, s.length / 2, 61)]
    for axle in s.axles:
        stations += [
            axle + arch * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 17)),
            np.array([axle - arch - 1e-3, axle + arch + 1e-3]),
        ]
    x = np.unique(np.round(np.concatenate(stations), 4))
    tops = top_edge(s, x)
    levels = np.array([0.0, 0.12, 0.25, 0.42, 0.6, 0.75, 0.88, 0.95, 1.0])
    rings = []
    for position, top in zip(x, tops, strict=True):
        low = bottom_edge(s, position)
        sill = s.clearance
        z = low + levels * (top - low)
        width = np.array([half_width_at(s, position, max(0.0, (level - sill) / (top - sill))) for level in z])
        inner = np.array([0.75, 0.4])
        y = np.concatenate([width, s.half_width(position) * inner, [0.0]])
        crown = np.array([0.012, 0.022, 0.026])
        height = np.concatenate([z, top + crown])
        right = np.stack([np.full_like(y, position), -y, height], -1)
        left = np.stack([np.full_like(y, position), y, height], -1)[::-1][1:]
        rings.append(np.concatenate([right, left])[::-1])
    shell = loft(np.array(rings), paint, roughness=0.08)
    floor = box((s.length * 0.9, s.half * 1.42, 0.3), BLACK, centre=(0, 0, s.clearance + 0.2))
    return [shell, floor]


def cabin(s: Proportions, paint: ArrayLike, roof_paint: ArrayLike, glass_roof: bool) -> list[Mesh]:
    """Windows as one dark glass body with painted pillars and roof."""
    levels = np.array([-0.12, 0.0, 0.3, 0.6, 0.85, 0.95, 1.0])
    height = s.belt + levels * (s.roof - 0.07 - s.belt)
    bulge = np.clip(levels, 0, 1) ** 1.35

    def ring(level: int, grow: float) -> Points:
        t = float(bulge[level])
        rear, front = ((1 - t) * np.array(s.base) + t * np.array(s.top)).tolist()
        half = s.half * ((1 - t) * 0.86 + t * 0.66) + grow
        loop = rounded_rectangle(front - rear + 2 * grow, 2 * half, 0.1 + 0.1 * t, corner=5)
        loop[:, 0] += (front + rear) / 2
        bow = 0.09 * (1 - (loop[:, 1] / half) ** 2)
        loop[:, 0] += np.where(loop[:, 0] > 0, bow, -bow * 0.6)
        return np.concatenate([loop, np.full((len(loop), 1), height[level])], 1)

    glass = loft(np.array([ring(i, 0.0) for i in range(7)]), GLASS, roughness=0.08)
    roof_rings = [ring(4, 0.006), ring(5, 0.008), ring(6, 0.004)]
    centre = np.array([(s.top[0] + s.top[1]) / 2, 0, 0])
    for shrink, rise in ((0.965, 0.028), (0.85, 0.05), (0.6, 0.062), (0.3, 0.068)):
        last = ring(6, 0.0)
        last[:, :2] = centre[:2] + (last[:, :2] - centre[:2]) * shrink
        last[:, 2] += rise
        roof_rings.append(last)
    parts = [glass, loft(np.array(roof_rings), roof_paint, roughness=0.08)]
    if glass_roof:
        middle = [(0.3, 0.06), (0.3, 0.075)]
        pane = [rounded_rectangle(0.5 * (s.top[1] - s.top[0]), 0.85 * s.half, 0.06) for _ in middle]
        rings = [
            np.concatenate([p + centre[:2], np.full((len(p), 1), height[6] + z)], 1)
            for p, (_, z) in zip(pane, middle, strict=True)
        ]
        parts.append(loft(np.array(rings), GLASS, roughness=0.08))
    outside = [ring(i, 0.002) for i in range(7)]
    corner = len(outside[0]) // 4
    for start in range(4):
        path = np.array([loop[start * corner + 2] for loop in outside[1:]])
        parts.append(sweep(path, np.full(len(path), 0.045), paint, segments=8, roughness=0.08))
    for fraction in (0.44, 0.62) if s.base[0] < -0.42 * s.length else (0.42,):
        for side in (1, -1):
            pillar = []
            for i, loop in enumerate(outside[1:]):
                x = (
                    s.top[0] * 0.6
                    + s.base[0] * 0.4
                    + fraction * (s.base[1] * 0.5 + s.top[1] * 0.5 - s.top[0] * 0.6 - s.base[0] * 0.4)
                )
                pillar.append([x, side * (np.abs(loop[:, 1]).max() - 0.012), height[i + 1]])
            parts.append(sweep(pillar, np.tile([0.035, 0.022], (6, 1)), BLACK, segments=6))
    return parts
