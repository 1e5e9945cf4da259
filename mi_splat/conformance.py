"""Whether a renderer makes the image of 3D Gaussian Splatting, and what it does differently; NumPy alone.

A `ConformanceScene` is a small splat whose image shows one fact of the definition in `mi_splat.oracle`. A `Deviation`
is one thing that renderers and readers do differently. `find_deviations` explains images: it searches for the
deviations under which the oracle makes them. `assert_renders_like_3dgs` is for tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.oracle import DEFAULT, Array, Convention, Image, PinholeCamera, Splat, project, render

_C0 = 0.28209479177387814
EYE = (2.5, -1.9, 1.0)
SIZES = (64, 256, 512)
_PADDED = 256
"""Gaussians of a file at least; viewers make textures of larger blocks, and some squash the Gaussians of tiny files."""
_FLOOR, _GAIN, _RESTARTS = 2e-6, 0.35, 2
"""Mean squared error of 8 bits; least gain of the summed log errors by which a deviation explains something; searches
without what was found first, where images stay unexplained."""


def look_at(eye: ArrayLike, target: ArrayLike, *, focal: float, width: int, height: int) -> PinholeCamera:
    """The camera at `eye` that looks at `target`, with z up in its image."""
    position = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
    return PinholeCamera(to_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)


# --------------------------------------------------------------------------------------------------------- deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """What decides about an image: the file, the camera, and what a renderer makes of them."""

    stored: Splat  # as a PLY file has it: logarithms of scales, logits of opacities, quaternions as w, x, y, z
    camera: PinholeCamera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    convention: Convention = DEFAULT
    scales: Callable[[Array], Array] = np.exp
    opacities: Callable[[Array], Array] = field(default=lambda logits: 1 / (1 + np.exp(-logits)))
    before: Callable[[Array], Array] | None = None  # of colours before they are blended
    after: Callable[[Array], Array] | None = None  # of the finished image

    @property
    def splat(self) -> Splat:
        """The Gaussians as values."""
        stored = Splat(*(values.astype(np.float64) for values in self.stored))
        return stored._replace(scales=self.scales(stored.scales), opacities=self.opacities(stored.opacities))

    def render(self) -> Image:
        """What the renderer shows."""
        splat, background, convention = self.splat, np.array(self.background), self.convention
        if self.before is not None:
            colours = self.before(project(splat, self.camera, convention).colour)
            splat = splat._replace(sh=(colours[:, None] - 0.5) / _C0)
            background, convention = self.before(background), replace(convention, clamp="none")
        seen = render(splat, self.camera, background=background, convention=convention)
        return seen if self.after is None else seen._replace(image=self.after(seen.image))


class Deviation(NamedTuple):
    """What a renderer or a reader does differently."""

    switch: str  # of all with the same one, at most one holds
    value: str
    kind: Literal["wrong", "another choice", "camera"]
    change: Callable[[Setup], Setup]


def _convention(**choices: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, convention=replace(setup.convention, **choices))


def _camera(change: Callable[[PinholeCamera], PinholeCamera]) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, camera=change(setup.camera))


def _file(change: Callable[[Splat], Splat]) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, stored=change(setup.stored))


def _setup(**changes: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, **changes)


def to_linear(values: Array) -> Array:
    """Linear light of sRGB values."""
    values = np.maximum(values, 0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def to_srgb(values: Array) -> Array:
    """SRGB values of linear light."""
    values = np.maximum(values, 0)
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


def _by_coefficient(splat: Splat) -> Splat:
    """SH that are stored channel by channel, read coefficient by coefficient."""
    rest = splat.sh[:, 1:].transpose(0, 2, 1).reshape(len(splat.sh), -1, 3)
    return splat._replace(sh=np.concatenate([splat.sh[:, :1], rest], axis=1))


def _odd_signs(splat: Splat) -> Splat:
    """SH without the Condon-Shortley phase."""
    orders = np.concatenate([np.arange(-degree, degree + 1) for degree in range(4)])[: splat.sh.shape[1]]
    return splat._replace(sh=splat.sh * np.where(orders % 2, -1, 1)[:, None])


_QUATERNIONS = {
    "read as x, y, z, w": lambda splat: splat._replace(rotations=splat.rotations[:, [3, 0, 1, 2]]),
    "conjugated": lambda splat: splat._replace(rotations=splat.rotations * [1, -1, -1, -1]),
}
_LIGHT = {"before": to_linear, "after": to_srgb}

DEVIATIONS = (
    *(Deviation("quaternions", value, "wrong", _file(change)) for value, change in _QUATERNIONS.items()),
    Deviation("length of quaternions", "not divided out", "wrong", _convention(unit_rotations=False)),
    Deviation("scales", "not exponentiated", "wrong", _setup(scales=np.abs)),
    Deviation("opacities", "not through a sigmoid", "wrong", _setup(opacities=lambda values: np.clip(values, 0, 1))),
    Deviation("SH coefficients", "read coefficient by coefficient", "wrong", _file(_by_coefficient)),
    Deviation("signs of SH", "without the Condon-Shortley phase", "wrong", _file(_odd_signs)),
    Deviation("direction of SH", "from Gaussian to camera", "wrong", _convention(towards="camera")),
    Deviation(
        "direction of SH", "in the camera's frame", "wrong", _convention(towards="gaussian in the camera's frame")
    ),
    Deviation("direction of SH", "the optical axis", "wrong", _convention(towards="optical axis")),
    *(
        Deviation("degree of SH", f"at most {degree}", "another choice", _convention(sh_degree=degree))
        for degree in (0, 1, 2)
    ),
    Deviation("clamp of colours", "none", "wrong", _convention(clamp="none")),
    Deviation("clamp of colours", "to 0 to 1", "another choice", _convention(clamp="outside 0 to 1")),
    Deviation("colour space", "blended in linear light", "another choice", _setup(**_LIGHT)),
    Deviation("colour space", "encoded twice", "wrong", _setup(after=to_srgb)),
    Deviation("colour space", "decoded, not encoded", "wrong", _setup(after=to_linear)),
    Deviation("order", "by distance, not by depth", "another choice", _convention(order="distance")),
    Deviation("order", "that of the file", "wrong", _convention(order="file")),
    Deviation("low-pass filter", "none", "another choice", _convention(low_pass=0.0)),
    Deviation("low-pass filter", "0.1 pixels^2", "another choice", _convention(low_pass=0.1)),
    Deviation("low-pass filter", "1 pixel^2", "another choice", _convention(low_pass=1.0)),
    Deviation(
        "compensation", "opacity lowered for the low-pass filter", "another choice", _convention(compensated=True)
    ),
    *(
        Deviation("cut-off", f"at {text} standard deviations", "another choice", _convention(cutoff=value))
        for text, value in (("2", 2.0), ("sqrt(8)", 8**0.5), ("3", 3.0))
    ),
    Deviation("least alpha", "none", "another choice", _convention(min_alpha=0.0)),
    Deviation("largest alpha", "1", "another choice", _convention(max_alpha=1.0)),
    Deviation("largest alpha", "0.999", "another choice", _convention(max_alpha=0.999)),
    Deviation("limit of the Jacobian", "none", "another choice", _convention(tangent_limit=math.inf)),
    *(Deviation("near plane", f"at {near:g}", "camera", _convention(near=near)) for near in (0.01, 0.1, 1.0)),
    Deviation("pixel centres", "at whole numbers", "camera", _convention(pixel_centre=0.0)),
    Deviation("pixel centres", "a whole pixel off", "camera", _convention(pixel_centre=1.0)),
    Deviation("principal point", "ignored", "camera", _camera(lambda c: replace(c, cx=c.width / 2, cy=c.height / 2))),
    Deviation("focal lengths", "fx for both", "camera", _camera(lambda c: replace(c, fy=c.fx))),
    Deviation("focal lengths", "fy for both", "camera", _camera(lambda c: replace(c, fx=c.fy))),
    Deviation("orientation", "mirrored", "camera", _setup(after=lambda image: image[:, ::-1])),
    Deviation("orientation", "upside down", "camera", _setup(after=lambda image: image[::-1])),
    Deviation("orientation", "turned by 180 degrees", "camera", _setup(after=lambda image: image[::-1, ::-1])),
    Deviation("background", "black", "wrong", _setup(background=(0.0, 0.0, 0.0))),
    Deviation("background", "white", "wrong", _setup(background=(1.0, 1.0, 1.0))),
)


class Cause(NamedTuple):
    """A deviation that explains images, and by how much their summed error grows without it."""

    deviation: Deviation
    decibels: float


def error(image: Array, reference: Array) -> float:
    """Mean squared error of an image as a screen shows it."""
    return float(np.mean((np.clip(image, 0, 1) - np.clip(reference, 0, 1)) ** 2))


def find_deviations(images: Mapping[str, Array], setups: Mapping[str, Setup], *, most: int = 8) -> list[Cause]:
    """The deviations under which the oracle makes the images, the one that explains most first.

    Coordinate descent over the switches: each round adds the deviation that lowers the summed logarithm of the errors
    most, and at the end those that explain nothing are dropped. Where images stay unexplained, it begins again without
    the deviation that explained most.

    Args:
        images: (H, W, 3) by the name of their scene.
        setups: Of every image, what makes its reference.
        most: Deviations that are combined at most.
    """
    known: dict[tuple[str, frozenset[Deviation]], float] = {}

    def cost(name: str, chosen: frozenset[Deviation]) -> float:
        if (name, chosen) not in known:
            setup = setups[name]
            for deviation in DEVIATIONS:
                setup = deviation.change(setup) if deviation in chosen else setup
            seen = setup.render().image
            same = seen.shape == images[name].shape
            known[name, chosen] = math.log((error(images[name], seen) if same else 1.0) + _FLOOR)
        return known[name, chosen]

    def total(chosen: frozenset[Deviation]) -> float:
        return sum(cost(name, chosen) for name in images)

    def descended(banned: frozenset[Deviation]) -> frozenset[Deviation]:
        chosen: frozenset[Deviation] = frozenset()
        for _ in range(most):
            trials = []
            for deviation in (other for other in DEVIATIONS if other not in banned):
                trial = frozenset(other for other in chosen if other.switch != deviation.switch) | {deviation}
                trials.append((sum(cost(name, chosen) - cost(name, trial) for name in unexplained(chosen)), trial))
            trials.sort(key=lambda entry: -entry[0])
            better = (trial for gain, trial in trials[:6] if gain > _GAIN and total(trial) < total(chosen))
            found = next(better, None)
            if found is None:
                break
            chosen = found
        return chosen

    def unexplained(chosen: frozenset[Deviation]) -> list[str]:
        return [name for name in images if cost(name, chosen) > math.log(2.5 * _FLOOR)]

    chosen = descended(frozenset())
    banned: frozenset[Deviation] = frozenset()
    for _ in range(_RESTARTS):
        if not chosen or not unexplained(chosen):
            break
        banned |= {max(chosen - banned, key=lambda deviation: total(chosen - {deviation}), default=next(iter(chosen)))}
        chosen = min(chosen, descended(banned), key=total)
    worth = {deviation: total(chosen - {deviation}) - total(chosen) for deviation in chosen}
    causes = [Cause(deviation, 10 * value / math.log(10)) for deviation, value in worth.items() if value > _GAIN]
    return sorted(causes, key=lambda cause: -cause.decibels)


# ---------------------------------------------------------------------------------------------------------- scenes


@dataclass(frozen=True, kw_only=True, eq=False)
class ConformanceScene:
    """A splat and a camera whose image shows one fact."""

    name: str
    fact: str  # what is drawn, and what a wrong renderer shows
    setup: Setup


def _grid(count: int, step: float, camera: PinholeCamera) -> Array:
    """Points of a square grid on the plane through the origin that faces the camera."""
    right, down = camera.to_world[:3, 0], camera.to_world[:3, 1]
    at = (np.arange(count) - (count - 1) / 2) * step
    return np.array([x * right + y * down for y in at for x in at])


def _apart(means: Array, camera: PinholeCamera) -> Array:
    """Points moved along their rays, so that no two depths are equal in float32."""
    eye = camera.to_world[:3, 3]
    steps = 1 + 0.0015 * (np.arange(len(means)) - (len(means) - 1) / 2)
    moved: Array = eye + (means - eye) * steps[:, None]
    return moved


def _stored(
    means: ArrayLike,
    scales: ArrayLike,
    *,
    colours: ArrayLike = (0.9, 0.7, 0.5),
    opacities: ArrayLike = 0.9,
    rotations: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    sh: Array | None = None,
) -> Splat:
    """Gaussians as a file has them, float32; scales (N,), (N, 3) or one number, the rest (N, ...) or one value."""
    means = np.asarray(means, dtype=np.float64)
    scales, opacities = np.asarray(scales, dtype=np.float64), np.broadcast_to(opacities, len(means))
    wide = np.broadcast_to(scales[..., None] if scales.ndim < 2 else scales, (len(means), 3))
    dc = (np.broadcast_to(colours, (len(means), 3)) - 0.5)[:, None] / _C0
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
    rng, pose = np.random.default_rng(0), camera.to_world
    means = pose[:3, 3] - pose[:3, 2] * rng.uniform(2, 4, (count, 1)) + rng.normal(size=(count, 3)) * 0.3
    more = _stored(means, np.full(count, 0.05), colours=rng.uniform(0.2, 0.8, (count, 3)))
    rest = np.zeros((count, stored.sh.shape[1] - 1, 3), dtype=np.float32)
    more = more._replace(sh=np.concatenate([more.sh, rest], axis=1))
    return Splat(*(np.concatenate(pair) for pair in zip(stored, more, strict=True)))


def conformance_scenes(size: int = 64) -> list[ConformanceScene]:
    """All scenes at images of `size` x `size` pixels.

    Sizes that matter in pixels, as of the low-pass filter, stay the same in pixels.
    """
    rng, pixel = np.random.default_rng(1), 64 / size
    camera = look_at(EYE, (0, 0, 0), focal=1.2 * size, width=size, height=size)
    found: list[ConformanceScene] = []

    def add(name: str, fact: str, stored: Splat, view: PinholeCamera = camera, **more: Any) -> None:
        apart = stored if more.pop("as_they_are", False) else stored._replace(means=_float(_apart(stored.means, view)))
        found.append(
            ConformanceScene(name=name, fact=fact, setup=Setup(stored=_padded(apart, view), camera=view, **more))
        )

    three, colours = _grid(3, 0.8, camera), rng.uniform(0.3, 1, (9, 3))
    unit = rng.normal(size=(9, 4))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    long = np.tile([0.3, 0.11, 0.05], (9, 1))
    add(
        "quaternion",
        "Nine ellipsoids, each turned differently; quaternions are w, x, y, z and turn the Gaussian into the world.",
        _stored(three, long, rotations=unit, colours=colours, opacities=0.95),
    )
    add(
        "quaternion_length",
        "The same with quaternions of length 0.5 to 3, which have to be divided out.",
        _stored(three, long, rotations=unit * np.linspace(0.5, 3, 9)[:, None], colours=colours, opacities=0.95),
    )
    add(
        "activation",
        "Scales are stored as logarithms and opacities as logits; nine sizes and nine opacities.",
        _stored(three, np.geomspace(0.04, 0.35, 9), opacities=np.linspace(0.1, 0.95, 9)),
    )
    _add_colours(add, camera, rng)
    _add_blending(add, camera, pixel, size)
    _add_geometry(add, camera, pixel, size, rng)
    return found


def _float(values: Array) -> Array:
    return values.astype(np.float32)


def _add_colours(add: Callable[..., None], camera: PinholeCamera, rng: np.random.Generator) -> None:
    for degree in (1, 2, 3):
        count = 2 * degree + 1
        bands = np.zeros((2 * count, (degree + 1) ** 2 - 1, 3))
        bands[np.arange(2 * count), degree**2 - 1 + np.arange(2 * count) % count] = (0.45, -0.3, 0.2)
        bands[count:] *= -0.7
        where = _grid(4, 0.62, camera)[: 2 * count]
        fact = f"Each Gaussian has one coefficient of band {degree}, evaluated from the camera towards its mean."
        add(f"sh_{degree}", fact, _stored(where, 0.22, colours=(0.5, 0.5, 0.5), opacities=0.97, sh=bands))
    add(
        "sh_layout",
        "All 45 higher coefficients differ, so that a reader that mixes channels and coefficients shows other colours.",
        _stored(_grid(3, 0.8, camera), 0.3, colours=(0.5, 0.5, 0.5), sh=rng.normal(size=(9, 15, 3)) * 0.15),
    )
    two = _grid(2, 1.0, camera)
    pairs = np.concatenate([two, two * 0.9 + np.array(EYE) * 0.2])
    behind = [[0.9, 0.9, 0.9], [0.6, 0.9, 0.3], [0.4, 0.5, 0.9], [0.9, 0.7, 0.9]]
    dark = [[-0.6, 0.4, 0.4], [0.3, -0.9, 0.6], [0.4, 0.3, -0.7], [-0.5, -0.5, -0.5]]
    sizes, alphas = np.repeat([0.42, 0.3], 4), np.repeat([0.95, 0.8], 4)
    add(
        "below_0",
        "Colours below 0 count as 0; not clamped, they darken what is behind them.",
        _stored(pairs, sizes, colours=behind + dark, opacities=alphas),
    )
    bright = [[1.8, 0.4, 0.4], [0.3, 2.5, 0.6], [0.4, 0.3, 1.6], [3.0, 3.0, 3.0]]
    add(
        "above_1",
        "Colours above 1 are blended as they are and clipped at the end; clamped first, they are darker.",
        _stored(pairs, sizes, colours=behind + bright, opacities=alphas / 2),
    )
    greys = np.linspace(0.05, 0.95, 9)[:, None] * np.ones(3)
    three = _grid(3, 0.8, camera)
    add(
        "colour_space",
        "Half-transparent greys before greys; colours are blended as sRGB values, without decoding.",
        _stored(
            np.concatenate([three, three + np.array(EYE) * 0.1]),
            np.repeat([0.33, 0.3], 9),
            colours=np.concatenate([greys, greys[::-1]]),
            opacities=np.repeat([0.95, 0.5], 9),
        ),
    )
    add(
        "background",
        "Half-transparent Gaussians before a coloured background.",
        _stored(three, 0.35, colours=(0.2, 0.3, 0.8), opacities=np.linspace(0.2, 0.9, 9)),
        background=(0.9, 0.6, 0.1),
    )


def _add_blending(add: Callable[..., None], camera: PinholeCamera, pixel: float, size: int) -> None:
    wide = look_at((0, -3, 0), (0, 0, 0), focal=0.55 * size, width=size, height=size)
    means, colours = list[tuple[float, float, float]](), list[tuple[float, float, float]]()
    for x in (-1.7, 1.7):
        for z in (-1.5, 0.0, 1.5):
            means += [(x, -0.9, z), (0.86 * x, -0.78, 0.86 * z)]  # the second is deeper, and yet nearer to the eye
            colours += [(1.0, 0.3, 0.1), (0.1, 0.4, 1.0)]
    add(
        "order",
        "Pairs of which the red one has the smaller depth, and the blue one the smaller distance: red is in front.",
        _stored(means, 0.34, colours=colours, opacities=0.85),
        wide,
        as_they_are=True,
    )
    three = _grid(3, 0.8, camera)
    towards = np.array(EYE)
    add(
        "front_to_back",
        "The file lists nine red Gaussians behind nine green ones first; what is nearer covers, whatever the order.",
        _stored(
            np.concatenate([three, three + 0.15 * towards]),
            np.repeat([0.3, 0.2], 9),
            colours=np.repeat([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2]], 9, axis=0),
            opacities=np.concatenate([np.full(9, 0.95), np.linspace(0.2, 0.95, 9)]),
        ),
    )
    level = look_at((0, -3, 0), (0, 0, 0), focal=1.2 * size, width=size, height=size)
    ties = [(x, 0.0, z) for z in (-0.6, 0.6) for x in (-0.7, -0.5, 0.5, 0.7)]
    add(
        "equal_depths",
        "Pairs at one depth: the Gaussian that comes first in the file is in front.",
        _stored(ties, 0.28, colours=[(0.9, 0.2, 0.1), (0.1, 0.3, 0.9)] * 4, opacities=0.8),
        level,
        as_they_are=True,
    )
    add(
        "cut_off",
        "A Gaussian ends where its alpha falls below 1/255, and not at a number of standard deviations.",
        _stored(
            np.tile(three, (4, 1)),
            np.repeat([0.2, 0.21, 0.22, 0.23], 9),
            colours=(1, 0.8, 0.6),
            opacities=np.repeat([0.9, 0.99, 0.03, 0.02], 9),
        ),
    )
    add(
        "faint",
        "Thirty layers of opacity 1/300 are not drawn at all, since each is below 1/255.",
        _stored(np.tile([[0.0, 0, 0], [0.5, 0.3, 0.3]], (30, 1)), 0.3, opacities=np.tile([1 / 300, 1 / 200], 30)),
    )
    add(
        "largest_alpha",
        "Alpha is at most 0.99: through an opaque black Gaussian a hundredth of nine bright ones shines.",
        _stored(
            np.concatenate([[0.1 * towards], three]),
            np.concatenate([[6.0], np.full(9, 0.28)]),
            colours=np.concatenate([np.full((1, 3), 0.02), np.tile([22.0, 16.0, 12.0], (9, 1))]),
            opacities=np.concatenate([[0.99999], np.full(9, 0.9)]),
        ),
    )
    add(
        "overdraw",
        "Three hundred Gaussians over one place; a pixel takes no more when less than 1/10,000 of the light is left.",
        _stored(
            np.tile(three[[0, 4, 8]], (100, 1)),
            0.25,
            colours=np.linspace(0, 1, 300)[:, None] * (1, 0.6, 0.3),
            opacities=np.tile([0.05, 0.2, 0.6], 100),
        ),
    )
    dots = np.geomspace(0.002, 0.05, 25) * pixel
    add(
        "low_pass",
        "Dots from a twentieth of a pixel up, each widened by 0.3 pixels^2, without lowering its opacity.",
        _stored(_grid(5, 0.5, camera), dots, colours=(1, 0.9, 0.8)),
    )


def _add_geometry(
    add: Callable[..., None], camera: PinholeCamera, pixel: float, size: int, rng: np.random.Generator
) -> None:
    inside = look_at((0, 0, 0), (0, 1, 0), focal=1.2 * size, width=size, height=size)
    depths = np.array([0.05, 0.12, 0.18, 0.22, 0.3, 0.5, 1.5, 3.0])
    sides = np.array([(-0.28 + 0.56 * (i % 2), 1.0, 0.3 - 0.2 * (i // 2)) for i in range(8)])
    add(
        "near_plane",
        "Gaussians at depths of 0.05 to 3: those before 0.2 are left out.",
        _stored(sides * depths[:, None], depths * 0.06, colours=rng.uniform(0.3, 1, (8, 3)), opacities=0.95),
        inside,
        as_they_are=True,
    )
    mirrored = np.concatenate([sides[4:], -sides[:4]])
    add(
        "behind",
        "Four bright Gaussians before the camera, and four behind it that must not show.",
        _stored(mirrored, 0.08, colours=np.repeat([[0.2, 0.7, 0.3], [1, 0.2, 0.2]], 4, axis=0), opacities=0.95),
        inside,
    )
    dot = 2.2 * pixel / (1.2 * 64) * float(np.linalg.norm(EYE)) * 0.7
    off = replace(camera, fy=0.95 * size, cx=0.42 * size, cy=0.56 * size)
    for name, fact, view in (
        ("pixel_centres", "Sharp dots; the first pixel's centre is at 0.5.", camera),
        ("principal_point", "The same with a principal point off the centre and two focal lengths.", off),
    ):
        scattered = _grid(5, 0.42, camera) + 0.01 * rng.normal(size=(25, 3))
        add(name, fact, _stored(scattered, dot, colours=rng.uniform(0.4, 1, (25, 3)), opacities=0.97), view)
    right, down = camera.to_world[:3, 0], camera.to_world[:3, 1]
    letter = np.array([i * 0.2 * down for i in range(-4, 5)] + [0.8 * down + i * 0.2 * right for i in range(1, 4)])
    add(
        "orientation",
        "A letter L, red above: neither mirrored nor turned.",
        _stored(
            letter, 0.1, colours=np.where(np.arange(12)[:, None] < 3, (0.9, 0.1, 0.1), (0.8, 0.8, 0.8)), opacities=0.97
        ),
    )
    angle = look_at((0, -2, 0), (0, 0, 0), focal=0.42 * size, width=size, height=size)
    spread = np.array([(x, 0.0, z) for x in (-4.4, -1.9, 0.0, 1.9, 4.4) for z in (-2.0, -1.2, 1.2, 2.0)])
    edge = np.where(np.abs(spread[:, :1]) > 4, (0.9, 0.5, 0.1), (0.12, 0.7, 0.12))
    add(
        "wide_angle",
        "Gaussians at the edge of a wide image and beyond; their Jacobian is taken at most 1.3 half fields off.",
        _stored(spread, edge, colours=rng.uniform(0.3, 1, (20, 3)), opacities=0.8),
        angle,
    )
    turns = np.linspace(0, math.pi, 9) / 2
    spin = np.stack([np.cos(turns), np.sin(turns), np.zeros(9), np.zeros(9)], axis=1)
    three = _grid(3, 0.8, camera)
    shapes = {
        "needles": ("Needles a hundred times as long as wide.", (0.4, 0.004, 0.004)),
        "discs": ("Discs without thickness, as of 2DGS.", (0.3, 0.2, 1e-6)),
        "huge": ("Gaussians larger than the image.", (6.0, 4.0, 3.0)),
    }
    for name, (fact, scales) in shapes.items():
        alphas = 0.3 if name == "huge" else 0.95
        add(
            name,
            fact,
            _stored(
                three, np.tile(scales, (9, 1)), rotations=spin, opacities=alphas, colours=rng.uniform(0.3, 1, (9, 3))
            ),
        )


# -------------------------------------------------------------------------------------------------------------- tests


def random_splat(count: int, *, degree: int, seed: int) -> Splat:
    """Gaussians on a noisy unit sphere, among them needles, discs, huge and tiny ones, float64."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0.7, 1.2, (count, 1))
    scales = 0.06 * np.exp(rng.normal(size=(count, 3)) * 0.5)
    kind = rng.integers(0, 12, count)
    for number, factors in enumerate(([20.0, 0.05, 0.05], [4.0, 4.0, 0.01], [0.02] * 3, [6.0] * 3)):
        scales[kind == number] *= factors
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    opacities = np.where(kind == 4, 1.0, rng.uniform(0.0, 1.0, count))
    return Splat(means, scales, rotations, opacities, rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3)


def assert_renders_like_3dgs(
    render_image: Callable[[Splat, PinholeCamera], ArrayLike],
    *,
    tolerance: float = 1e-4,
    sh_degree: int = 3,
    convention: Convention = DEFAULT,
) -> None:
    """Hold a renderer to the definition, for use in a test.

    Args:
        render_image: Takes float32 Gaussians and a camera, and returns (H, W, 3) on black.
        tolerance: Largest difference in any channel of any pixel; float32 renderers reach 1e-5.
        sh_degree: Highest degree that the renderer knows.
        convention: Choices that the renderer is meant to make.

    Raises:
        AssertionError: An image differs; says in which scene, where, and by how much.
    """
    for degree in range(sh_degree + 1):
        splat = Splat(*(value.astype(np.float32) for value in random_splat(150, degree=degree, seed=degree)))
        for distance in (3.0, 0.5):  # from outside, and from within
            eye = distance * np.array([math.cos(degree), math.sin(degree), 0.4])
            camera = look_at(eye, (0, 0, 0), focal=58.0, width=61, height=43)
            camera = replace(camera, fy=52.0, cx=27.0)
            wanted = render(splat, camera, convention=convention).image
            got = np.asarray(render_image(splat, camera), dtype=np.float64)
            where = f"150 Gaussians of SH degree {degree} from a distance of {distance}"
            assert got.shape == wanted.shape, f"{where}: expected an image {wanted.shape}, got {got.shape}"
            error = np.abs(got - wanted).max(-1)
            row, column = np.unravel_index(np.argmax(error), error.shape)
            colours = f"{wanted[row, column].round(4).tolist()}, got {got[row, column].round(4).tolist()}"
            at = f"{error.max():.3g} at row {row}, column {column}, where the colour is {colours}"
            assert error.max() <= tolerance, f"{where}: expected differences up to {tolerance:g}, got {at}"
