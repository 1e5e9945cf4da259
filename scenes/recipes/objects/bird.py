"""A standing bird of 0.2 to 0.5 m: crow, robin, pigeon, parrot, gull and others; pose
and wings vary with the seed.
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
    Layer,
    Noise,
    blade,
    body,
    cone,
    ellipsoid,
    grounded,
    mix,
    spot,
)
from scenes.recipes.objects.primitives import ellipsoid as ball
from scenes.recipes.objects.primitives import sweep

Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Species:
    """Shape and plumage of a kind of bird.

    `length` runs from beak to tail, smallest and largest, metres; the other lengths are
    for a figure of about 0.3 m that is scaled to it. `tilt` is in degrees.
    """

    length: tuple[float, float]
    tilt: float
    back: Colour
    wing: Colour
    flight: Colour
    breast: Colour
    belly: Colour
    head: Colour
    bill: Colour
    legs: Colour
    eye: Colour = (0.05, 0.04, 0.03)
    plump: float = 1.0
    skull: float = 0.030
    beak: tuple[float, float] = (0.034, 0.0085)
    hook: float = 0.15
    tail: tuple[float, float] = (0.115, 0.030)
    leg: float = 0.050
    marks: tuple[str, ...] = ()
    roughness: float | None = None


SPECIES = {
    "crow": Species(
        length=(0.42, 0.50),
        tilt=24,
        back=(0.09, 0.09, 0.11),
        wing=(0.08, 0.09, 0.13),
        flight=(0.05, 0.05, 0.07),
        breast=(0.10, 0.10, 0.12),
        belly=(0.08, 0.08, 0.09),
        head=(0.08, 0.08, 0.10),
        bill=(0.07, 0.07, 0.08),
        legs=(0.08, 0.08, 0.08),
        beak=(0.045, 0.0115),
        roughness=0.38,
    ),
    "robin": Species(
        length=(0.21, 0.27),
        tilt=38,
        back=(0.40, 0.36, 0.33),
        wing=(0.37, 0.33, 0.30),
        flight=(0.25, 0.22, 0.20),
        breast=(0.82, 0.36, 0.12),
        belly=(0.84, 0.42, 0.18),
        head=(0.18, 0.17, 0.17),
        bill=(0.86, 0.66, 0.18),
        legs=(0.36, 0.26, 0.18),
        plump=1.1,
        beak=(0.030, 0.0070),
        leg=0.052,
        marks=("ring", "vent"),
    ),
    "redbreast": Species(
        length=(0.20, 0.24),
        tilt=42,
        back=(0.46, 0.38, 0.27),
        wing=(0.44, 0.35, 0.25),
        flight=(0.32, 0.25, 0.18),
        breast=(0.86, 0.40, 0.14),
        belly=(0.90, 0.87, 0.82),
        head=(0.46, 0.38, 0.27),
        bill=(0.15, 0.12, 0.10),
        legs=(0.42, 0.28, 0.2),
        plump=1.25,
        skull=0.034,
        beak=(0.022, 0.0055),
        leg=0.058,
        marks=("face",),
    ),
    "pigeon": Species(
        length=(0.30, 0.36),
        tilt=20,
        back=(0.55, 0.57, 0.62),
        wing=(0.64, 0.66, 0.70),
        flight=(0.38, 0.40, 0.45),
        breast=(0.52, 0.46, 0.55),
        belly=(0.60, 0.62, 0.66),
        head=(0.34, 0.37, 0.43),
        bill=(0.24, 0.22, 0.22),
        legs=(0.80, 0.36, 0.34),
        eye=(0.85, 0.36, 0.10),
        plump=1.2,
        skull=0.026,
        beak=(0.026, 0.0065),
        leg=0.040,
        marks=("bars", "sheen", "cere"),
    ),
    "parrot": Species(
        length=(0.32, 0.40),
        tilt=44,
        back=(0.20, 0.60, 0.20),
        wing=(0.16, 0.54, 0.20),
        flight=(0.14, 0.30, 0.60),
        breast=(0.42, 0.72, 0.26),
        belly=(0.50, 0.74, 0.28),
        head=(0.26, 0.66, 0.22),
        bill=(0.88, 0.82, 0.70),
        legs=(0.50, 0.48, 0.46),
        eye=(0.85, 0.48, 0.12),
        plump=1.1,
        skull=0.037,
        beak=(0.032, 0.0155),
        hook=0.95,
        tail=(0.105, 0.030),
        leg=0.034,
        marks=("crown", "red tail"),
    ),
    "macaw": Species(
        length=(0.44, 0.50),
        tilt=40,
        back=(0.80, 0.12, 0.10),
        wing=(0.80, 0.14, 0.10),
        flight=(0.12, 0.28, 0.72),
        breast=(0.82, 0.13, 0.10),
        belly=(0.80, 0.12, 0.10),
        head=(0.84, 0.14, 0.11),
        bill=(0.90, 0.86, 0.76),
        legs=(0.34, 0.33, 0.33),
        eye=(0.90, 0.85, 0.55),
        skull=0.037,
        beak=(0.036, 0.0175),
        hook=0.95,
        tail=(0.185, 0.022),
        leg=0.046,
        marks=("yellow", "cheek"),
    ),
    "gull": Species(
        length=(0.42, 0.50),
        tilt=14,
        back=(0.62, 0.66, 0.70),
        wing=(0.62, 0.66, 0.71),
        flight=(0.10, 0.10, 0.11),
        breast=(0.94, 0.94, 0.93),
        belly=(0.93, 0.93, 0.92),
        head=(0.95, 0.95, 0.94),
        bill=(0.93, 0.72, 0.12),
        legs=(0.90, 0.60, 0.45),
        eye=(0.80, 0.74, 0.35),
        beak=(0.042, 0.0095),
        hook=0.35,
        tail=(0.092, 0.030),
        leg=0.056,
        marks=("tips", "white tail", "red spot"),
    ),
    "bluebird": Species(
        length=(0.22, 0.29),
        tilt=34,
        back=(0.24, 0.42, 0.76),
        wing=(0.20, 0.40, 0.78),
        flight=(0.12, 0.20, 0.40),
        breast=(0.80, 0.80, 0.82),
        belly=(0.90, 0.90, 0.90),
        head=(0.28, 0.46, 0.80),
        bill=(0.10, 0.10, 0.10),
        legs=(0.14, 0.13, 0.13),
        skull=0.033,
        beak=(0.028, 0.0075),
        marks=("collar", "white bars"),
    ),
}


def _scales(points: Floats, size: float) -> Floats:
    """(N,) edges of overlapping feathers, 1 at an edge; rows run along -x."""
    x, y, z = points.T
    around = np.arctan2(y, z) * 0.045
    row = np.floor(x / size)
    lane = np.mod(around / (0.9 * size) + 0.5 * np.mod(row, 2), 1) - 0.5
    depth = np.mod(x / size, 1)
    edge: Floats = (depth < 0.16 + 1.6 * lane**2).astype(np.float32)
    return edge


def plumage(kind: Species, tint: float, points: Floats, noise: Noise) -> Floats:
    """Colours (N, 3) of back, breast and belly."""
    x, y, z = points.T
    wobble = 0.006 * noise(points, 0.014)
    colours = np.broadcast_to(np.asarray(kind.back, np.float32), points.shape).astype(
        np.float32
    )
    colours = mix(colours, kind.belly, (0.002 - z + wobble) / 0.012)
    colours = mix(
        colours,
        kind.breast,
        np.clip((x - 0.9 * z - 0.012 + wobble) / 0.014, 0, 1) * (z < 0.060),
    )
    if "vent" in kind.marks:
        colours = mix(
            colours,
            (0.9, 0.9, 0.88),
            (-x - 0.035 - 0.5 * z) / 0.01 * (z < 0),
        )
    if "sheen" in kind.marks:
        neck = spot(points, (0.066, 0, 0.024), (0.030, 0.06, 0.028), 0.5)
        hue = np.sin(y * 90 + z * 160 + 4 * noise(points, 0.03))[:, None]
        colours = mix(
            colours,
            np.where(hue > 0, (0.16, 0.46, 0.36), (0.46, 0.22, 0.48)),
            0.8 * neck,
        )
    if "collar" in kind.marks:
        colours = mix(
            colours,
            (0.08, 0.09, 0.14),
            0.9 * (np.abs(x + 0.7 * z - 0.082) < 0.006) * (x > 0.03),
        )
    shade = 1 - 0.14 * _scales(points, 0.0085) * (x < 0.075)
    result: Floats = colours * shade[:, None] * tint
    return result


def face(
    kind: Species, tint: float, colours: Floats, points: Floats, noise: Noise
) -> Floats:
    """The colours with the head painted over."""
    s = kind.skull
    side = points * np.array((1, 0, 1), np.float32) + np.abs(points[:, 1])[
        :, None
    ] * np.array((0, 1, 0), np.float32)
    reach = spot(
        points + 0.004 * noise(points, 0.01)[:, None],
        (0, 0, 0.1 * s),
        (1.35 * s, 1.3 * s, 1.3 * s),
        0.15,
    )
    colours = mix(colours, np.asarray(kind.head) * tint, reach)
    eye = (0.42 * s, 0.86 * s, 0.22 * s)
    if "ring" in kind.marks:
        colours = mix(
            colours,
            (0.92, 0.92, 0.9),
            spot(side, eye, (0.31 * s,) * 3, 0.2),
        )
    if "face" in kind.marks:
        mask = spot(
            points,
            (0.95 * s, 0, -0.35 * s),
            (0.95 * s, 1.1 * s, 0.95 * s),
            0.15,
        )
        colours = mix(colours, kind.breast, mask)
    if "cheek" in kind.marks:
        bare = spot(
            side,
            (0.55 * s, 0.85 * s, -0.02 * s),
            (0.48 * s, 0.5 * s, 0.42 * s),
            0.25,
        )
        colours = mix(colours, (0.93, 0.91, 0.88), bare)
    if "crown" in kind.marks:
        crown = spot(
            points,
            (0.75 * s, 0, 0.7 * s),
            (0.65 * s, 0.75 * s, 0.5 * s),
            0.3,
        )
        colours = mix(colours, (0.92, 0.80, 0.18), crown)
    if "cere" in kind.marks:
        colours = mix(
            colours,
            (0.9, 0.88, 0.86),
            spot(
                points,
                (1.08 * s, 0, 0.05 * s),
                (0.3 * s,) * 3,
                0.2,
            ),
        )
    if "collar" in kind.marks:
        colours = mix(
            colours,
            (0.92, 0.92, 0.93),
            spot(
                side,
                (0.6 * s, 0.8 * s, -0.2 * s),
                (0.6 * s,) * 3,
                0.3,
            ),
        )
    return mix(
        colours,
        (0.04, 0.04, 0.04),
        0.75 * spot(side, eye, (0.25 * s,) * 3, 0.3),
    )


def wing(
    kind: Species,
    tint: float,
    span: Floats,
    chord: Floats,
    points: Floats,
    noise: Noise,
) -> Floats:
    """Colours (N, 3) of a wing."""
    base = np.broadcast_to(np.asarray(kind.wing, np.float32), (len(span), 3)).astype(
        np.float32
    )
    flight = np.clip((span - 0.50 + 0.25 * (0.5 - chord)) / 0.04, 0, 1)
    colours = mix(base, kind.flight, flight)
    if "yellow" in kind.marks:
        colours = mix(
            base,
            (0.95, 0.78, 0.12),
            (span - 0.26 + 0.15 * (0.5 - chord)) / 0.03,
        )
        colours = mix(
            colours,
            kind.flight,
            (span - 0.46 + 0.15 * (0.5 - chord)) / 0.03,
        )
    if "bars" in kind.marks:
        for at in (0.48, 0.66):
            bar = (np.abs(span - at - 0.12 * (chord - 0.5)) < 0.038) & (chord < 0.9)
            colours = mix(
                mix(colours, kind.wing, (span < 0.74) * 0.7),
                (0.13, 0.13, 0.15),
                bar,
            )
    if "tips" in kind.marks:
        colours = mix(base, kind.flight, (span - 0.76) / 0.02)
        colours = mix(
            colours,
            (0.95, 0.95, 0.95),
            (np.abs(span - 0.90) < 0.02) | (np.abs(span - 0.725) < 0.018),
        )
    if "white bars" in kind.marks:
        colours = mix(
            colours,
            (0.92, 0.92, 0.92),
            np.abs(span - 0.45) < 0.022,
        )
        colours = mix(
            colours,
            (0.08, 0.09, 0.12),
            (np.mod(span * 16, 1) < 0.25) * (span > 0.5),
        )
    quills = np.mod(chord * 9 + span * 3 + 0.25 * noise(points, 0.02), 1) < 0.18
    edges = np.where(span > 0.42, quills, _scales(points, 0.0095) > 0)
    return (colours * (1 - 0.24 * edges)[:, None] * tint).astype(np.float32)


CELL = 0.0040


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Bird:
    """What a seed decides."""

    kind: Species
    tint: float
    tilt: float
    head: Floats
    wings: str
    sweep: float
    lift: float
    fan: float
    stride: float


def build(seed: int) -> Model:
    """A bird facing +x; `seed` picks the species, its size and its pose."""
    rng = np.random.default_rng([13, seed])
    bird = _bird(rng)
    noise = Noise(rng)
    tilt = rotation("y", -bird.tilt)
    trunk = [_trunk(bird, noise), _tail(bird)]
    trunk += [transform(mesh, bird.head) for mesh in (*_beak(bird), *_eyes(bird))]
    reach = float(np.ptp(np.concatenate([mesh.vertices[:, 0] for mesh in trunk])))
    trunk += _spread(bird, noise) if bird.wings == "spread" else []
    meshes = [transform(mesh, tilt) for mesh in trunk] + _legs(bird, tilt)
    size = float(rng.uniform(*bird.kind.length)) / reach
    return Model(
        "bird",
        grounded([transform(mesh, scaling(size, size, size)) for mesh in meshes]),
    )


def _bird(rng: np.random.Generator) -> _Bird:
    kind = SPECIES[str(rng.choice(tuple(SPECIES)))]
    tilt = kind.tilt + float(rng.uniform(-8, 8))
    low = bool(rng.random() < 0.2)
    if low:
        head_at = (0.098, 0.022)
    else:
        head_at = (0.084, 0.046 + float(rng.uniform(-0.004, 0.008)))
    turn = float(rng.choice((-1, 1)) * rng.uniform(0, 50))
    nod = 32.0 if low else float(rng.uniform(-6, 12))
    head = (
        translation(head_at[0], 0, head_at[1])
        @ rotation("y", tilt)
        @ rotation("z", turn)
        @ rotation("y", nod)
    )
    wings = "spread" if rng.random() < 0.3 else "folded"
    return _Bird(
        kind=kind,
        tint=float(rng.uniform(0.88, 1.12)),
        tilt=tilt,
        head=head.astype(np.float32),
        wings=wings,
        sweep=float(rng.uniform(0, 50)),
        lift=float(rng.uniform(5, 45)),
        fan=float(
            rng.uniform(0.95, 1.4) if wings == "folded" else rng.uniform(1.3, 2.0)
        ),
        stride=float(rng.uniform(-0.018, 0.018)),
    )


def _layers(bird: _Bird) -> list[Layer]:
    """Body with head, and folded wings unless they are spread; the body's axis lies
    along x.
    """
    kind, plump = bird.kind, bird.kind.plump
    head = bird.head[:3, 3].astype(np.float64)
    blobs: list[Blob] = [
        ellipsoid((-0.004, 0, 0), (0.084, 0.042 * plump, 0.044 * plump)),
        ellipsoid((0.034, 0, -0.006), (0.050, 0.042 * plump, 0.044 * plump)),
        cone(
            (-0.04, 0, 0.006),
            (-0.105, 0, 0.008),
            (0.030, 0.0095),
            flat=(0, 0.5, 0),
        ),
        cone(
            (0.045, 0, 0.014),
            head * (0.96, 1, 0.92),
            (0.036 * plump, 0.92 * kind.skull),
        ),
        ellipsoid(
            head,
            np.array((1.10, 0.94, 1.0)) * kind.skull,
            bird.head[:3, :3].T,
        ),
        cone(
            (-0.004, 0.020, -0.030),
            (-0.010, 0.021, -0.052),
            (0.020, 0.011),
        ),
        cone(
            (-0.004, -0.020, -0.030),
            (-0.010, -0.021, -0.052),
            (0.020, 0.011),
        ),
    ]
    layers = [Layer(tuple(blobs), 0.022)]
    if bird.wings == "folded":
        wings = []
        for side in (1, -1):
            yaw = np.radians(10) * side
            along = np.array([np.cos(yaw), np.sin(yaw), 0.06])
            along /= np.linalg.norm(along)
            outward = np.array([0.0, side, 0.28])
            outward -= along * (outward @ along)
            outward /= np.linalg.norm(outward)
            frame = np.stack([along, outward, np.cross(along, outward)])
            wings.append(
                ellipsoid(
                    (-0.014, side * 0.0355 * plump, 0.008),
                    (0.080, 0.0165, 0.036 * plump),
                    frame,
                )
            )
            tip = (-0.118, side * 0.014, 0.014)
            wings.append(
                cone(
                    (-0.03, side * 0.032 * plump, 0.010),
                    tip,
                    (0.016, 0.0062),
                    flat=(0, 0, 0.9),
                )
            )
        layers.append(Layer(tuple(wings), 0.012))
    return layers


def _trunk(bird: _Bird, noise: Noise) -> Mesh:
    """Body, head and folded wings."""
    inverse = np.linalg.inv(bird.head.astype(np.float64)).astype(np.float32)

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        colours = plumage(bird.kind, bird.tint, points, noise)
        colours = face(
            bird.kind,
            bird.tint,
            colours,
            points @ inverse[:3, :3].T + inverse[:3, 3],
            noise,
        )
        folded = np.flatnonzero(layer == 1)
        on_wing = points[folded]
        # from the shoulder to the tip
        span = np.clip((0.066 - on_wing[:, 0]) / 0.18, 0, 1)
        chord = np.clip((on_wing[:, 2] + 0.03) / 0.07, 0, 1)
        colours[folded] = wing(bird.kind, bird.tint, span, chord, on_wing, noise)
        return colours * (1 + 0.08 * noise(points, (0.012, 0.003, 0.003)))[:, None]

    def relief(points: Floats) -> Floats:
        return 0.0011 * noise(points, (0.016, 0.008, 0.008))

    return body(
        _layers(bird), CELL, paint, relief=relief, roughness=bird.kind.roughness
    )


def _spread(bird: _Bird, noise: Noise) -> list[Mesh]:
    """Two open wings, from half to fully stretched."""
    u = np.linspace(0, 1, 25)[None]
    v = np.linspace(0, 1, 9)[:, None]
    reach = 0.235
    chord = 0.100 * (1 - 0.25 * u) * np.clip(1 - u**3.2, 0.03, 1) ** 0.6
    chord = chord * (1 - 0.16 * np.mod(np.clip(u - 0.5, 0, 1) * 12, 1))
    lead = 0.022 * np.sin(np.pi * np.clip(u * 1.25, 0, 1)) - 0.055 * u**2
    x = lead + chord * (v - 1) - 0.02 * u**3
    y = reach * u + 0 * v
    z = 0.016 * np.sin(np.pi * v) * (1 - u) + 0.020 * np.sin(np.pi * u)
    sweep_back = np.radians(bird.sweep)
    lift = np.radians(bird.lift)
    x, y = (
        x * np.cos(sweep_back) - y * np.sin(sweep_back),
        y * np.cos(sweep_back) + x * np.sin(sweep_back),
    )
    y, z = y * np.cos(lift) - z * np.sin(lift), z * np.cos(lift) + y * np.sin(lift)
    vv, uu = np.mgrid[1:0:80j, 0:1:160j].astype(np.float32)
    wing_points = np.stack(
        [0.2 - 0.2 * vv.ravel(), 0.1 * uu.ravel(), 0 * uu.ravel() + 0.08], 1
    )
    texture = wing(
        bird.kind, bird.tint, uu.ravel() * 0.98, vv.ravel(), wing_points, noise
    )
    texture = np.clip(
        mix(
            texture,
            np.asarray(bird.kind.flight),
            (0.35 - vv.ravel()) * 3,
        ),
        0,
        1,
    ).reshape(80, 160, 3)
    meshes = []
    for side in (1, -1):
        grid = np.stack(
            [x + 0.052, side * (y + 0.030 * bird.kind.plump), z + 0.024], -1
        )
        flip = side > 0
        meshes.append(
            blade(
                grid[:, ::-1] if flip else grid,
                0.007,
                texture[:, ::-1] if flip else texture,
            )
        )
    return meshes


def _tail(bird: _Bird) -> Mesh:
    """A fan of tail feathers."""
    kind = bird.kind
    length = kind.tail[0]
    width = kind.tail[1] * bird.fan
    u = np.linspace(-1, 1, 13)[None]
    v = np.linspace(0, 1, 9)[:, None]
    out = 0.011 + (width - 0.011) * v**0.8
    along = length * v * (1 - 0.10 * u**2)
    drop = (0.075 + length) * np.sin(np.radians(bird.tilt)) - kind.leg - 0.040
    # the tip stays above the ground
    bend = np.arcsin(np.clip(drop / length, -0.06, 0.7))
    x = -0.080 - along * np.cos(bend)
    z = 0.008 + along * np.sin(bend) - 0.006 * u**2
    grid = np.stack([x, u * out, z], -1)[::-1]
    vv, uu = np.mgrid[1:0:64j, -1:1:64j].astype(np.float32)
    tail = np.asarray(
        kind.back if "white tail" not in kind.marks else (0.95, 0.95, 0.94), np.float32
    )
    colours = np.broadcast_to(tail, (64 * 64, 3)).astype(np.float32)
    toward_tip = 1 - vv.ravel()
    if "red tail" in kind.marks:
        colours = mix(
            colours,
            (0.75, 0.18, 0.14),
            (toward_tip > 0.35) & (np.abs(uu.ravel()) > 0.45),
        )
    elif "yellow" in kind.marks:
        colours = mix(
            colours,
            kind.flight,
            (np.abs(uu.ravel()) - 0.45) * 5,
        )
    elif "white tail" not in kind.marks:
        colours = mix(colours, kind.flight, 0.65 + 0 * toward_tip)
    if "bars" in kind.marks or "white bars" in kind.marks:
        colours = mix(
            colours,
            (0.14, 0.14, 0.16),
            np.abs(toward_tip - 0.88) < 0.10,
        )
    quill = np.mod(uu.ravel() * 5 + 0.5, 1)
    colours = (
        colours
        * (1 - 0.3 * (quill < 0.14) - 0.12 * (np.abs(quill - 0.55) < 0.05))[:, None]
        * bird.tint
    )
    return blade(
        grid,
        0.008,
        np.clip(colours, 0, 1).reshape(64, 64, 3)[::-1],
        roughness=kind.roughness,
    )


def _beak(bird: _Bird) -> list[Mesh]:
    """Upper and lower half of the beak in the frame of the head."""
    kind = bird.kind
    (length, deep), s = kind.beak, kind.skull
    t = np.linspace(0, 1, 9)
    start = 0.86 * s
    droop = kind.hook * (0.55 * length * t**2.4 + 0.004)
    upper = np.stack(
        [
            start + length * np.sin(t * np.pi / 2 * (0.6 + 0.4 * kind.hook)),
            0 * t,
            -0.02 * s - droop,
        ],
        1,
    )
    lower = np.stack(
        [
            start + 0.74 * length * t * (1 - 0.35 * kind.hook),
            0 * t,
            -0.30 * s - 0.5 * droop,
        ],
        1,
    )
    size = deep * np.sqrt(np.maximum(1 - t**1.5, 0.012))
    wide = np.stack([0.82 * size, size], 1)
    shade = np.asarray(kind.bill)
    meshes = [
        sweep(upper, wide, shade, segments=10, roughness=0.3),
        sweep(lower, 0.62 * wide, shade * 0.8, segments=8, roughness=0.3),
    ]
    if "red spot" in kind.marks:
        meshes.append(
            ball(
                (0.010, 0.010, 0.006),
                (0.8, 0.12, 0.08),
                centre=(lower[6, 0], 0, lower[6, 2]),
                segments=8,
            )
        )
    return meshes


def _eyes(bird: _Bird) -> list[Mesh]:
    """Two eyes with pupils, in the frame of the head."""
    s = bird.kind.skull
    meshes = []
    for side in (1, -1):
        centre = np.array((0.42 * s, side * 0.80 * s, 0.22 * s))
        meshes.append(
            ball(
                (0.0125,) * 3,
                bird.kind.eye,
                centre=tuple(centre),
                segments=10,
                roughness=0.1,
            )
        )
        pupil = centre + np.array((0.001, side * 0.0030, 0.0005))
        meshes.append(
            ball(
                (0.0085,) * 3,
                (0.02, 0.02, 0.02),
                centre=tuple(pupil),
                segments=10,
                roughness=0.08,
            )
        )
    return meshes


def _legs(bird: _Bird, tilt: Floats) -> list[Mesh]:
    """Legs and toes, upright in the world."""
    kind = bird.kind
    shade = np.asarray(kind.legs)
    meshes = []
    for side in (1, -1):
        knee = tilt[:3, :3].astype(np.float64) @ np.array(
            (-0.010, side * 0.021, -0.048)
        )
        foot = knee + np.array((0.024 + side * bird.stride, side * 0.004, -kind.leg))
        shin = np.array(
            [(0, 0, 0.012), (-0.004, 0, -0.008), (-0.003, 0, 0.006), (0, 0, 0)]
        )
        shin += np.stack([knee, knee, foot, foot])
        meshes.append(
            sweep(
                shin,
                [0.0055, 0.0048, 0.0042, 0.0046],
                shade,
                segments=8,
                up=(1, 0, 0),
            )
        )
        for angle, length in ((-32, 0.036), (0, 0.042), (32, 0.036), (180, 0.024)):
            turn = np.radians(angle - 6 * side)
            ahead = np.array((np.cos(turn), np.sin(turn), 0.0))
            toe = foot + np.outer((0, 0.55 * length, length), ahead)
            toe[1:, 2] += 0.003, -0.001
            meshes.append(
                sweep(toe, [0.0046, 0.0040, 0.0016], shade * 0.92, segments=6)
            )
    return meshes
