"""Suitcases: hard-shell trolleys with ribs, wheels and a telescopic handle, and leather ones with straps."""

from __future__ import annotations

import numpy as np

from mi_splat.assets import textures
from mi_splat.assets.mesh import Asset, Mesh, box, lathe, loft, rotation, sweep, transform, translation
from mi_splat.assets.outlines import rounded_rectangle

SHELLS = (
    (0.1, 0.35, 0.6), (0.75, 0.1, 0.14), (0.08, 0.08, 0.09), (0.6, 0.62, 0.64), (0.9, 0.55, 0.1), (0.1, 0.5, 0.45),
    (0.85, 0.72, 0.2), (0.5, 0.2, 0.5), (0.85, 0.45, 0.5), (0.15, 0.2, 0.35), (0.35, 0.6, 0.3), (0.9, 0.88, 0.82),
)  # fmt: skip
METAL = (0.62, 0.63, 0.65)
BLACK = (0.05, 0.05, 0.055)


def _shell(depth: float, width: float, height: float, colour: np.ndarray, low: float) -> Mesh:
    """A box with rounded edges all around, standing at height `low`."""
    rings = []
    edge = min(depth, width) * 0.22
    for angle in np.linspace(-90, 90, 13):
        inset = edge * (1 - np.cos(np.radians(angle)))
        z = edge * (1 + np.sin(np.radians(angle))) if angle < 0 else height - edge * (1 - np.sin(np.radians(angle)))
        outline = rounded_rectangle(depth - 2 * inset, width - 2 * inset, max(edge - 0.55 * inset, 0.01), corner=6)
        rings.append(np.concatenate([outline, np.full((len(outline), 1), low + z)], 1))
    return loft(np.array(rings), colour, roughness=0.2)


def _trolley(rng: np.random.Generator) -> list[Mesh]:
    height, width, depth = rng.uniform(0.56, 0.7), rng.uniform(0.4, 0.48), rng.uniform(0.23, 0.29)
    low = 0.065
    colour = np.clip(np.array(SHELLS[rng.integers(len(SHELLS))]) * rng.uniform(0.85, 1.12), 0.03, 0.95)
    parts = [_shell(depth, width, height, colour, low)]
    ribs = int(rng.integers(4, 8))
    if rng.random() < 0.75:
        for y in np.linspace(-0.36, 0.36, ribs) * width:
            for side in (1, -1):
                path = [
                    [side * (depth / 2 + d), y, low + t * height]
                    for t, d in ((0.1, -0.012), (0.14, 0.002), (0.86, 0.002), (0.9, -0.012))
                ]
                parts.append(
                    sweep(path, np.full(4, 0.2 * width / ribs), colour * 0.92, segments=8, up=(1, 0, 0), roughness=0.2)
                )
    else:
        for t in np.linspace(0.16, 0.84, ribs):
            for side in (1, -1):
                path = [
                    [side * (depth / 2 + d), y * width, low + t * height]
                    for y, d in ((-0.4, -0.012), (-0.36, 0.002), (0.36, 0.002), (0.4, -0.012))
                ]
                parts.append(sweep(path, np.full(4, 0.2 * height / ribs), colour * 0.92, segments=8, roughness=0.2))
    seam = rounded_rectangle(height + 0.004, width + 0.004, 0.075, corner=6)
    ring = np.array([[0.0, y, low + height / 2 + z] for z, y in np.concatenate([seam, seam[:2]])])
    parts.append(sweep(ring, np.full(len(ring), 0.008), np.array(BLACK) * 1.5, segments=6, up=(1, 0, 0)))
    for x in (1, -1):
        for y in (1, -1):
            place = translation(x * (depth / 2 - 0.045), y * (width / 2 - 0.055), 0)
            wheel = transform(
                lathe([[0.012, -0.012], [0.028, -0.012], [0.028, 0.012], [0.012, 0.012]], BLACK, segments=14),
                translation(0, 0, 0.028) @ rotation("z", float(rng.uniform(0, 180))) @ rotation("x", 90),
            )
            fork = box((0.05, 0.04, 0.045), BLACK, centre=(0, 0, 0.058))
            parts += [transform(wheel, place), transform(fork, place)]
            for z in (0.035, height - 0.035):
                guard = box(
                    (0.06, 0.06, 0.05), BLACK, centre=(x * (depth / 2 - 0.045), y * (width / 2 - 0.045), low + z)
                )
                if rng.random() < 0.99 and z < 0.1:
                    parts.append(guard)
    top = low + height
    parts.append(
        sweep(
            [
                [0.02, -0.1, top - 0.01],
                [0.02, -0.085, top + 0.022],
                [0.02, 0.085, top + 0.022],
                [0.02, 0.1, top - 0.01],
            ],
            np.full(4, 0.012),
            BLACK,
            segments=8,
        )
    )
    edge = width / 2
    parts.append(
        sweep(
            [
                [0, edge - 0.01, low + height * 0.4],
                [0, edge + 0.022, low + height * 0.43],
                [0, edge + 0.022, low + height * 0.57],
                [0, edge - 0.01, low + height * 0.6],
            ],
            np.full(4, 0.011),
            BLACK,
            segments=8,
        )
    )
    reach = rng.uniform(0.2, 0.42) if rng.random() < 0.65 else 0.03
    back = -depth / 2 + 0.035
    for y in (0.1, -0.1):
        parts.append(
            sweep([[back, y, top - 0.03], [back, y, top + reach]], [0.011, 0.009], METAL, segments=8, roughness=0.2)
        )
    parts.append(
        sweep(
            [
                [back, -0.13, top + reach],
                [back, -0.1, top + reach + 0.015],
                [back, 0.1, top + reach + 0.015],
                [back, 0.13, top + reach],
            ],
            np.full(4, 0.016),
            BLACK,
            segments=8,
        )
    )
    parts.append(box((0.006, 0.09, 0.03), METAL, centre=(depth / 2 + 0.008, 0, low + height * 0.88), roughness=0.2))
    return parts


def _leather(rng: np.random.Generator) -> list[Mesh]:
    height, width, depth = rng.uniform(0.4, 0.48), rng.uniform(0.6, 0.74), rng.uniform(0.18, 0.24)
    low = 0.012
    tone = np.array(
        [(0.45, 0.25, 0.12), (0.6, 0.38, 0.2), (0.3, 0.14, 0.09), (0.35, 0.3, 0.2), (0.2, 0.22, 0.25)][rng.integers(5)]
    )
    hide = textures.speckle((128, 128), tone, rng, grain=0.06, patch=0.35)
    dark = tone * 0.45
    outline = rounded_rectangle(width, height, 0.035, corner=5)
    rings = [
        np.stack([np.full(len(outline), x * depth), outline[:, 0] * s, low + height / 2 + outline[:, 1] * s], 1)
        for x, s in ((-0.5, 0.955), (-0.47, 0.99), (-0.42, 1), (0.42, 1), (0.47, 0.99), (0.5, 0.955))
    ]
    parts = [loft(np.array(rings), hide, roughness=0.35)]
    for x in (-0.42, 0.0, 0.42):
        edge = np.array(
            [[x * depth, y * 1.003, low + height / 2 + z * 1.005] for y, z in np.concatenate([outline, outline[:2]])]
        )
        parts.append(sweep(edge, np.full(len(edge), 0.007 if x else 0.005), dark, segments=6, up=(1, 0, 0)))
    for y in (-0.27, 0.27):
        belt = rounded_rectangle(depth + 0.012, height + 0.012, 0.02, corner=3)
        inner = [[px, y * width - 0.022, low + height / 2 + pz] for px, pz in belt]
        outer = [[px, y * width + 0.022, low + height / 2 + pz] for px, pz in belt]
        parts.append(loft(np.array([outer, inner]), dark * 1.15))
        parts.append(
            box(
                (0.012, 0.06, 0.05),
                (0.75, 0.62, 0.3),
                centre=(depth / 2 + 0.008, y * width, low + height * 0.72),
                roughness=0.2,
            )
        )
    for y in (1, -1):
        for z in (1, -1):
            for x in (1, -1):
                parts.append(
                    box(
                        (0.03, 0.075, 0.075),
                        (0.72, 0.6, 0.32) if tone.mean() < 0.35 else dark,
                        centre=(
                            x * (depth / 2 - 0.012),
                            y * (width / 2 - 0.034),
                            low + height / 2 + z * (height / 2 - 0.034),
                        ),
                        roughness=0.2,
                    )
                )
    top = low + height
    parts.append(
        sweep(
            [
                [0, -0.09, top],
                [0, -0.085, top + 0.035],
                [0, -0.05, top + 0.05],
                [0, 0.05, top + 0.05],
                [0, 0.085, top + 0.035],
                [0, 0.09, top],
            ],
            np.full(6, 0.015),
            dark,
            segments=8,
        )
    )
    for y in (0.12, -0.12):
        parts.append(box((0.05, 0.05, 0.02), (0.75, 0.62, 0.3), centre=(0.02, y, top), roughness=0.2))
    return parts


def build(seed: int = 0) -> Asset:
    """A suitcase about 0.7 m high (trolley) or wide (leather), its broad face along +x."""
    rng = np.random.default_rng([seed, 0x5C])
    parts = _trolley(rng) if rng.random() < 0.68 else _leather(rng)
    lying = rng.random() < 0.15
    if lying:
        points = np.concatenate([part.vertices for part in parts])
        middle = float(points[:, 2].max()) / 2
        parts = [transform(part, rotation("y", -90) @ translation(0, 0, -middle)) for part in parts]
        floor = min(float(part.vertices[:, 2].min()) for part in parts)
        parts = [transform(part, translation(0, 0, -floor)) for part in parts]
    return Asset("suitcase", tuple(parts))
