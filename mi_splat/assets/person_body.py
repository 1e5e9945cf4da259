"""What a person wears and how the body under it is built; positions are those of a figure of 1.75 m, facing +x."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.implicit import Blob, Doubles, Layer, above, chain, cone, ellipsoid
from mi_splat.assets.mesh import Floats, Mesh
from mi_splat.assets.organic import Noise, body, mix, spot
from mi_splat.assets.primitives import loft


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Appearance:
    """What a seed decides about a person's appearance."""

    feminine: bool
    girth: float
    skin: Floats
    hair: Floats
    style: str
    pattern: str
    shirt: Floats
    accent: Floats
    trousers: Floats
    shoes: Floats
    legs: str
    sleeves: str
    hem: float
    beard: float
    cap: str
    backpack: bool


@dataclass(frozen=True, slots=True, eq=False)
class Limb:
    """Three joints of an arm (shoulder, elbow, wrist) or a leg (hip, knee, ankle), and the direction it ends in."""

    joints: Doubles
    end: Doubles


def _torso(appearance: Appearance) -> list[Blob]:
    """Chest, shoulders and belly, in clothes."""
    g, wide = appearance.girth, 0.105 if appearance.feminine else 0.130
    blobs = [
        cone((0.0, 0, 1.17), (0.0, 0, 1.345), (0.100 * g, 0.108 * g), flat=(0, 0.38, 0)),
        cone((-0.012, -wide, 1.41), (-0.012, wide, 1.41), (0.066, 0.066)),
        cone((-0.018, -0.045, 1.468), (-0.014, -wide - 0.02, 1.42), (0.052, 0.055)),
        cone((-0.018, 0.045, 1.468), (-0.014, wide + 0.02, 1.42), (0.052, 0.055)),
        above(cone((-0.012, 0, 0.92), (-0.002, 0, 1.04), (0.131 * g, 0.117 * g), flat=(0, 0.42, 0)), appearance.hem),
        cone(
            (0.0, 0, 1.12),
            (0.0, 0, 1.16),
            (0.108 * g, (0.092 if appearance.feminine else 0.103) * g),
            flat=(0, 0.38, 0),
        ),
        cone((-0.015, 0, 1.43), (-0.02, 0, 1.50), (0.075, 0.058)),
    ]
    if appearance.feminine:
        blobs += [ellipsoid((0.075, s * 0.068, 1.29), (0.062, 0.062, 0.066)) for s in (1, -1)]
    elif appearance.girth > 1.05:
        blobs.append(above(ellipsoid((0.055, 0, 1.10), (0.10 * g, 0.12 * g, 0.13)), appearance.hem))
    return blobs


def _layers(appearance: Appearance, arms: list[Limb], legs: list[Limb]) -> list[Layer]:
    """Skin, top, bottom, shoes and what is carried."""
    skin: list[Blob] = [cone((-0.015, 0, 1.45), (-0.005, 0, 1.56), (0.055, 0.05))]
    top, bottom, shoes = _torso(appearance), list[Blob](), list[Blob]()
    thick = appearance.girth * (0.93 if appearance.feminine else 1.0)
    for arm in arms:
        shoulder, elbow, wrist = arm.joints
        skin += chain(arm.joints, [0.048 * thick, 0.040 * thick, 0.029])
        short = shoulder + 0.72 * (elbow - shoulder)
        if appearance.sleeves == "long":
            top += chain([shoulder, elbow, elbow + 0.94 * (wrist - elbow)], [0.062 * thick, 0.050, 0.041])
        else:
            top.append(cone(shoulder, short, (0.063 * thick, 0.056 * thick)))
    g = appearance.girth
    bottom.append(cone((-0.005, 0, 0.925), (0, 0, 1.01), (0.112 * g, 0.106 * g), flat=(0, 0.42, 0)))
    bottom.append(ellipsoid((-0.05, 0, 0.90), (0.085 * g, 0.15 * g, 0.10)))
    for leg in legs:
        hip, knee, ankle = leg.joints
        skin += chain(leg.joints, [0.075 * thick, 0.055, 0.040])
        if appearance.legs != "long":
            skin.append(cone(knee, knee + 0.3 * (ankle - knee) - 0.014 * leg.end, (0.045, 0.054 * thick)))
        if appearance.legs == "long":
            bottom += chain([hip, knee, ankle + 0.02 * (knee - ankle)], [0.092 * thick, 0.069, 0.059])
        elif appearance.legs == "short":
            bottom.append(cone(hip, hip + 0.92 * (knee - hip), (0.095 * thick, 0.078)))
        heel, ball = ankle - 0.025 * leg.end - (0, 0, 0.035), ankle + 0.115 * leg.end - (0, 0, 0.045)
        shoes += chain([heel, ball, ball + 0.06 * leg.end], [0.042, 0.041, 0.034], flat=(0, 0.12, 0))
        shoes.append(cone(ankle, heel, (0.048, 0.046)))
    layers = [Layer(tuple(skin), 0.03), Layer(tuple(top), 0.05), Layer(tuple(bottom), 0.05)]
    layers.append(Layer(tuple(shoes), 0.03))
    if appearance.backpack:
        pack = (ellipsoid((-0.17, 0, 1.27), (0.095, 0.15, 0.21)), ellipsoid((-0.25, 0, 1.20), (0.05, 0.10, 0.10)))
        layers.append(Layer(pack, 0.04))
    return layers


def clothed(appearance: Appearance, arms: list[Limb], legs: list[Limb], noise: Noise) -> Mesh:
    """Everything but head and hands."""
    layers = _layers(appearance, arms, legs)

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        colours = np.broadcast_to(appearance.skin, points.shape).copy()
        for index, painter in enumerate((_paint_top, _paint_bottom, _paint_shoes, _paint_pack), 1):
            chosen = np.flatnonzero(layer == index)
            if len(chosen):
                colours[chosen] = painter(appearance, points[chosen], noise)
        grain = 1 + 0.07 * noise(points, 0.015) + 0.06 * noise(points, (0.03, 0.03, 0.12))
        result: Floats = colours * grain[:, None]
        return result

    def relief(points: Floats) -> Floats:
        folds: Floats = 0.006 * noise(points, (0.06, 0.06, 0.11)) * (points[:, 2] > 0.1)
        return folds

    return body(layers, 0.0195, paint, relief=relief)


def _paint_top(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Shirt, jumper, jacket or vest."""
    x, y, z = points.T
    colours = np.broadcast_to(appearance.shirt, points.shape).astype(np.float32)
    if appearance.pattern == "stripes":
        colours = mix(colours, appearance.accent, np.sin(z * 2 * np.pi / 0.075) * 6)
    elif appearance.pattern == "check":
        lines = (np.sin(y * 2 * np.pi / 0.08) > 0.3) * 0.45 + (np.sin(z * 2 * np.pi / 0.08) > 0.3) * 0.45
        colours = mix(colours, appearance.accent, lines)
    elif appearance.pattern == "print":
        colours = mix(colours, appearance.accent, spot(points, (0.12, 0, 1.29), (0.12, 0.085, 0.075), 0.1))
        colours = mix(colours, appearance.shirt, spot(points, (0.12, 0, 1.29), (0.12, 0.045, 0.035), 0.1))
    elif appearance.pattern == "jacket":
        gap = 0.018 + 0.09 * np.clip((z - 1.15) / 0.3, 0, 1)
        front = (x > 0.02) & (np.abs(points[:, 1]) < gap)
        colours = mix(colours, appearance.accent, front)
        colours = mix(colours, appearance.shirt * 0.55, (x > 0.02) & (np.abs(np.abs(y) - gap) < 0.012))
    elif appearance.pattern == "vest":
        colours = mix(colours, (0.80, 0.90, 0.15), np.abs(y) < 0.17)
        bands = (np.abs(z - 1.14) < 0.028) | (np.abs(z - 1.27) < 0.028) | (np.abs(np.abs(y) - 0.1) < 0.022) & (z > 1.27)
        colours = mix(colours, (0.85, 0.85, 0.86), bands & (np.abs(y) < 0.17))
    collar = spot(points, (-0.01, 0, 1.515), (0.085, 0.085, 0.035), 0.3)
    return mix(colours, appearance.shirt * 0.7, collar * 0.8 + 0.12 * (noise(points, 0.05) > 0.5))


def _paint_bottom(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Trousers with belt, pockets, seams and worn knees."""
    y, z = points[:, 1], points[:, 2]
    colours = np.broadcast_to(appearance.trousers, points.shape).astype(np.float32)
    colours = mix(colours, appearance.trousers * 1.35 + 0.03, 0.5 * noise(points, 0.09))
    colours = mix(colours, appearance.trousers * 0.6, (np.abs(y) < 0.007) & (z > 0.8))
    for side in (1, -1):
        pocket = spot(points, (-0.15, side * 0.075, 0.95), (0.08, 0.055, 0.06), 0.05)
        colours = mix(colours, appearance.trousers * 0.75, pocket * 0.7)
    colours = mix(colours, (0.16, 0.11, 0.08), np.abs(z - 1.0) < 0.02)
    return mix(colours, (0.75, 0.70, 0.55), spot(points, (0.13, 0, 1.0), (0.06, 0.025, 0.02), 0.1))


def _paint_shoes(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Shoes with a lighter sole and laces."""
    floor = points[:, 2].min()
    colours = np.broadcast_to(appearance.shoes, points.shape).astype(np.float32)
    colours = mix(
        colours, (0.82, 0.81, 0.78), 0.8 * (points[:, 2] > floor + 0.068) * (np.sin(points[:, 0] * 280) > 0.2)
    )
    return mix(
        colours, (0.75, 0.74, 0.72) if appearance.shoes.mean() < 0.6 else (0.3, 0.3, 0.3), points[:, 2] < floor + 0.022
    )


def _paint_pack(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """A backpack with a zip."""
    colours = np.broadcast_to(appearance.accent * 0.8, points.shape).astype(np.float32)
    return mix(colours, (0.1, 0.1, 0.1), np.abs(points[:, 2] - 1.33 + 0.1 * noise(points, 0.5)) < 0.008)


def skirt(appearance: Appearance, legs: list[Limb], noise: Noise) -> Mesh:
    """A pleated skirt about both thighs."""
    knees = np.stack([leg.joints[1] for leg in legs])
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    g = appearance.girth
    levels = np.linspace(0, 1, 9)
    deep = np.stack([0.125 * g + levels**0.8 * (0.05 + np.abs(knees[:, 0]).max()), 0.165 * g + 0.10 * levels**0.8], 1)
    pleat = 1 + 0.05 * levels[:, None] * np.sin(angle * 12) + 0.03 * levels[:, None] * np.sin(angle * 5 + 1)
    rings = np.stack(
        [
            deep[:, :1] * pleat * np.cos(angle) - 0.01,
            deep[:, 1:] * pleat * np.sin(angle),
            np.broadcast_to(1.03 - 0.50 * levels[:, None], pleat.shape),
        ],
        -1,
    )
    v, u = np.mgrid[0:1:64j, 0:1:256j]
    points = np.stack([np.cos(2 * np.pi * u) * 0.2, np.sin(2 * np.pi * u) * 0.2, v * 0.5], -1).reshape(-1, 3)
    cloth = np.broadcast_to(appearance.accent, points.shape).astype(np.float32)
    cloth = mix(cloth, appearance.accent * 0.72, 0.5 + 0.5 * np.sin(u.ravel() * 24 * np.pi))
    cloth = mix(
        cloth,
        appearance.shirt,
        (np.abs(v.ravel() - 0.08) < 0.03) * 0.8 if appearance.pattern == "stripes" else 0 * u.ravel(),
    )
    cloth = cloth * (1 + 0.08 * noise(points.astype(np.float32), 0.012))[:, None]
    return loft(rings[::-1], np.clip(cloth, 0, 1).reshape(64, 256, 3))
