"""A person of 1.5 to 1.95 m: clothes, skin, hair, build and pose vary with the seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.mesh import (
    Floats,
    Mesh,
    rotation,
    scaling,
    transform,
    translation,
)
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.organic import (
    Blob,
    Doubles,
    Layer,
    Noise,
    above,
    body,
    chain,
    cone,
    ellipsoid,
    grounded,
    mix,
    spot,
)
from scenes.recipes.objects.primitives import loft


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
    """Three joints of an arm (shoulder, elbow, wrist) or a leg (hip, knee, ankle), and
    the direction it ends in.
    """

    joints: Doubles
    end: Doubles


def _torso(appearance: Appearance) -> list[Blob]:
    """Chest, shoulders and belly, in clothes."""
    g = appearance.girth
    wide = 0.105 if appearance.feminine else 0.130
    blobs = [
        cone(
            (0.0, 0, 1.17),
            (0.0, 0, 1.345),
            (0.100 * g, 0.108 * g),
            flat=(0, 0.38, 0),
        ),
        cone(
            (-0.012, -wide, 1.41),
            (-0.012, wide, 1.41),
            (0.066, 0.066),
        ),
        cone(
            (-0.018, -0.045, 1.468),
            (-0.014, -wide - 0.02, 1.42),
            (0.052, 0.055),
        ),
        cone(
            (-0.018, 0.045, 1.468),
            (-0.014, wide + 0.02, 1.42),
            (0.052, 0.055),
        ),
        above(
            cone(
                (-0.012, 0, 0.92),
                (-0.002, 0, 1.04),
                (0.131 * g, 0.117 * g),
                flat=(0, 0.42, 0),
            ),
            appearance.hem,
        ),
        cone(
            (0.0, 0, 1.12),
            (0.0, 0, 1.16),
            (0.108 * g, (0.092 if appearance.feminine else 0.103) * g),
            flat=(0, 0.38, 0),
        ),
        cone(
            (-0.015, 0, 1.43),
            (-0.02, 0, 1.50),
            (0.075, 0.058),
        ),
    ]
    if appearance.feminine:
        blobs += [
            ellipsoid((0.075, s * 0.068, 1.29), (0.062, 0.062, 0.066)) for s in (1, -1)
        ]
    elif appearance.girth > 1.05:
        blobs.append(
            above(
                ellipsoid((0.055, 0, 1.10), (0.10 * g, 0.12 * g, 0.13)), appearance.hem
            )
        )
    return blobs


def _layers(appearance: Appearance, arms: list[Limb], legs: list[Limb]) -> list[Layer]:
    """Skin, top, bottom, shoes and what is carried."""
    skin: list[Blob] = [
        cone(
            (-0.015, 0, 1.45),
            (-0.005, 0, 1.56),
            (0.055, 0.05),
        )
    ]
    top = _torso(appearance)
    bottom = list[Blob]()
    shoes = list[Blob]()
    thick = appearance.girth * (0.93 if appearance.feminine else 1.0)
    for arm in arms:
        shoulder, elbow, wrist = arm.joints
        skin += chain(arm.joints, [0.048 * thick, 0.040 * thick, 0.029])
        short = shoulder + 0.72 * (elbow - shoulder)
        if appearance.sleeves == "long":
            top += chain(
                [shoulder, elbow, elbow + 0.94 * (wrist - elbow)],
                [0.062 * thick, 0.050, 0.041],
            )
        else:
            top.append(cone(shoulder, short, (0.063 * thick, 0.056 * thick)))
    g = appearance.girth
    bottom.append(
        cone(
            (-0.005, 0, 0.925),
            (0, 0, 1.01),
            (0.112 * g, 0.106 * g),
            flat=(0, 0.42, 0),
        )
    )
    bottom.append(ellipsoid((-0.05, 0, 0.90), (0.085 * g, 0.15 * g, 0.10)))
    for leg in legs:
        hip, knee, ankle = leg.joints
        skin += chain(leg.joints, [0.075 * thick, 0.055, 0.040])
        if appearance.legs != "long":
            skin.append(
                cone(
                    knee,
                    knee + 0.3 * (ankle - knee) - 0.014 * leg.end,
                    (0.045, 0.054 * thick),
                )
            )
        if appearance.legs == "long":
            bottom += chain(
                [hip, knee, ankle + 0.02 * (knee - ankle)],
                [0.092 * thick, 0.069, 0.059],
            )
        elif appearance.legs == "short":
            bottom.append(
                cone(
                    hip,
                    hip + 0.92 * (knee - hip),
                    (0.095 * thick, 0.078),
                )
            )
        heel = ankle - 0.025 * leg.end - (0, 0, 0.035)
        ball = ankle + 0.115 * leg.end - (0, 0, 0.045)
        shoes += chain(
            [heel, ball, ball + 0.06 * leg.end],
            [0.042, 0.041, 0.034],
            flat=(0, 0.12, 0),
        )
        shoes.append(cone(ankle, heel, (0.048, 0.046)))
    layers = [
        Layer(tuple(skin), 0.03),
        Layer(tuple(top), 0.05),
        Layer(tuple(bottom), 0.05),
    ]
    layers.append(Layer(tuple(shoes), 0.03))
    if appearance.backpack:
        pack = (
            ellipsoid((-0.17, 0, 1.27), (0.095, 0.15, 0.21)),
            ellipsoid((-0.25, 0, 1.20), (0.05, 0.10, 0.10)),
        )
        layers.append(Layer(pack, 0.04))
    return layers


def clothed(
    appearance: Appearance, arms: list[Limb], legs: list[Limb], noise: Noise
) -> Mesh:
    """Everything but head and hands."""
    layers = _layers(appearance, arms, legs)

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        colours = np.broadcast_to(appearance.skin, points.shape).copy()
        for index, painter in enumerate(
            (_paint_top, _paint_bottom, _paint_shoes, _paint_pack), 1
        ):
            chosen = np.flatnonzero(layer == index)
            if len(chosen):
                colours[chosen] = painter(appearance, points[chosen], noise)
        grain = (
            1 + 0.07 * noise(points, 0.015) + 0.06 * noise(points, (0.03, 0.03, 0.12))
        )
        return colours * grain[:, None]

    def relief(points: Floats) -> Floats:
        return 0.006 * noise(points, (0.06, 0.06, 0.11)) * (points[:, 2] > 0.1)

    return body(layers, 0.0195, paint, relief=relief)


def _paint_top(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Shirt, jumper, jacket or vest."""
    x, y, z = points.T
    colours = np.broadcast_to(appearance.shirt, points.shape).astype(np.float32)
    if appearance.pattern == "stripes":
        colours = mix(
            colours,
            appearance.accent,
            np.sin(z * 2 * np.pi / 0.075) * 6,
        )
    elif appearance.pattern == "check":
        lines = (np.sin(y * 2 * np.pi / 0.08) > 0.3) * 0.45 + (
            np.sin(z * 2 * np.pi / 0.08) > 0.3
        ) * 0.45
        colours = mix(colours, appearance.accent, lines)
    elif appearance.pattern == "print":
        colours = mix(
            colours,
            appearance.accent,
            spot(points, (0.12, 0, 1.29), (0.12, 0.085, 0.075), 0.1),
        )
        colours = mix(
            colours,
            appearance.shirt,
            spot(points, (0.12, 0, 1.29), (0.12, 0.045, 0.035), 0.1),
        )
    elif appearance.pattern == "jacket":
        gap = 0.018 + 0.09 * np.clip((z - 1.15) / 0.3, 0, 1)
        front = (x > 0.02) & (np.abs(points[:, 1]) < gap)
        colours = mix(colours, appearance.accent, front)
        colours = mix(
            colours,
            appearance.shirt * 0.55,
            (x > 0.02) & (np.abs(np.abs(y) - gap) < 0.012),
        )
    elif appearance.pattern == "vest":
        colours = mix(
            colours,
            (0.80, 0.90, 0.15),
            np.abs(y) < 0.17,
        )
        bands = (
            (np.abs(z - 1.14) < 0.028)
            | (np.abs(z - 1.27) < 0.028)
            | (np.abs(np.abs(y) - 0.1) < 0.022) & (z > 1.27)
        )
        colours = mix(
            colours,
            (0.85, 0.85, 0.86),
            bands & (np.abs(y) < 0.17),
        )
    collar = spot(
        points,
        (-0.01, 0, 1.515),
        (0.085, 0.085, 0.035),
        0.3,
    )
    return mix(
        colours,
        appearance.shirt * 0.7,
        collar * 0.8 + 0.12 * (noise(points, 0.05) > 0.5),
    )


def _paint_bottom(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Trousers with belt, pockets, seams and worn knees."""
    y = points[:, 1]
    z = points[:, 2]
    colours = np.broadcast_to(appearance.trousers, points.shape).astype(np.float32)
    colours = mix(
        colours,
        appearance.trousers * 1.35 + 0.03,
        0.5 * noise(points, 0.09),
    )
    colours = mix(
        colours,
        appearance.trousers * 0.6,
        (np.abs(y) < 0.007) & (z > 0.8),
    )
    for side in (1, -1):
        pocket = spot(
            points,
            (-0.15, side * 0.075, 0.95),
            (0.08, 0.055, 0.06),
            0.05,
        )
        colours = mix(colours, appearance.trousers * 0.75, pocket * 0.7)
    colours = mix(
        colours,
        (0.16, 0.11, 0.08),
        np.abs(z - 1.0) < 0.02,
    )
    return mix(
        colours,
        (0.75, 0.70, 0.55),
        spot(points, (0.13, 0, 1.0), (0.06, 0.025, 0.02), 0.1),
    )


def _paint_shoes(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """Shoes with a lighter sole and laces."""
    floor = points[:, 2].min()
    colours = np.broadcast_to(appearance.shoes, points.shape).astype(np.float32)
    colours = mix(
        colours,
        (0.82, 0.81, 0.78),
        0.8 * (points[:, 2] > floor + 0.068) * (np.sin(points[:, 0] * 280) > 0.2),
    )
    return mix(
        colours,
        (0.75, 0.74, 0.72) if appearance.shoes.mean() < 0.6 else (0.3, 0.3, 0.3),
        points[:, 2] < floor + 0.022,
    )


def _paint_pack(appearance: Appearance, points: Floats, noise: Noise) -> Floats:
    """A backpack with a zip."""
    colours = np.broadcast_to(appearance.accent * 0.8, points.shape).astype(np.float32)
    return mix(
        colours,
        (0.1, 0.1, 0.1),
        np.abs(points[:, 2] - 1.33 + 0.1 * noise(points, 0.5)) < 0.008,
    )


def skirt(appearance: Appearance, legs: list[Limb], noise: Noise) -> Mesh:
    """A pleated skirt about both thighs."""
    knees = np.stack([leg.joints[1] for leg in legs])
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    g = appearance.girth
    levels = np.linspace(0, 1, 9)
    deep = np.stack(
        [
            0.125 * g + levels**0.8 * (0.05 + np.abs(knees[:, 0]).max()),
            0.165 * g + 0.10 * levels**0.8,
        ],
        1,
    )
    pleat = (
        1
        + 0.05 * levels[:, None] * np.sin(angle * 12)
        + 0.03 * levels[:, None] * np.sin(angle * 5 + 1)
    )
    rings = np.stack(
        [
            deep[:, :1] * pleat * np.cos(angle) - 0.01,
            deep[:, 1:] * pleat * np.sin(angle),
            np.broadcast_to(1.03 - 0.50 * levels[:, None], pleat.shape),
        ],
        -1,
    )
    v, u = np.mgrid[0:1:64j, 0:1:256j]
    points = np.stack(
        [np.cos(2 * np.pi * u) * 0.2, np.sin(2 * np.pi * u) * 0.2, v * 0.5], -1
    ).reshape(-1, 3)
    cloth = np.broadcast_to(appearance.accent, points.shape).astype(np.float32)
    cloth = mix(
        cloth,
        appearance.accent * 0.72,
        0.5 + 0.5 * np.sin(u.ravel() * 24 * np.pi),
    )
    cloth = mix(
        cloth,
        appearance.shirt,
        (
            (np.abs(v.ravel() - 0.08) < 0.03) * 0.8
            if appearance.pattern == "stripes"
            else 0 * u.ravel()
        ),
    )
    cloth = cloth * (1 + 0.08 * noise(points.astype(np.float32), 0.012))[:, None]
    return loft(rings[::-1], np.clip(cloth, 0, 1).reshape(64, 256, 3))


HEIGHT = 1.75  # of the figure before it is scaled, metres
SKIN = (
    (0.93, 0.76, 0.66),
    (0.87, 0.67, 0.54),
    (0.76, 0.56, 0.42),
    (0.58, 0.40, 0.29),
    (0.40, 0.27, 0.20),
)
HAIR = (
    (0.10, 0.08, 0.07),
    (0.22, 0.15, 0.10),
    (0.38, 0.25, 0.14),
    (0.72, 0.56, 0.32),
    (0.52, 0.24, 0.12),
    (0.6,) * 3,
)
CLOTH = (
    (0.75, 0.14, 0.14),
    (0.13, 0.24, 0.52),
    (0.90, 0.89, 0.86),
    (0.15, 0.16, 0.18),
    (0.20, 0.45, 0.28),
    (0.90, 0.72, 0.20),
    (0.48, 0.66, 0.82),
    (0.55, 0.25, 0.48),
    (0.85, 0.45, 0.18),
    (0.52, 0.53, 0.55),
    (0.86, 0.62, 0.66),
    (0.30, 0.52, 0.52),
)
TROUSERS = (
    (0.16, 0.22, 0.36),
    (0.12, 0.12, 0.14),
    (0.33, 0.43, 0.58),
    (0.62, 0.54, 0.40),
    (0.36, 0.36, 0.38),
    (0.36, 0.27, 0.2),
)
SHOES = (
    (0.10, 0.09, 0.09),
    (0.88, 0.87, 0.85),
    (0.36, 0.22, 0.13),
    (0.65, 0.15, 0.15),
    (0.25, 0.27, 0.30),
)
PATTERNS = ("plain", "plain", "stripes", "check", "print", "jacket", "vest")
POSES = ("stand", "walk", "walk", "stride", "wave", "hips", "phone", "open")


def build(seed: int) -> Model:
    """A person facing +x; `seed` picks appearance, proportions and pose."""
    rng = np.random.default_rng([11, seed])
    appearance = _appearance(rng)
    noise = Noise(rng)
    pose = str(rng.choice(POSES))
    arms = _arms(pose, appearance, rng)
    legs = _legs(pose, appearance, rng)
    meshes = [clothed(appearance, arms, legs, noise)]
    turn = rotation("z", rng.uniform(-35, 35)) @ rotation("y", rng.uniform(-6, 14))
    meshes.append(
        transform(head(appearance, noise), translation(0.012, 0, 1.622) @ turn)
    )
    for side, arm in zip((1, -1), arms, strict=True):
        meshes.append(hand(appearance, arm, side))
    if appearance.legs == "skirt":
        meshes.append(skirt(appearance, legs, noise))
    size = (
        float(
            rng.uniform(1.60, 1.74) if appearance.feminine else rng.uniform(1.66, 1.88)
        )
        / HEIGHT
    )
    wide = size * float(rng.uniform(0.95, 1.06))
    return Model(
        "person",
        grounded([transform(mesh, scaling(wide, wide, size)) for mesh in meshes]),
    )


def _pick(
    rng: np.random.Generator, table: Sequence[Sequence[float]], spread: float = 0.04
) -> Floats:
    """A colour near one of a table."""
    row = np.asarray(table[int(rng.integers(len(table)))])
    return np.clip(row + rng.uniform(-spread, spread, 3), 0.03, 0.95).astype(np.float32)


def _appearance(rng: np.random.Generator) -> Appearance:
    feminine = bool(rng.random() < 0.45)
    styles: tuple[str, ...]
    if feminine:
        styles = ("long", "long", "bun", "tail", "short", "curly")
    else:
        styles = ("short", "short", "crop", "bald", "curly")
    cloth = rng.permutation(len(CLOTH))
    return Appearance(
        feminine=feminine,
        girth=float(rng.uniform(0.92, 1.18)),
        skin=_pick(rng, SKIN, 0.02),
        hair=_pick(rng, HAIR, 0.02),
        style=str(rng.choice(styles)),
        pattern=str(rng.choice(PATTERNS)),
        shirt=_pick(rng, [CLOTH[cloth[0]]]),
        accent=_pick(rng, [CLOTH[cloth[1]]]),
        trousers=_pick(rng, TROUSERS),
        shoes=_pick(rng, SHOES),
        legs=str(
            rng.choice(
                ("long", "skirt", "short")
                if feminine
                else ("long", "long", "long", "short")
            )
        ),
        sleeves=str(rng.choice(("long", "short", "short"))),
        hem=float(rng.choice((1.015, 0.94, 0.93, 0.95))),
        beard=0.0 if feminine else float(rng.choice((0.0, 0.0, 0.35, 0.9))),
        cap=str(rng.choice(("none", "none", "none", "none", "cap", "beanie"))),
        backpack=bool(rng.random() < 0.2),
    )


def _swing(forward: float, outward: float, side: int) -> Doubles:
    """The unit vector that points down, turned forward and outward by degrees."""
    f, o = np.radians([forward, outward])
    return np.array([np.sin(f) * np.cos(o), side * np.sin(o), -np.cos(f) * np.cos(o)])


def _arms(pose: str, appearance: Appearance, rng: np.random.Generator) -> list[Limb]:
    """The left and the right arm."""
    gait = float(rng.choice((-1, 1)))
    active = int(rng.choice((-1, 1)))
    limbs = []
    for side in (1, -1):
        swing = {"walk": 24.0, "stride": 36.0}.get(
            pose, 0.0
        ) * gait * side + rng.uniform(-6, 8)
        upper = _swing(swing, rng.uniform(7, 13), side)
        lower = _swing(swing + rng.uniform(10, 28), 3, side)
        if pose == "open":
            upper = _swing(10, rng.uniform(25, 50), side)
            lower = _swing(25, rng.uniform(20, 45), side)
        elif pose == "hips":
            upper = _swing(-22, 46, side)
            lower = _swing(28, -48, side)
        elif pose == "wave" and side == active:
            upper = _swing(20, rng.uniform(95, 125), side)
            lower = _swing(15, rng.uniform(155, 180), side)
        elif pose == "phone" and side == active:
            upper = _swing(42, 16, side)
            lower = _swing(150, -6, side)
        shoulder = np.array(
            [-0.01, side * (0.160 if appearance.feminine else 0.184), 1.415]
        )
        elbow = shoulder + 0.285 * upper
        limbs.append(Limb(np.stack([shoulder, elbow, elbow + 0.25 * lower]), lower))
    return limbs


def _legs(pose: str, appearance: Appearance, rng: np.random.Generator) -> list[Limb]:
    """The left and the right leg; the direction is that of the foot."""
    gait = float(rng.choice((-1, 1)))
    reach = {"walk": 22.0, "stride": 32.0}.get(pose, 0.0) * (
        0.75 if appearance.legs == "skirt" else 1.0
    )
    limbs = []
    for side in (1, -1):
        step = reach * gait * side
        thigh = step + rng.uniform(-2, 3)
        shin = thigh - (6 if step >= 0 else 24) * (reach > 0) - 2
        spread = rng.uniform(1, 3) if reach else rng.uniform(1, 7)
        hip = np.array([0.0, side * 0.092, 0.92])
        knee = hip + 0.425 * _swing(thigh, spread, side)
        ankle = knee + 0.41 * _swing(shin, spread * 0.5, side)
        pitch = np.radians(0 if step > -1 else -28)
        yaw = np.radians(side * rng.uniform(3, 14))
        toe = np.array(
            [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        )
        limbs.append(Limb(np.stack([hip, knee, ankle]), toe))
    return limbs


def _head_layers(appearance: Appearance) -> list[Layer]:
    """Head, hair and cap about the middle of the head; the face looks along +x."""
    head = [
        ellipsoid((-0.008, 0, 0.025), (0.096, 0.074, 0.084)),
        ellipsoid(
            (0.024, 0, -0.042), (0.066, 0.058 if appearance.feminine else 0.062, 0.078)
        ),
        ellipsoid((0.064, 0, -0.098), (0.022, 0.026, 0.020)),
        cone(
            (0.090, 0, 0.004),
            (0.106, 0, -0.030),
            (0.008, 0.014),
        ),
        cone(
            (0.080, -0.030, 0.020),
            (0.080, 0.030, 0.020),
            (0.012, 0.012),
        ),
        cone(
            (0.088, -0.014, -0.066),
            (0.088, 0.014, -0.066),
            (0.008, 0.008),
        ),
        cone(
            (-0.012, 0, -0.08),
            (-0.025, 0, -0.17),
            (0.050, 0.054),
        ),
    ]
    head += [
        ellipsoid((-0.004, s * 0.076, -0.012), (0.020, 0.013, 0.032)) for s in (1, -1)
    ]
    hair = _hair(appearance.style)
    layers = [Layer(tuple(head), 0.02), Layer(tuple(hair), 0.025)]
    crown = ellipsoid((-0.012, 0, 0.062), (0.106, 0.092, 0.074))
    if appearance.cap == "cap":
        layers.append(
            Layer(
                (
                    crown,
                    cone(
                        (0.07, 0, 0.045),
                        (0.135, 0, 0.033),
                        (0.013, 0.012),
                        flat=(0, 4.2, 0),
                    ),
                ),
                0.015,
            )
        )
    elif appearance.cap == "beanie":
        layers.append(
            Layer(
                (
                    crown,
                    ellipsoid((-0.02, 0, 0.078), (0.098, 0.086, 0.075)),
                    ellipsoid((-0.03, 0, 0.158), (0.03,) * 3),
                ),
                0.02,
            )
        )
    return layers


def _hair(style: str) -> list[Blob]:
    """Hair about the middle of the head."""
    back = [
        ellipsoid((-0.020, 0, 0.038), (0.096, 0.083, 0.084)),
        ellipsoid((-0.045, 0, 0), (0.070, 0.080, 0.080)),
    ]
    if style == "crop":
        return [
            ellipsoid((-0.020, 0, 0.036), (0.094, 0.079, 0.081)),
            ellipsoid((-0.04, 0, 0), (0.070, 0.077, 0.07)),
        ]
    if style == "bald":
        return [ellipsoid((-0.048, 0, -0.018), (0.062, 0.078, 0.035))]
    if style == "curly":
        return [
            ellipsoid((-0.03, 0, 0.045), (0.118, 0.118, 0.105)),
            ellipsoid((-0.055, 0, -0.01), (0.08, 0.10, 0.09)),
        ]
    if style == "bun":
        return [*back, ellipsoid((-0.118, 0, 0.065), (0.045, 0.048, 0.045))]
    if style == "tail":
        return back + chain(
            [(-0.10, 0, 0.06), (-0.145, 0, 0.02), (-0.15, 0, -0.16)],
            [0.03, 0.035, 0.016],
        )
    if style == "long":
        fall = [(-0.06, 0, 0.0), (-0.075, 0, -0.12), (-0.08, 0, -0.22)]
        back += chain(fall, [0.07, 0.062, 0.04], flat=(0, 0.4, 0))
        for s in (1, -1):
            lock = [
                (0.02, s * 0.066, 0.06),
                (-0.005, s * 0.085, -0.04),
                (-0.02, s * 0.088, -0.17),
            ]
            back += chain(lock, [0.026, 0.025, 0.018])
    return back


def head(appearance: Appearance, noise: Noise) -> Mesh:
    """The head about its middle, at the origin."""

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        x, y, z = points.T
        side = points * (1, 0, 1) + np.abs(y)[:, None] * (0, 1, 0)
        skin = np.broadcast_to(appearance.skin, points.shape).astype(np.float32)
        skin = mix(
            skin,
            appearance.skin * (1.04, 0.80, 0.78),
            0.45
            * spot(
                side,
                (0.07, 0.04, -0.035),
                (0.04, 0.022, 0.022),
                1.5,
            ),
        )
        skin = mix(
            skin,
            appearance.hair * 0.9,
            appearance.beard
            * spot(
                points,
                (0.05, 0, -0.095),
                (0.09, 0.09, 0.058),
                0.25,
            ),
        )
        lips = appearance.skin * (
            (0.85, 0.45, 0.45) if appearance.feminine else (0.82, 0.58, 0.55)
        )
        skin = mix(
            skin,
            lips,
            spot(
                points,
                (0.09, 0, -0.066),
                (0.03, 0.025, 0.010),
                0.3,
            ),
        )
        skin = mix(
            skin,
            lips * 0.45,
            0.8
            * spot(
                points,
                (0.09, 0, -0.066),
                (0.03, 0.023, 0.0025),
                0.8,
            ),
        )
        skin = mix(
            skin,
            appearance.skin * 0.7,
            0.7 * spot(side, (0.08, 0.032, 0.004), (0.04, 0.024, 0.016), 0.8),
        )
        skin = mix(
            skin,
            (0.93, 0.92, 0.90),
            spot(side, (0.08, 0.032, 0.001), (0.04, 0.018, 0.009), 0.25),
        )
        skin = mix(
            skin,
            (0.10, 0.07, 0.05),
            spot(side, (0.08, 0.031, 0.001), (0.04, 0.009, 0.0095), 0.25),
        )
        skin = mix(
            skin,
            appearance.hair * 0.8,
            spot(side, (0.08, 0.035, 0.0255), (0.04, 0.022, 0.0052), 0.4),
        )
        skin = mix(
            skin,
            appearance.skin * 0.4,
            spot(
                side,
                (0.105, 0.008, -0.042),
                (0.02, 0.005, 0.004),
                0.5,
            ),
        )
        strands = (
            appearance.hair
            * (
                1
                + 0.35 * noise(points, (0.02, 0.006, 0.03))
                + 0.2 * noise(points, 0.006)
            )[:, None]
        )
        cap = (
            appearance.accent
            * (1 - 0.25 * (np.abs(np.sin(np.arctan2(y, x + 0.012) * 3)) < 0.08))[
                :, None
            ]
        )
        band = mix(
            cap,
            appearance.accent * 0.6,
            (z < 0.035) & (appearance.cap == "beanie"),
        )
        return np.where(
            layer[:, None] == 0, skin, np.where(layer[:, None] == 1, strands, band)
        ).astype(np.float32)

    def relief(points: Floats) -> Floats:
        if appearance.style == "curly":
            hairy = np.clip(
                (np.hypot(points[:, 0] + 0.03, points[:, 1]) - 0.08) / 0.02, 0, 1
            )
        else:
            hairy = 0
        bumps: NDArray[np.float32] = 0.008 * noise(points, 0.018) * hairy
        return bumps.astype(np.float32) * (points[:, 0] < 0.06)

    return body(_head_layers(appearance), 0.0085, paint, relief=relief)


def hand(appearance: Appearance, arm: Limb, side: int) -> Mesh:
    """A hand on its wrist, fingers along the forearm, thumb forward."""
    blobs = [
        cone(
            (-0.025, 0, 0),
            (0.075, 0, 0),
            (0.026, 0.024),
            flat=(0, 0, 0.45),
        )
    ]
    for k, length in enumerate((0.165, 0.18, 0.172, 0.15)):
        z = 0.027 - 0.018 * k
        blobs += chain(
            [(0.07, 0, z), (0.12, -0.004, z), (length, -0.018, z)],
            [0.0125, 0.0115, 0.0095],
        )
    blobs += chain(
        [(0.02, 0, 0.03), (0.06, -0.01, 0.055), (0.095, -0.015, 0.058)],
        [0.016, 0.014, 0.011],
    )

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        shade = 1 - 0.12 * (points[:, 1] < -0.005) * 1.0
        return (appearance.skin * shade[:, None]).astype(np.float32)

    mesh = body([Layer(tuple(blobs), 0.012)], 0.0105, paint, texels=2)
    along = arm.end / np.linalg.norm(arm.end)
    hint = np.array([1.0, 0, 0.2]) if abs(along[2]) > 0.7 else np.array([0, 0, 1.0])
    thumb = hint - along * (hint @ along)
    thumb /= np.linalg.norm(thumb)
    frame = np.eye(4)
    frame[:3, :3] = 0.92 * np.stack([along, side * np.cross(thumb, along), thumb], 1)
    frame[:3, 3] = arm.joints[2]
    return transform(mesh, frame)
