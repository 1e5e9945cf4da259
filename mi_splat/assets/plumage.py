"""Kinds of birds and the colours of their feathers."""

from dataclasses import dataclass

import numpy as np

from mi_splat.assets.mesh import Floats
from mi_splat.assets.organic import Noise, mix, spot

Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Species:
    """Shape and plumage of a kind of bird.

    `length` runs from beak to tail, smallest and largest, metres; the other lengths are for a figure of about 0.3 m
    that is scaled to it. `tilt` is in degrees.
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
        length=(0.42, 0.50), tilt=24, back=(0.09, 0.09, 0.11), wing=(0.08, 0.09, 0.13), flight=(0.05, 0.05, 0.07),
        breast=(0.10, 0.10, 0.12), belly=(0.08, 0.08, 0.09), head=(0.08, 0.08, 0.10), bill=(0.07, 0.07, 0.08),
        legs=(0.08, 0.08, 0.08), beak=(0.045, 0.0115), roughness=0.38,
    ),
    "robin": Species(
        length=(0.21, 0.27), tilt=38, back=(0.40, 0.36, 0.33), wing=(0.37, 0.33, 0.30), flight=(0.25, 0.22, 0.20),
        breast=(0.82, 0.36, 0.12), belly=(0.84, 0.42, 0.18), head=(0.18, 0.17, 0.17), bill=(0.86, 0.66, 0.18),
        legs=(0.36, 0.26, 0.18), plump=1.1, beak=(0.030, 0.0070), leg=0.052, marks=("ring", "vent"),
    ),
    "redbreast": Species(
        length=(0.20, 0.24), tilt=42, back=(0.46, 0.38, 0.27), wing=(0.44, 0.35, 0.25), flight=(0.32, 0.25, 0.18),
        breast=(0.86, 0.40, 0.14), belly=(0.90, 0.87, 0.82), head=(0.46, 0.38, 0.27), bill=(0.15, 0.12, 0.10),
        legs=(0.42, 0.28, 0.2), plump=1.25, skull=0.034, beak=(0.022, 0.0055), leg=0.058, marks=("face",),
    ),
    "pigeon": Species(
        length=(0.30, 0.36), tilt=20, back=(0.55, 0.57, 0.62), wing=(0.64, 0.66, 0.70), flight=(0.38, 0.40, 0.45),
        breast=(0.52, 0.46, 0.55), belly=(0.60, 0.62, 0.66), head=(0.34, 0.37, 0.43), bill=(0.24, 0.22, 0.22),
        legs=(0.80, 0.36, 0.34), eye=(0.85, 0.36, 0.10), plump=1.2, skull=0.026, beak=(0.026, 0.0065), leg=0.040,
        marks=("bars", "sheen", "cere"),
    ),
    "parrot": Species(
        length=(0.32, 0.40), tilt=44, back=(0.20, 0.60, 0.20), wing=(0.16, 0.54, 0.20), flight=(0.14, 0.30, 0.60),
        breast=(0.42, 0.72, 0.26), belly=(0.50, 0.74, 0.28), head=(0.26, 0.66, 0.22), bill=(0.88, 0.82, 0.70),
        legs=(0.50, 0.48, 0.46), eye=(0.85, 0.48, 0.12), plump=1.1, skull=0.037, beak=(0.032, 0.0155), hook=0.95,
        tail=(0.105, 0.030), leg=0.034, marks=("crown", "red tail"),
    ),
    "macaw": Species(
        length=(0.44, 0.50), tilt=40, back=(0.80, 0.12, 0.10), wing=(0.80, 0.14, 0.10), flight=(0.12, 0.28, 0.72),
        breast=(0.82, 0.13, 0.10), belly=(0.80, 0.12, 0.10), head=(0.84, 0.14, 0.11), bill=(0.90, 0.86, 0.76),
        legs=(0.34, 0.33, 0.33), eye=(0.90, 0.85, 0.55), skull=0.037, beak=(0.036, 0.0175), hook=0.95,
        tail=(0.185, 0.022), leg=0.046, marks=("yellow", "cheek"),
    ),
    "gull": Species(
        length=(0.42, 0.50), tilt=14, back=(0.62, 0.66, 0.70), wing=(0.62, 0.66, 0.71), flight=(0.10, 0.10, 0.11),
        breast=(0.94, 0.94, 0.93), belly=(0.93, 0.93, 0.92), head=(0.95, 0.95, 0.94), bill=(0.93, 0.72, 0.12),
        legs=(0.90, 0.60, 0.45), eye=(0.80, 0.74, 0.35), beak=(0.042, 0.0095), hook=0.35, tail=(0.092, 0.030),
        leg=0.056, marks=("tips", "white tail", "red spot"),
    ),
    "bluebird": Species(
        length=(0.22, 0.29), tilt=34, back=(0.24, 0.42, 0.76), wing=(0.20, 0.40, 0.78), flight=(0.12, 0.20, 0.40),
        breast=(0.80, 0.80, 0.82), belly=(0.90, 0.90, 0.90), head=(0.28, 0.46, 0.80), bill=(0.10, 0.10, 0.10),
        legs=(0.14, 0.13, 0.13), skull=0.033, beak=(0.028, 0.0075), marks=("collar", "white bars"),
    ),
}  # fmt: skip


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
    colours = np.broadcast_to(np.asarray(kind.back, np.float32), points.shape).astype(np.float32)
    colours = mix(colours, kind.belly, (0.002 - z + wobble) / 0.012)
    colours = mix(colours, kind.breast, np.clip((x - 0.9 * z - 0.012 + wobble) / 0.014, 0, 1) * (z < 0.060))
    if "vent" in kind.marks:
        colours = mix(colours, (0.9, 0.9, 0.88), (-x - 0.035 - 0.5 * z) / 0.01 * (z < 0))
    if "sheen" in kind.marks:
        neck = spot(points, (0.066, 0, 0.024), (0.030, 0.06, 0.028), 0.5)
        hue = np.sin(y * 90 + z * 160 + 4 * noise(points, 0.03))[:, None]
        colours = mix(colours, np.where(hue > 0, (0.16, 0.46, 0.36), (0.46, 0.22, 0.48)), 0.8 * neck)
    if "collar" in kind.marks:
        colours = mix(colours, (0.08, 0.09, 0.14), 0.9 * (np.abs(x + 0.7 * z - 0.082) < 0.006) * (x > 0.03))
    shade = 1 - 0.14 * _scales(points, 0.0085) * (x < 0.075)
    result: Floats = colours * shade[:, None] * tint
    return result


def face(kind: Species, tint: float, colours: Floats, points: Floats, noise: Noise) -> Floats:
    """The colours with the head painted over."""
    s = kind.skull
    side = points * np.array((1, 0, 1), np.float32) + np.abs(points[:, 1])[:, None] * np.array((0, 1, 0), np.float32)
    reach = spot(points + 0.004 * noise(points, 0.01)[:, None], (0, 0, 0.1 * s), (1.35 * s, 1.3 * s, 1.3 * s), 0.15)
    colours = mix(colours, np.asarray(kind.head) * tint, reach)
    eye = (0.42 * s, 0.86 * s, 0.22 * s)
    if "ring" in kind.marks:
        colours = mix(colours, (0.92, 0.92, 0.9), spot(side, eye, (0.31 * s,) * 3, 0.2))
    if "face" in kind.marks:
        mask = spot(points, (0.95 * s, 0, -0.35 * s), (0.95 * s, 1.1 * s, 0.95 * s), 0.15)
        colours = mix(colours, kind.breast, mask)
    if "cheek" in kind.marks:
        bare = spot(side, (0.55 * s, 0.85 * s, -0.02 * s), (0.48 * s, 0.5 * s, 0.42 * s), 0.25)
        colours = mix(colours, (0.93, 0.91, 0.88), bare)
    if "crown" in kind.marks:
        crown = spot(points, (0.75 * s, 0, 0.7 * s), (0.65 * s, 0.75 * s, 0.5 * s), 0.3)
        colours = mix(colours, (0.92, 0.80, 0.18), crown)
    if "cere" in kind.marks:
        colours = mix(colours, (0.9, 0.88, 0.86), spot(points, (1.08 * s, 0, 0.05 * s), (0.3 * s,) * 3, 0.2))
    if "collar" in kind.marks:
        colours = mix(colours, (0.92, 0.92, 0.93), spot(side, (0.6 * s, 0.8 * s, -0.2 * s), (0.6 * s,) * 3, 0.3))
    return mix(colours, (0.04, 0.04, 0.04), 0.75 * spot(side, eye, (0.25 * s,) * 3, 0.3))


def wing(kind: Species, tint: float, span: Floats, chord: Floats, points: Floats, noise: Noise) -> Floats:
    """Colours (N, 3) of a wing."""
    base = np.broadcast_to(np.asarray(kind.wing, np.float32), (len(span), 3)).astype(np.float32)
    flight = np.clip((span - 0.50 + 0.25 * (0.5 - chord)) / 0.04, 0, 1)
    colours = mix(base, kind.flight, flight)
    if "yellow" in kind.marks:
        colours = mix(base, (0.95, 0.78, 0.12), (span - 0.26 + 0.15 * (0.5 - chord)) / 0.03)
        colours = mix(colours, kind.flight, (span - 0.46 + 0.15 * (0.5 - chord)) / 0.03)
    if "bars" in kind.marks:
        for at in (0.48, 0.66):
            bar = (np.abs(span - at - 0.12 * (chord - 0.5)) < 0.038) & (chord < 0.9)
            colours = mix(mix(colours, kind.wing, (span < 0.74) * 0.7), (0.13, 0.13, 0.15), bar)
    if "tips" in kind.marks:
        colours = mix(base, kind.flight, (span - 0.76) / 0.02)
        colours = mix(colours, (0.95, 0.95, 0.95), (np.abs(span - 0.90) < 0.02) | (np.abs(span - 0.725) < 0.018))
    if "white bars" in kind.marks:
        colours = mix(colours, (0.92, 0.92, 0.92), np.abs(span - 0.45) < 0.022)
        colours = mix(colours, (0.08, 0.09, 0.12), (np.mod(span * 16, 1) < 0.25) * (span > 0.5))
    quills = np.mod(chord * 9 + span * 3 + 0.25 * noise(points, 0.02), 1) < 0.18
    edges = np.where(span > 0.42, quills, _scales(points, 0.0095) > 0)
    result: Floats = (colours * (1 - 0.24 * edges)[:, None] * tint).astype(np.float32)
    return result
