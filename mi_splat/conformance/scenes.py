"""Small splats whose image shows one fact each of the definition in `mi_splat.oracle`;
NumPy alone, seeds fixed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.conformance.setups import C0, Setup, look_at
from mi_splat.oracle import Array, PinholeCamera, Splat, sh_basis

SIZES = (64, 256, 512)
"""Pixels on each side of images, of which references are made."""
EYE = (2.5, -1.9, 1.0)
_SH_EYE = (-1.4, -1.4, -0.25)
"""Where no term of the spherical harmonics is short, so that each constant shows."""
_PADDED = 256
"""Gaussians of a file at least; viewers make textures of larger blocks, and some squash
the Gaussians of tiny files.
"""
_NO_TURN = (1.0, 0.0, 0.0, 0.0)

File = Literal["plain", "other columns", "wrong COLOR_0", "moved by a node"]
"""How a file states a splat: a PLY with its columns in another order, or a glTF with
more than the splat in it.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ConformanceScene:
    """A splat and a camera whose image shows one fact."""

    name: str
    fact: str  # what is drawn, and what a wrong renderer shows
    setup: Setup
    file: File = "plain"


class _Builder:
    """The scenes at images of `size` pixels; sizes that matter in pixels stay the same
    in pixels.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.pixel = 64 / size
        self.rng, self.found = np.random.default_rng(1), list[ConformanceScene]()
        self.view = self.camera(EYE)

    def camera(
        self,
        eye: ArrayLike,
        target: ArrayLike = (0, 0, 0),
        focal: float = 1.2,
        up: Sequence[float] = (0, 0, 1),
    ) -> PinholeCamera:
        """A camera of square images, its focal length as a part of their width."""
        return look_at(
            eye,
            target,
            focal=focal * self.size,
            width=self.size,
            height=self.size,
            up=up,
        )

    def grid(
        self, count: int, step: float, camera: PinholeCamera | None = None
    ) -> Array:
        """Points of a square grid on the plane through the origin that faces the
        camera.
        """
        pose = (camera or self.view).to_world
        right = pose[:3, 0]
        down = pose[:3, 1]
        at = (np.arange(count) - (count - 1) / 2) * step
        return np.array([x * right + y * down for y in at for x in at])

    def bright(self, count: int) -> Array:
        """Colours of `count` Gaussians."""
        return self.rng.uniform(0.3, 1, (count, 3))

    def add(
        self,
        fact: str,
        splat: Splat,
        *,
        camera: PinholeCamera | None = None,
        apart: bool = True,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        file: File = "plain",
    ) -> None:
        """Append a scene, called "name: fact"; `apart` moves Gaussians along their
        rays, so that depths differ.
        """
        view = self.view if camera is None else camera
        if apart:
            eye = view.to_world[:3, 3]
            steps = 1 + 0.0015 * (
                np.arange(len(splat.means)) - (len(splat.means) - 1) / 2
            )
            splat = splat._replace(
                means=(eye + (splat.means - eye) * steps[:, None]).astype(np.float32)
            )
        setup = Setup(stored=_padded(splat, view), camera=view, background=background)
        name, _, fact = fact.partition(": ")
        self.found.append(
            ConformanceScene(name=name, fact=fact, setup=setup, file=file)
        )


def _stored(
    means: ArrayLike,
    scales: ArrayLike,
    *,
    colours: ArrayLike = (0.9, 0.7, 0.5),
    opacities: ArrayLike = 0.9,
    rotations: ArrayLike = _NO_TURN,
    sh: Array | None = None,
) -> Splat:
    """Gaussians as a file has them, float32; scales (N,), (N, 3) or one number, the
    rest (N, ...) or one value.
    """
    means = np.asarray(means, dtype=np.float64)
    scales = np.asarray(scales, dtype=np.float64)
    opacities = np.broadcast_to(opacities, len(means))
    wide = np.broadcast_to(
        scales if scales.ndim < 1 or scales.shape == means.shape else scales[:, None],
        means.shape,
    )
    dc = (np.broadcast_to(colours, (len(means), 3)) - 0.5)[:, None] / C0
    values = (
        means,
        np.log(wide),
        np.broadcast_to(rotations, (len(means), 4)),
        np.log(opacities / (1 - opacities)),
        dc if sh is None else np.concatenate([dc, sh], axis=1),
    )
    return Splat(*(np.asarray(value, dtype=np.float32) for value in values))


def _padded(stored: Splat, camera: PinholeCamera) -> Splat:
    """Gaussians with others behind the camera, so that there are 256."""
    count = max(0, _PADDED - len(stored.means))
    rng = np.random.default_rng(0)
    pose = camera.to_world
    means = (
        pose[:3, 3]
        - pose[:3, 2] * rng.uniform(2, 4, (count, 1))
        + rng.normal(size=(count, 3)) * 0.3
    )
    more = _stored(means, 0.05, colours=rng.uniform(0.2, 0.8, (count, 3)))
    rest = np.zeros((count, stored.sh.shape[1] - 1, 3), dtype=np.float32)
    more = more._replace(sh=np.concatenate([more.sh, rest], axis=1))
    return Splat(*(np.concatenate(pair) for pair in zip(stored, more, strict=True)))


def conformance_scenes(size: int = 64) -> list[ConformanceScene]:
    """All scenes at images of `size` x `size` pixels, but for the one of a portrait."""
    builder = _Builder(size)
    groups = (
        _values,
        _colours,
        _order,
        _coverage,
        _cameras,
        _shapes,
        _files,
        _derivatives,
    )
    for group in groups:
        group(builder)
    return builder.found


def _values(b: _Builder) -> None:
    three = b.grid(3, 0.8)
    colours = b.bright(9)
    unit = b.rng.normal(size=(9, 4))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    turned: dict[str, Any] = {"colours": colours, "opacities": 0.95}
    long = np.tile([0.3, 0.11, 0.05], (9, 1))
    b.add(
        "quaternion: Nine ellipsoids, each turned; quaternions are w, x, y, z and turn"
        " the Gaussian into the world.",
        _stored(three, long, rotations=unit, **turned),
    )
    b.add(
        "quaternion_length: The same with quaternions of length 0.5 to 3, to be divided"
        " out.",
        _stored(
            three, long, rotations=unit * np.linspace(0.5, 3, 9)[:, None], **turned
        ),
    )
    b.add(
        "quaternion_sign: The same with w below 0; made positive without x, y and z,"
        " they turn the wrong way.",
        _stored(three, long, rotations=-unit * np.sign(unit[:, :1]), **turned),
    )
    b.add(
        "activation: Scales are stored as logarithms and opacities as logits; nine"
        " sizes and nine opacities.",
        _stored(
            three, np.geomspace(0.04, 0.35, 9), opacities=np.linspace(0.1, 0.95, 9)
        ),
    )
    broken = _stored(three[:5], 0.5, colours=(1, 1, 1))
    for number, values in enumerate(broken):
        values[number] = 0.0 if number == 2 else np.nan
    b.add(
        "broken_rows: Five white Gaussians have NaN or a quaternion of zeros: drop"
        " them, or refuse the file.",
        Splat(
            *map(
                np.concatenate,
                zip(
                    _stored(three, long, rotations=unit, **turned), broken, strict=True
                ),
            )
        ),
    )


def _colours(b: _Builder) -> None:
    grey = (0.5, 0.5, 0.5)
    view = b.camera(_SH_EYE, focal=0.73)
    for degree in (1, 2, 3):
        count = 2 * degree + 1
        where = b.grid(4, 0.62, view)[: 2 * count]
        coefficient = degree**2 + np.arange(2 * count) % count
        towards = where - np.array(_SH_EYE)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        # Each term changes its colours about as much, so that a wrong constant shows.
        terms = sh_basis(towards, 16)[np.arange(2 * count), coefficient]
        lengths = np.minimum(1.0, 0.45 / np.abs(terms))
        lengths[count:] *= -1
        bands = np.zeros((2 * count, (degree + 1) ** 2 - 1, 3))
        bands[np.arange(2 * count), coefficient - 1] = lengths[:, None] * (1, -0.7, 0.4)
        fact = (
            f"sh_{degree}: Gaussians have one coefficient of band {degree} each, seen"
            " from the camera."
        )
        splat = _stored(where, 0.22, colours=grey, opacities=0.97, sh=bands)
        b.add(fact, splat, camera=view)
    three = b.grid(3, 0.8)
    two = b.grid(2, 1.0)
    towards = np.array(EYE)
    b.add(
        "sh_layout: All 45 higher coefficients differ, so mixing channels and"
        " coefficients shows.",
        _stored(three, 0.3, colours=grey, sh=b.rng.normal(size=(9, 15, 3)) * 0.15),
    )
    pairs = np.concatenate([two, two * 0.9 + towards * 0.2])
    behind = [[0.9, 0.9, 0.9], [0.6, 0.9, 0.3], [0.4, 0.5, 0.9], [0.9, 0.7, 0.9]]
    dark = [[-0.6, 0.4, 0.4], [0.3, -0.9, 0.6], [0.4, 0.3, -0.7], [-0.5, -0.5, -0.5]]
    sizes = np.repeat([0.42, 0.3], 4)
    alphas = np.repeat([0.95, 0.8], 4)
    b.add(
        "below_0: Colours below 0 count as 0; not clamped, they darken what is behind"
        " them.",
        _stored(pairs, sizes, colours=behind + dark, opacities=alphas),
    )
    bright = [[1.8, 0.4, 0.4], [0.3, 2.5, 0.6], [0.4, 0.3, 1.6], [3.0, 3.0, 3.0]]
    b.add(
        "above_1: Colours above 1 are blended as they are and clipped at the end;"
        " clamped first, they are darker.",
        _stored(pairs, sizes, colours=behind + bright, opacities=alphas / 2),
    )
    greys = np.linspace(0.05, 0.95, 9)[:, None] * np.ones(3)
    b.add(
        "colour_space: Half-transparent greys before greys; colours are blended as sRGB"
        " values, without decoding.",
        _stored(
            np.concatenate([three, three + towards * 0.1]),
            np.repeat([0.33, 0.3], 9),
            colours=np.concatenate([greys, greys[::-1]]),
            opacities=np.repeat([0.95, 0.5], 9),
        ),
    )
    veil = _stored(
        three, 0.35, colours=(0.2, 0.3, 0.8), opacities=np.linspace(0.2, 0.9, 9)
    )
    b.add(
        "background: Half-transparent Gaussians before a coloured background.",
        veil,
        background=(0.9, 0.6, 0.1),
    )
    b.add(
        "transparent: The same before nothing; alpha, if saved, is 1 - transmittance,"
        " and multiplies colours once.",
        veil,
    )


def _order(b: _Builder) -> None:
    means = list[tuple[float, float, float]]()
    colours = list[tuple[float, float, float]]()
    for x in (-1.7, 1.7):
        for z in (-1.5, 0.0, 1.5):
            # the second is deeper, and yet nearer to the eye
            means += [(x, -0.9, z), (0.86 * x, -0.78, 0.86 * z)]
            colours += [(1.0, 0.3, 0.1), (0.1, 0.4, 1.0)]
    b.add(
        "order: Red has the smaller depth, blue the smaller distance: red is in front.",
        _stored(means, 0.34, colours=colours, opacities=0.85),
        camera=b.camera((0, -3, 0), focal=0.55),
        apart=False,
    )
    three = b.grid(3, 0.8)
    towards = np.array(EYE)
    b.add(
        "front_to_back: The file lists red Gaussians before the green ones that cover"
        " them.",
        _stored(
            np.concatenate([three, three + 0.15 * towards]),
            np.repeat([0.3, 0.2], 9),
            colours=np.repeat([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2]], 9, axis=0),
            opacities=np.concatenate([np.full(9, 0.95), np.linspace(0.2, 0.95, 9)]),
        ),
    )
    ties = [(x, 0.0, z) for z in (-0.6, 0.6) for x in (-0.7, -0.5, 0.5, 0.7)]
    b.add(
        "equal_depths: Pairs at one depth: the Gaussian that comes first in the file is"
        " in front.",
        _stored(
            ties, 0.28, colours=[(0.9, 0.2, 0.1), (0.1, 0.3, 0.9)] * 4, opacities=0.8
        ),
        camera=b.camera((0, -3, 0)),
        apart=False,
    )
    b.add(
        "overdraw: Three hundred layers; a pixel takes no more when less than 1/10,000"
        " of the light is left.",
        _stored(
            np.tile(three[[0, 4, 8]], (100, 1)),
            0.25,
            colours=np.linspace(0, 1, 300)[:, None] * (1, 0.6, 0.3),
            opacities=np.tile([0.05, 0.2, 0.6], 100),
        ),
    )

    depths = np.geomspace(1.0, 900.0, 40).repeat(2)
    depths[1::2] *= 1 + 2e-5
    across = np.linspace(-0.42, 0.42, 8).repeat(10)
    along = np.tile(np.linspace(-0.4, 0.4, 5).repeat(2), 8)
    rays = np.stack([across, np.ones(80), along], axis=1)
    b.add(
        "depth_precision: Green is before red by 1/50,000 of the depth, from 1 to 900.",
        _stored(
            (rays * depths[:, None])[::-1],
            0.045 * depths[::-1],
            colours=[(0.9, 0.1, 0.1), (0.1, 0.8, 0.2)] * 40,
        ),
        camera=b.camera((0, 0, 0), (0, 1, 0), focal=1.0),
        apart=False,
    )
    # Three wide layers leave 5 of 10,000 parts of the light; before the last two dots a
    # narrower one leaves less than 1.
    wide = np.array([[0.3], [0.25], [0.2]]) * towards
    dots = b.grid(2, 1.1)
    b.add(
        "early_stop: Bright dots behind 5 of 10,000 parts of the light show, and those"
        " behind less than 1 do not.",
        _stored(
            np.concatenate([wide, dots[2:] + 0.1 * towards, dots]),
            np.concatenate([np.full(3, 6.0), np.full(2, 0.3), np.full(4, 0.12)]),
            colours=np.concatenate(
                [
                    np.tile([0.05, 0.1, 0.2], (5, 1)),
                    np.tile([1600.0, 1200.0, 800.0], (2, 1)),
                    np.tile([16000.0, 12000.0, 8000.0], (2, 1)),
                ]
            ),
            opacities=np.array([0.95, 0.9, 0.9, 0.9, 0.9, 0.5, 0.5, 0.5, 0.5]),
        ),
    )


def _coverage(b: _Builder) -> None:
    three = b.grid(3, 0.8)
    towards = np.array(EYE)
    b.add(
        "cut_off: A Gaussian ends where its alpha falls below 1/255, not at some"
        " standard deviations.",
        _stored(
            np.tile(three, (4, 1)),
            np.repeat([0.2, 0.21, 0.22, 0.23], 9),
            colours=(1, 0.8, 0.6),
            opacities=np.repeat([0.9, 0.99, 0.03, 0.02], 9),
        ),
    )
    # In the middles of tiles of 16 pixels, three deviations just within them.
    pixels = 8 + 16 * np.arange(-1, 2) * (b.size // 64)
    unit = float(np.linalg.norm(EYE)) / (1.2 * b.size)
    right = b.view.to_world[:3, 0]
    down = b.view.to_world[:3, 1]
    b.add(
        "tails: Gaussians so bright that their last alphas show, beyond three standard"
        " deviations; tiles may cut them off.",
        _stored(
            [unit * (x * right + y * down) for y in pixels for x in pixels],
            2.55 * unit,
            colours=(24, 18, 12),
            opacities=0.99,
        ),
    )
    b.add(
        "faint: Thirty layers of opacity 1/300 are not drawn at all, since each is"
        " below 1/255.",
        _stored(
            np.tile([[0.0, 0, 0], [0.5, 0.3, 0.3]], (30, 1)),
            0.3,
            opacities=np.tile([1 / 300, 1 / 200], 30),
        ),
    )
    b.add(
        "largest_alpha: Alpha is at most 0.99, so bright Gaussians shine through an"
        " opaque black one.",
        _stored(
            np.concatenate([[0.1 * towards], three]),
            np.concatenate([[6.0], np.full(9, 0.28)]),
            colours=np.concatenate(
                [np.full((1, 3), 0.02), np.tile([22.0, 16.0, 12.0], (9, 1))]
            ),
            opacities=np.concatenate([[0.99999], np.full(9, 0.9)]),
        ),
    )
    b.add(
        "low_pass: Dots from a twentieth of a pixel up, widened by 0.3 pixels^2, their"
        " opacity as it is.",
        _stored(
            b.grid(5, 0.5),
            np.geomspace(0.002, 0.05, 25) * b.pixel,
            colours=(1, 0.9, 0.8),
        ),
    )


def _cameras(b: _Builder) -> None:
    inside = b.camera((0, 0, 0), (0, 1, 0))
    depths = np.array([0.05, 0.12, 0.18, 0.22, 0.3, 0.5, 1.5, 3.0])
    sides = np.array(
        [(-0.28 + 0.56 * (i % 2), 1.0, 0.3 - 0.2 * (i // 2)) for i in range(8)]
    )
    b.add(
        "near_plane: Gaussians at depths of 0.05 to 3: those before 0.2 are left out.",
        _stored(
            sides * depths[:, None], depths * 0.06, colours=b.bright(8), opacities=0.95
        ),
        camera=inside,
        apart=False,
    )
    b.add(
        "near_and_large: A red Gaussian reaches beyond the near plane, and is left out"
        " whole, as its mean does not.",
        _stored(
            [(0.0, 0.15, 0.0), (0.1, 1.0, 0.1)],
            [0.4, 0.2],
            colours=[(0.9, 0.1, 0.1), (0.2, 0.7, 0.3)],
        ),
        camera=inside,
    )
    b.add(
        "behind: Four bright Gaussians before the camera, and four behind it that must"
        " not show.",
        _stored(
            np.concatenate([sides[4:], -sides[:4]]),
            0.08,
            colours=np.repeat([[0.2, 0.7, 0.3], [1, 0.2, 0.2]], 4, axis=0),
            opacities=0.95,
        ),
        camera=inside,
    )
    dot = 2.2 * b.pixel / (1.2 * 64) * float(np.linalg.norm(EYE)) * 0.7
    size = b.size
    view = b.view
    for fact, camera in (
        ("pixel_centres: Sharp dots; the first pixel's centre is at 0.5.", view),
        (
            "principal_point: The same with a principal point off the centre.",
            replace(view, cx=0.42 * size, cy=0.56 * size),
        ),
        (
            "focal_lengths: The same with pixels that are not square.",
            replace(view, fy=0.96 * size),
        ),
        (
            (
                "portrait: The same in a portrait, where fields of view of the sides"
                " differ."
            ),
            replace(view, width=3 * size // 4, cx=0.375 * size),
        ),
        (
            "rolled: The same by a camera that is rolled by 30 degrees.",
            b.camera(EYE, up=(1.0, 1.5, 2.0)),
        ),
        (
            (
                "from_above: The same from straight above, where a target and an up do"
                " not fix a camera."
            ),
            b.camera((0, 0, 3.3)),
        ),
        (
            "from_below: The same from below, with the world's y up.",
            b.camera((0.8, -1.2, -2.9), up=(0, 1, 0)),
        ),
    ):
        scattered = b.grid(5, 0.42) + 0.01 * b.rng.normal(size=(25, 3))
        colours = b.rng.uniform(0.4, 1, (25, 3))
        b.add(
            fact,
            _stored(scattered, dot, colours=colours, opacities=0.97),
            camera=camera,
        )
    far = np.array([61.3, -47.9, 23.1])
    b.add(
        "far_from_origin: The same 80 units from the origin, where numbers of 16 bits"
        " are a pixel apart.",
        _stored(far + b.grid(5, 0.42), dot, colours=b.bright(25), opacities=0.97),
        camera=b.camera(far + EYE, far),
    )
    right = view.to_world[:3, 0]
    down = view.to_world[:3, 1]
    letter = np.array(
        [i * 0.2 * down for i in range(-4, 5)]
        + [0.8 * down + i * 0.2 * right for i in range(1, 4)]
    )
    red = np.arange(12)[:, None] < 3
    b.add(
        "orientation: A letter L, red above: neither mirrored nor turned, as by a"
        " format's axes.",
        _stored(
            letter,
            0.1,
            colours=np.where(red, (0.9, 0.1, 0.1), (0.8, 0.8, 0.8)),
            opacities=0.97,
        ),
    )
    spread = np.array(
        [
            (x, 0.0, z)
            for x in (-4.4, -1.9, 0.0, 1.9, 4.4)
            for z in (-2.0, -1.2, 1.2, 2.0)
        ]
    )
    edge = np.where(np.abs(spread[:, :1]) > 4, (0.9, 0.5, 0.1), (0.12, 0.7, 0.12))
    b.add(
        "wide_angle: Gaussians at the edges and beyond; the Jacobian is taken at most"
        " 1.3 half fields off.",
        _stored(spread, edge, colours=b.bright(20), opacities=0.8),
        camera=b.camera((0, -2, 0), focal=0.42),
    )


def _shapes(b: _Builder) -> None:
    turns = np.linspace(0, math.pi, 9) / 2
    spin = np.stack([np.cos(turns), np.sin(turns), np.zeros(9), np.zeros(9)], axis=1)
    for fact, scales, opacity in (
        (
            "needles: Needles a hundred times as long as wide.",
            (0.4, 0.004, 0.004),
            0.95,
        ),
        ("discs: Discs without thickness, as of 2DGS.", (0.3, 0.2, 1e-6), 0.95),
        ("huge: Gaussians larger than the image.", (6.0, 4.0, 3.0), 0.3),
    ):
        wide = np.tile(scales, (9, 1))
        splat = _stored(
            b.grid(3, 0.8), wide, rotations=spin, opacities=opacity, colours=b.bright(9)
        )
        b.add(fact, splat)


def _files(b: _Builder) -> None:
    long = np.tile([0.3, 0.11, 0.05], (9, 1))
    unit = b.rng.normal(size=(9, 4))
    sh = b.rng.normal(size=(9, 3, 3)) * 0.3
    splat = _stored(b.grid(3, 0.8), long, rotations=unit, colours=b.bright(9), sh=sh)
    b.add(
        "ply_columns: The PLY has normals, a byte, and another order of columns: find"
        " them by name.",
        splat,
        file="other columns",
    )
    b.add(
        "gltf_colour: COLOR_0 of the glTF is noise; it is for programs without"
        " Gaussians, and SH count.",
        splat,
        file="wrong COLOR_0",
    )
    b.add(
        "gltf_node: A node of the glTF moves, turns and scales the splat, and so"
        " its SH.",
        splat,
        file="moved by a node",
    )


def _derivatives(b: _Builder) -> None:
    """Scenes in which the gradient of every attribute has all its terms."""
    four = b.grid(4, 0.45)
    unit = b.rng.normal(size=(16, 4))
    b.add(
        "anisotropic: Overlapping ellipsoids with SH of degree 3 before a background;"
        " no gradient is 0.",
        _stored(
            four,
            np.tile([0.3, 0.16, 0.09], (16, 1)),
            rotations=unit * np.linspace(0.6, 1.7, 16)[:, None],
            opacities=np.linspace(0.3, 0.9, 16),
            colours=b.rng.uniform(0.4, 0.8, (16, 3)),
            sh=b.rng.normal(size=(16, 15, 3)) * 0.06,
        ),
        background=(0.2, 0.5, 0.8),
    )
    b.add(
        "limits: Alphas at their limit of 0.99, and colours below 0, before a"
        " background; neither passes a gradient on.",
        _stored(
            np.concatenate([four[::2], four[1::2] * 0.9]),
            np.tile([0.35, 0.3, 0.25], (16, 1)),
            opacities=np.concatenate([np.full(8, 0.9999), np.linspace(0.2, 0.7, 8)]),
            colours=np.concatenate(
                [b.rng.uniform(0.3, 0.9, (8, 3)), b.rng.uniform(-0.6, 0.6, (8, 3))]
            ),
        ),
        background=(0.9, 0.7, 0.3),
    )
