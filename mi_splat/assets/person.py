"""A person of 1.5 to 1.95 m: clothes, skin, hair, build and pose vary with the seed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_splat.assets.implicit import Doubles
from mi_splat.assets.mesh import Asset, Floats, rotation, scaling, transform, translation
from mi_splat.assets.organic import Noise, grounded
from mi_splat.assets.person_body import Appearance, Limb, clothed, skirt
from mi_splat.assets.person_head import hand, head

HEIGHT = 1.75  # of the figure before it is scaled, metres
SKIN = ((0.93, 0.76, 0.66), (0.87, 0.67, 0.54), (0.76, 0.56, 0.42), (0.58, 0.40, 0.29), (0.40, 0.27, 0.20))
HAIR = ((0.10, 0.08, 0.07), (0.22, 0.15, 0.10), (0.38, 0.25, 0.14), (0.72, 0.56, 0.32), (0.52, 0.24, 0.12), (0.6,) * 3)
CLOTH = (
    (0.75, 0.14, 0.14), (0.13, 0.24, 0.52), (0.90, 0.89, 0.86), (0.15, 0.16, 0.18), (0.20, 0.45, 0.28),
    (0.90, 0.72, 0.20), (0.48, 0.66, 0.82), (0.55, 0.25, 0.48), (0.85, 0.45, 0.18), (0.52, 0.53, 0.55),
    (0.86, 0.62, 0.66), (0.30, 0.52, 0.52),
)  # fmt: skip
TROUSERS = (
    (0.16, 0.22, 0.36),
    (0.12, 0.12, 0.14),
    (0.33, 0.43, 0.58),
    (0.62, 0.54, 0.40),
    (0.36, 0.36, 0.38),
    (0.36, 0.27, 0.2),
)
SHOES = ((0.10, 0.09, 0.09), (0.88, 0.87, 0.85), (0.36, 0.22, 0.13), (0.65, 0.15, 0.15), (0.25, 0.27, 0.30))
PATTERNS = ("plain", "plain", "stripes", "check", "print", "jacket", "vest")
POSES = ("stand", "walk", "walk", "stride", "wave", "hips", "phone", "open")


def build(seed: int) -> Asset:
    """A person facing +x; `seed` picks appearance, proportions and pose."""
    rng = np.random.default_rng([11, seed])
    appearance = _appearance(rng)
    noise = Noise(rng)
    pose = str(rng.choice(POSES))
    arms, legs = _arms(pose, appearance, rng), _legs(pose, appearance, rng)
    meshes = [clothed(appearance, arms, legs, noise)]
    turn = rotation("z", rng.uniform(-35, 35)) @ rotation("y", rng.uniform(-6, 14))
    meshes.append(transform(head(appearance, noise), translation(0.012, 0, 1.622) @ turn))
    for side, arm in zip((1, -1), arms, strict=True):
        meshes.append(hand(appearance, arm, side))
    if appearance.legs == "skirt":
        meshes.append(skirt(appearance, legs, noise))
    size = float(rng.uniform(1.60, 1.74) if appearance.feminine else rng.uniform(1.66, 1.88)) / HEIGHT
    wide = size * float(rng.uniform(0.95, 1.06))
    return Asset("person", grounded([transform(mesh, scaling(wide, wide, size)) for mesh in meshes]))


def _pick(rng: np.random.Generator, table: Sequence[Sequence[float]], spread: float = 0.04) -> Floats:
    """A colour near one of a table."""
    row = np.asarray(table[int(rng.integers(len(table)))])
    colour: Floats = np.clip(row + rng.uniform(-spread, spread, 3), 0.03, 0.95).astype(np.float32)
    return colour


def _appearance(rng: np.random.Generator) -> Appearance:
    feminine = bool(rng.random() < 0.45)
    styles = (
        ("long", "long", "bun", "tail", "short", "curly") if feminine else ("short", "short", "crop", "bald", "curly")
    )
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
        legs=str(rng.choice(("long", "skirt", "short") if feminine else ("long", "long", "long", "short"))),
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
        swing = {"walk": 24.0, "stride": 36.0}.get(pose, 0.0) * gait * side + rng.uniform(-6, 8)
        upper, lower = _swing(swing, rng.uniform(7, 13), side), _swing(swing + rng.uniform(10, 28), 3, side)
        if pose == "open":
            upper, lower = _swing(10, rng.uniform(25, 50), side), _swing(25, rng.uniform(20, 45), side)
        elif pose == "hips":
            upper, lower = _swing(-22, 46, side), _swing(28, -48, side)
        elif pose == "wave" and side == active:
            upper, lower = _swing(20, rng.uniform(95, 125), side), _swing(15, rng.uniform(155, 180), side)
        elif pose == "phone" and side == active:
            upper, lower = _swing(42, 16, side), _swing(150, -6, side)
        shoulder = np.array([-0.01, side * (0.160 if appearance.feminine else 0.184), 1.415])
        elbow = shoulder + 0.285 * upper
        limbs.append(Limb(np.stack([shoulder, elbow, elbow + 0.25 * lower]), lower))
    return limbs


def _legs(pose: str, appearance: Appearance, rng: np.random.Generator) -> list[Limb]:
    """The left and the right leg; the direction is that of the foot."""
    gait = float(rng.choice((-1, 1)))
    reach = {"walk": 22.0, "stride": 32.0}.get(pose, 0.0) * (0.75 if appearance.legs == "skirt" else 1.0)
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
        toe = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
        limbs.append(Limb(np.stack([hip, knee, ankle]), toe))
    return limbs
