"""An elephant of 2.5 to 3.4 m: build, greys, pose of head, trunk, ears and legs vary
with the seed.
"""

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
    blade,
    body,
    chain,
    cone,
    ellipsoid,
    grounded,
    mix,
    spot,
)
from scenes.recipes.objects.primitives import ellipsoid as ball
from scenes.recipes.objects.primitives import sweep

GREYS = (
    (0.43, 0.42, 0.41),
    (0.48, 0.46, 0.44),
    (0.37, 0.37, 0.38),
    (0.52, 0.50, 0.48),
    (0.46, 0.41, 0.37),
)
CELL = 0.068
# joint about which the head turns, metres, for an elephant of 3 m
HEAD = np.array([1.52, 0.0, 2.38])
DUSTS = ((0.58, 0.47, 0.36), (0.58, 0.38, 0.27), (0.55, 0.52, 0.47))
TRUNKS = {  # pitch of each of the trunk's pieces below the horizontal, degrees
    "down": (42, 62, 76, 84, 88, 92, 88, 72, 45),
    "curl": (42, 62, 76, 84, 96, 112, 140, 170, 200),
    "forward": (42, 58, 62, 52, 40, 28, 14, 0, -20),
    "up": (36, 46, 40, 15, -20, -48, -58, -40, 0),
    "reach": (42, 64, 80, 92, 100, 96, 84, 60, 20),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Appearance:
    """What a seed decides."""

    skin: Floats
    dust: Floats
    dusty: float
    bulk: float
    steps: Doubles
    trunk: str
    ears: float
    big_ears: float
    tusks: float
    turn: float
    nod: float
    tail: float


def build(seed: int) -> Model:
    """An elephant facing +x; `seed` picks size, greys and pose."""
    rng = np.random.default_rng([12, seed])
    appearance = _appearance(rng)
    noise = Noise(rng)
    pose = (
        translation(*HEAD)
        @ rotation("z", appearance.turn)
        @ rotation("y", appearance.nod)
    )
    head = [*_ears(appearance, noise), *_tusks(appearance), *_eyes()]
    meshes = [
        _body(appearance, noise, pose.astype(np.float32)),
        *(transform(mesh, pose) for mesh in head),
        *_tail(appearance),
    ]
    size = float(rng.uniform(2.55, 3.25)) / 3.05
    return Model(
        "elephant",
        grounded([transform(mesh, scaling(size, size, size)) for mesh in meshes]),
    )


def _appearance(rng: np.random.Generator) -> _Appearance:
    grey = np.asarray(GREYS[int(rng.integers(len(GREYS)))]) * rng.uniform(
        0.74, 1.12
    ) + rng.uniform(-0.015, 0.015, 3)
    gait = float(rng.choice((0.0, 9.0, 16.0)))
    african = bool(rng.random() < 0.75)
    return _Appearance(
        skin=grey.astype(np.float32),
        dust=np.asarray(DUSTS[int(rng.integers(len(DUSTS)))], np.float32)
        * np.float32(rng.uniform(0.8, 1.1)),
        dusty=float(rng.uniform(0.5, 1.9)),
        bulk=float(rng.uniform(0.92, 1.06)),
        steps=gait * np.array([1, -1, -0.7, 0.8]) * float(rng.choice((-1, 1)))
        + rng.uniform(-3, 3, 4),
        trunk=str(rng.choice(tuple(TRUNKS))),
        ears=float(rng.uniform(30, 75)),
        big_ears=float(rng.uniform(0.92, 1.08) if african else rng.uniform(0.62, 0.72)),
        tusks=float(rng.choice((0.0, 0.45, 0.7, 0.9, 1.1))),
        turn=float(rng.uniform(-22, 22)),
        nod=float(rng.uniform(-8, 10)),
        tail=float(rng.uniform(-0.3, 0.3)),
    )


def _posed(pose: Floats, points: Doubles) -> Doubles:
    """Points (N, 3) of the head's frame in that of the body."""
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def _legs(appearance: _Appearance) -> tuple[list[Blob], Doubles]:
    """Four legs, and where their feet are (4, 3)."""
    blobs = list[Blob]()
    feet = []
    for number, (x, side) in enumerate(
        ((0.80, 1), (0.80, -1), (-0.92, 1), (-0.92, -1))
    ):
        angle = np.radians(appearance.steps[number])
        forward = np.array([np.sin(angle), 0, -np.cos(angle)])
        bend = 0.5 * max(0.0, -np.sin(angle)) if x > 0 else 0.0
        top = np.array([x, side * 0.36, 1.95])
        knee = top + 0.98 * forward + (0.05, side * 0.03, 0)
        ankle = knee + 0.62 * forward + (-0.04 - bend, 0, 0)
        foot = ankle + np.array((0.05, 0, -0.21))
        thick = (0.36, 0.225, 0.195) if x > 0 else (0.42, 0.235, 0.185)
        blobs += chain([top, knee, ankle, foot], [*thick, 0.195])
        blobs.append(
            cone(
                foot,
                np.add(foot, (0.03, 0, -0.05)),
                (0.20, 0.215),
            )
        )
        feet.append(foot)
    return blobs, np.stack(feet)


def _trunk(appearance: _Appearance) -> tuple[Doubles, list[float]]:
    """Centre line (n, 3) of the trunk in the head's frame, and its radii."""
    pitch = np.radians(TRUNKS[appearance.trunk])
    swing = np.radians(
        np.linspace(0, 30 if appearance.trunk != "up" else 10, len(pitch))
    ) * np.sign(appearance.turn)
    step = (
        np.stack(
            [
                np.cos(pitch) * np.cos(swing),
                np.cos(pitch) * np.sin(swing),
                -np.sin(pitch),
            ],
            1,
        )
        * 0.215
    )
    path = np.concatenate(
        [[(0.42, 0, 0.02)], np.array([(0.42, 0, 0.02)]) + np.cumsum(step, 0)]
    )
    return path, list(
        np.interp(
            np.arange(len(path)), [0, 2, 5, len(path) - 1], [0.27, 0.215, 0.15, 0.095]
        )
    )


def _blobs(
    appearance: _Appearance, pose: Floats
) -> tuple[list[Blob], Doubles, Doubles]:
    """All of the grey body, with the feet and the trunk's centre line (in the frame of
    the body).
    """
    b = appearance.bulk
    turn = pose[:3, :3].T
    legs, feet = _legs(appearance)
    blobs = [
        ellipsoid((-0.05, 0, 2.02), (1.32, 0.70 * b, 0.76 * b)),
        ellipsoid((0.68, 0, 2.18), (0.62, 0.56 * b, 0.72)),
        ellipsoid((-0.92, 0, 2.10), (0.62, 0.60 * b, 0.72)),
        cone(
            (0.8, 0, 2.42),
            pose[:3, 3] - (0.05, 0, 0.02),
            (0.52, 0.36),
        ),
        *legs,
    ]
    parts = [
        ((0.08, 0, 0.20), (0.40, 0.36, 0.46)),
        ((0.28, 0, 0.20), (0.30, 0.27, 0.36)),
        ((0.16, 0, -0.16), (0.36, 0.34, 0.38)),
    ]
    blobs += [
        ellipsoid(
            _posed(pose, np.array([c]))[0],
            r,
            turn,
        )
        for c, r in parts
    ]
    jaw = _posed(pose, np.array([(0.18, 0, -0.38), (0.50, 0, -0.60)]))
    blobs.append(cone(jaw[0], jaw[1], (0.20, 0.09)))
    for side in (1, -1):
        sheath = _posed(
            pose, np.array([(0.38, side * 0.19, -0.18), (0.60, side * 0.235, -0.44)])
        )
        blobs.append(cone(sheath[0], sheath[1], (0.15, 0.10)))
    line, radii = _trunk(appearance)
    line = _posed(pose, line)
    blobs += chain(line, radii)
    return blobs, feet, line


def _body(appearance: _Appearance, noise: Noise, pose: Floats) -> Mesh:
    """The grey body in one piece."""
    blobs, feet, line = _blobs(appearance, pose)
    length = np.arange(len(line)) * 0.215
    fine = np.linspace(0, length[-1], 70)
    centre = np.stack(
        [np.interp(fine, length, line[:, i]) for i in range(3)], 1
    ).astype(np.float32)
    inverse = np.linalg.inv(pose.astype(np.float64)).astype(np.float32)

    def along(points: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Which points belong to the trunk, and how far along it they are, metres."""
        near = np.flatnonzero(
            ((points > line.min(0) - 0.3) & (points < line.max(0) + 0.3)).all(1)
        )
        apart = ((points[near, None] - centre[None]) ** 2).sum(-1)
        best = apart.argmin(1)
        mine = np.sqrt(apart[np.arange(len(near)), best]) < 0.30
        return near[mine], fine[best[mine]].astype(np.float32)

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        head = points @ inverse[:3, :3].T + inverse[:3, 3]
        colours = _hide(appearance, points, noise)
        on, s = along(points)
        rings = np.sin(s * 2 * np.pi / 0.085 + 1.5 * noise(points[on], 0.2)) > 0.45
        colours[on] = mix(
            colours[on],
            appearance.skin * 0.62,
            0.75 * rings * np.clip(s * 2 - 0.4, 0, 1),
        )
        side = head * (1, 0, 1) + np.abs(head[:, 1])[:, None] * (0, 1, 0)
        colours = mix(
            colours,
            appearance.skin * 0.55,
            0.8 * spot(side, (0.33, 0.30, 0.10), (0.11, 0.14, 0.08), 0.7),
        )
        colours = mix(
            colours,
            appearance.skin * 0.45,
            0.7
            * spot(
                side,
                (0.42, 0.12, -0.50),
                (0.2, 0.1, 0.025),
                0.7,
            ),
        )
        low = np.flatnonzero(points[:, 2] < feet[:, 2].max() + 0.05)
        for foot in feet:
            for angle in np.radians((-58, -20, 20, 58)):
                nail = np.add(
                    foot, (0.215 * np.cos(angle) + 0.03, 0.215 * np.sin(angle), -0.15)
                )
                colours[low] = mix(
                    colours[low],
                    (0.76, 0.71, 0.62),
                    spot(points[low], nail, (0.065, 0.065, 0.075), 0.3),
                )
        return colours

    def relief(points: Floats) -> Floats:
        bumps = 0.016 * noise(points, 0.16) + 0.012 * noise(points, (0.10, 0.3, 0.35))
        on, s = along(points)
        bumps[on] += 0.008 * np.sin(s * 2 * np.pi / 0.17)
        result: Floats = bumps * (points[:, 2] > feet[:, 2].min() - 0.1)
        return result

    return body(
        [Layer(tuple(blobs), 0.16)],
        CELL,
        paint,
        relief=relief,
        texels=4,
    )


def _hide(appearance: _Appearance, points: Floats, noise: Noise) -> Floats:
    """Grey, wrinkled, dusty skin (N, 3)."""
    z = points[:, 2]
    broad = noise(points, 0.55)
    middle = noise(points, (0.16, 0.16, 0.07))
    colours = (appearance.skin * (1 + 0.11 * broad + 0.10 * middle)[:, None]).astype(
        np.float32
    )
    patches = (
        np.clip(broad + 0.2, 0, 1)
        + np.clip((z - 2.5) * 1.5, 0, 1)
        + 1.4 * np.clip((0.55 - z) * 2, 0, 1)
    )
    colours = mix(colours, appearance.dust, 0.22 * appearance.dusty * patches)
    wrinkles = np.abs(noise(points + 3.1, (0.14, 0.14, 0.055))) < 0.12
    return mix(colours, appearance.skin * 0.6, 0.38 * wrinkles)


def _ears(appearance: _Appearance, noise: Noise) -> list[Mesh]:
    """Two large thin ears in the frame of the head."""
    t = np.linspace(0, 1, 15)[:, None]
    u = np.linspace(0, 1, 13)[None]
    width = (
        1.12
        * appearance.big_ears
        * np.clip(np.sin(np.pi * np.clip(t, 0.015, 0.985) ** 0.85), 0, 1) ** 0.55
        * (0.5 + 0.5 * t)
    )
    drop = np.radians(appearance.ears)
    out = width * u
    height = (
        0.38
        - 0.98 * (1 - t) ** 1.1 * appearance.big_ears**0.5
        + out * (0.38 * t - 0.30)
    )
    ripple = 0.07 * np.sin(3.0 * t + 5.0 * u) * u + 0.10 * u**2
    x = -0.08 + 0.10 * (1 - t) - out * np.cos(drop) + ripple * np.sin(drop)
    y = 0.31 + out * np.sin(drop) + ripple * np.cos(drop)
    texture = _ear_texture(appearance, noise)
    meshes = []
    for side in (1, -1):
        grid = np.stack([x, side * y, np.broadcast_to(height, x.shape)], -1)
        meshes.append(
            blade(
                grid if side > 0 else grid[:, ::-1],
                0.075,
                texture if side > 0 else texture[:, ::-1],
            )
        )
    return meshes


def _ear_texture(appearance: _Appearance, noise: Noise) -> Floats:
    """Veins, freckles and a ragged pale rim; u runs outward."""
    v, u = np.mgrid[1:0:112j, 0:1:112j].astype(np.float32)
    points = np.stack([u.ravel(), v.ravel(), 0 * u.ravel() + 7], 1)
    colours = _hide(appearance, (points * 0.9).astype(np.float32), noise)
    pink = np.array((0.70, 0.52, 0.46), np.float32)
    colours = mix(
        colours,
        pink,
        0.55 * np.clip(points[:, 0] * 1.5 - 0.75 + 0.35 * noise(points, 0.08), 0, 1),
    )
    angle = np.arctan2(points[:, 1] - 0.55, points[:, 0] + 0.12) + 0.22 * noise(
        points, 0.13
    )
    veins = np.abs(np.sin(angle * 7)) < 0.10 * (1.15 - points[:, 0])
    colours = mix(colours, appearance.skin * 0.55, 0.7 * veins)
    colours *= np.clip(1.15 - 0.55 * (1 - points[:, 0]) ** 2, 0, 1)[:, None]
    return np.clip(colours, 0, 1).reshape(112, 112, 3)


def _tusks(appearance: _Appearance) -> list[Mesh]:
    """Two tusks in the frame of the head, or none."""
    if not appearance.tusks:
        return []
    s = np.linspace(0, 1, 9)
    shade = np.linspace(0.75, 1, 16)[::-1, None, None]
    ivory = (np.array((0.93, 0.88, 0.76)) * shade[::-1]).astype(np.float32)
    meshes = []
    for side in (1, -1):
        pitch = np.radians(np.linspace(-52, 12 + 20 * appearance.tusks, 9))
        step = np.stack(
            [np.cos(pitch), side * 0.20 * (1 - 1.3 * s), np.sin(pitch)], 1
        ) * (appearance.tusks / 8)
        path = np.array([0.56, side * 0.23, -0.40]) + np.cumsum(step, 0)
        radii = (
            0.082 * np.sqrt(np.maximum(1 - s, 0.03)) * (0.75 + 0.25 * appearance.tusks)
        )
        meshes.append(
            sweep(
                path,
                radii,
                np.broadcast_to(ivory, (16, 4, 3)),
                segments=12,
                roughness=0.3,
            )
        )
    return meshes


def _eyes() -> list[Mesh]:
    """Two dark, shiny eyes in the frame of the head."""
    colour = (0.06, 0.04, 0.03)
    size = (0.06, 0.05, 0.05)
    return [
        ball(
            size, colour, centre=(0.350, side * 0.332, 0.10), segments=10, roughness=0.1
        )
        for side in (1, -1)
    ]


def _tail(appearance: _Appearance) -> list[Mesh]:
    """A tail with a dark tuft."""
    s = np.linspace(0, 1, 10)
    path = np.stack(
        [-1.46 - 0.16 * np.sin(s * 2.2), appearance.tail * s**2, 2.35 - 1.2 * s], 1
    )
    tuft = np.stack(
        [
            path[-1] + (0, 0.05 * appearance.tail * k, 0.06 - 0.36 * k)
            for k in np.linspace(0, 1, 5)
        ]
    )
    return [
        sweep(
            path,
            np.interp(s, [0, 0.3, 1], [0.10, 0.055, 0.032]),
            appearance.skin * 0.8,
            segments=10,
        ),
        sweep(
            tuft,
            [0.03, 0.055, 0.06, 0.045, 0.008],
            (0.09, 0.08, 0.08),
            segments=8,
        ),
    ]
