"""A person of 1.5 to 1.95 m: clothes, skin, hair, build and pose vary with the seed."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.implicit import Blob, Doubles, Layer, chain, cone, ellipsoid
from mi_splat.assets.mesh import Asset, Floats, Mesh, rotation, scaling, transform, translation
from mi_splat.assets.organic import Noise, body, grounded, mix, spot
from mi_splat.assets.person_body import Appearance, Limb, clothed, skirt

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


def _head_layers(appearance: Appearance) -> list[Layer]:
    """Head, hair and cap about the middle of the head; the face looks along +x."""
    head = [
        ellipsoid((-0.008, 0, 0.025), (0.096, 0.074, 0.084)),
        ellipsoid((0.024, 0, -0.042), (0.066, 0.058 if appearance.feminine else 0.062, 0.078)),
        ellipsoid((0.064, 0, -0.098), (0.022, 0.026, 0.020)),
        cone((0.090, 0, 0.004), (0.106, 0, -0.030), (0.008, 0.014)),
        cone((0.080, -0.030, 0.020), (0.080, 0.030, 0.020), (0.012, 0.012)),
        cone((0.088, -0.014, -0.066), (0.088, 0.014, -0.066), (0.008, 0.008)),
        cone((-0.012, 0, -0.08), (-0.025, 0, -0.17), (0.050, 0.054)),
    ]
    head += [ellipsoid((-0.004, s * 0.076, -0.012), (0.020, 0.013, 0.032)) for s in (1, -1)]
    hair = _hair(appearance.style)
    layers = [Layer(tuple(head), 0.02), Layer(tuple(hair), 0.025)]
    crown = ellipsoid((-0.012, 0, 0.062), (0.106, 0.092, 0.074))
    if appearance.cap == "cap":
        layers.append(
            Layer((crown, cone((0.07, 0, 0.045), (0.135, 0, 0.033), (0.013, 0.012), flat=(0, 4.2, 0))), 0.015)
        )
    elif appearance.cap == "beanie":
        layers.append(
            Layer(
                (crown, ellipsoid((-0.02, 0, 0.078), (0.098, 0.086, 0.075)), ellipsoid((-0.03, 0, 0.158), (0.03,) * 3)),
                0.02,
            )
        )
    return layers


def _hair(style: str) -> list[Blob]:
    """Hair about the middle of the head."""
    back = [ellipsoid((-0.020, 0, 0.038), (0.096, 0.083, 0.084)), ellipsoid((-0.045, 0, 0), (0.070, 0.080, 0.080))]
    if style == "crop":
        return [ellipsoid((-0.020, 0, 0.036), (0.094, 0.079, 0.081)), ellipsoid((-0.04, 0, 0), (0.070, 0.077, 0.07))]
    if style == "bald":
        return [ellipsoid((-0.048, 0, -0.018), (0.062, 0.078, 0.035))]
    if style == "curly":
        return [ellipsoid((-0.03, 0, 0.045), (0.118, 0.118, 0.105)), ellipsoid((-0.055, 0, -0.01), (0.08, 0.10, 0.09))]
    if style == "bun":
        return [*back, ellipsoid((-0.118, 0, 0.065), (0.045, 0.048, 0.045))]
    if style == "tail":
        return back + chain([(-0.10, 0, 0.06), (-0.145, 0, 0.02), (-0.15, 0, -0.16)], [0.03, 0.035, 0.016])
    if style == "long":
        fall = [(-0.06, 0, 0.0), (-0.075, 0, -0.12), (-0.08, 0, -0.22)]
        back += chain(fall, [0.07, 0.062, 0.04], flat=(0, 0.4, 0))
        for s in (1, -1):
            lock = [(0.02, s * 0.066, 0.06), (-0.005, s * 0.085, -0.04), (-0.02, s * 0.088, -0.17)]
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
            0.45 * spot(side, (0.07, 0.04, -0.035), (0.04, 0.022, 0.022), 1.5),
        )
        skin = mix(
            skin, appearance.hair * 0.9, appearance.beard * spot(points, (0.05, 0, -0.095), (0.09, 0.09, 0.058), 0.25)
        )
        lips = appearance.skin * ((0.85, 0.45, 0.45) if appearance.feminine else (0.82, 0.58, 0.55))
        skin = mix(skin, lips, spot(points, (0.09, 0, -0.066), (0.03, 0.025, 0.010), 0.3))
        skin = mix(skin, lips * 0.45, 0.8 * spot(points, (0.09, 0, -0.066), (0.03, 0.023, 0.0025), 0.8))
        skin = mix(skin, appearance.skin * 0.7, 0.7 * spot(side, (0.08, 0.032, 0.004), (0.04, 0.024, 0.016), 0.8))
        skin = mix(skin, (0.93, 0.92, 0.90), spot(side, (0.08, 0.032, 0.001), (0.04, 0.018, 0.009), 0.25))
        skin = mix(skin, (0.10, 0.07, 0.05), spot(side, (0.08, 0.031, 0.001), (0.04, 0.009, 0.0095), 0.25))
        skin = mix(skin, appearance.hair * 0.8, spot(side, (0.08, 0.035, 0.0255), (0.04, 0.022, 0.0052), 0.4))
        skin = mix(skin, appearance.skin * 0.4, spot(side, (0.105, 0.008, -0.042), (0.02, 0.005, 0.004), 0.5))
        strands = (
            appearance.hair * (1 + 0.35 * noise(points, (0.02, 0.006, 0.03)) + 0.2 * noise(points, 0.006))[:, None]
        )
        cap = appearance.accent * (1 - 0.25 * (np.abs(np.sin(np.arctan2(y, x + 0.012) * 3)) < 0.08))[:, None]
        band = mix(cap, appearance.accent * 0.6, (z < 0.035) & (appearance.cap == "beanie"))
        return np.where(layer[:, None] == 0, skin, np.where(layer[:, None] == 1, strands, band)).astype(np.float32)

    def relief(points: Floats) -> Floats:
        hairy = (
            np.clip((np.hypot(points[:, 0] + 0.03, points[:, 1]) - 0.08) / 0.02, 0, 1)
            if appearance.style == "curly"
            else 0
        )
        bumps: Floats = (0.008 * noise(points, 0.018) * hairy).astype(np.float32) * (points[:, 0] < 0.06)
        return bumps

    return body(_head_layers(appearance), 0.0085, paint, relief=relief)


def hand(appearance: Appearance, arm: Limb, side: int) -> Mesh:
    """A hand on its wrist, fingers along the forearm, thumb forward."""
    blobs = [cone((-0.025, 0, 0), (0.075, 0, 0), (0.026, 0.024), flat=(0, 0, 0.45))]
    for k, length in enumerate((0.165, 0.18, 0.172, 0.15)):
        z = 0.027 - 0.018 * k
        blobs += chain([(0.07, 0, z), (0.12, -0.004, z), (length, -0.018, z)], [0.0125, 0.0115, 0.0095])
    blobs += chain([(0.02, 0, 0.03), (0.06, -0.01, 0.055), (0.095, -0.015, 0.058)], [0.016, 0.014, 0.011])

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        shade = 1 - 0.12 * (points[:, 1] < -0.005) * 1.0
        colours: Floats = (appearance.skin * shade[:, None]).astype(np.float32)
        return colours

    mesh = body([Layer(tuple(blobs), 0.012)], 0.0105, paint, texels=2)
    along = arm.end / np.linalg.norm(arm.end)
    hint = np.array([1.0, 0, 0.2]) if abs(along[2]) > 0.7 else np.array([0, 0, 1.0])
    thumb = hint - along * (hint @ along)
    thumb /= np.linalg.norm(thumb)
    frame = np.eye(4)
    frame[:3, :3] = 0.92 * np.stack([along, side * np.cross(thumb, along), thumb], 1)
    frame[:3, 3] = arm.joints[2]
    return transform(mesh, frame)
