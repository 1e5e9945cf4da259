"""Whether a renderer makes the image of 3D Gaussian Splatting, and what it does
differently; NumPy alone.

A `ConformanceScene` is a small splat whose image shows one fact of the definition in
`mi_splat.oracle`. A `Deviation` is one thing that renderers and readers do differently.
`find_deviations` explains images: it searches for the deviations under which the oracle
makes them. `assert_renders_like_3dgs` is for tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.maths.srgb import to_linear, to_srgb
from mi_splat.oracle import (
    DEFAULT,
    Array,
    Convention,
    Image,
    PinholeCamera,
    Splat,
    project,
    render,
)

C0 = 0.28209479177387814
_FLOOR = 2e-6
_GAIN = 0.35
_RESTARTS = 2
_AT_ONCE = 12
"""Mean squared error of 8 bits; least gain of the summed log errors by which a
deviation explains something; searches without what was found first, where images stay
unexplained; images that each step tries to explain, the worst ones.
"""


def look_at(
    eye: ArrayLike,
    target: ArrayLike,
    *,
    focal: float,
    width: int,
    height: int,
    up: ArrayLike = (0.0, 0.0, 1.0),
) -> PinholeCamera:
    """The camera at `eye` that looks at `target`; where it looks along `up`, y is up in
    its image.
    """
    position = np.asarray(eye, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        _upright(np.asarray(target, dtype=np.float64) - position, up),
        position,
    )
    return PinholeCamera(
        to_world=pose,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        width=width,
        height=height,
    )


def _upright(forward: Array, up: ArrayLike) -> Array:
    """(3, 3) axes x right, y down and z forward of a camera."""
    right = np.cross(forward, np.asarray(up))
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):
        right = np.cross(forward, np.roll(np.asarray(up), -1))
    axes: Array = np.stack([right, np.cross(forward, right), forward], axis=1)
    axes /= np.linalg.norm(axes, axis=0)
    return axes


# --------------------------------------------------------------------------- deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """What decides about an image: the file, the camera, and what a renderer makes of
    them.
    """

    # as a PLY file has it: logarithms of scales, logits of opacities, quaternions as w,
    # x, y, z
    stored: Splat
    camera: PinholeCamera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    convention: Convention = DEFAULT
    scales: Callable[[Array], Array] = np.exp
    opacities: Callable[[Array], Array] = field(
        default=lambda logits: 1 / (1 + np.exp(-logits))
    )
    before: Callable[[Array], Array] | None = None  # of colours before they are blended
    after: Callable[[Array], Array] | None = None  # of the finished image

    @property
    def splat(self) -> Splat:
        """The Gaussians as values, without those that are not finite or have no
        rotation.
        """
        stored = Splat(*(values.astype(np.float64) for values in self.stored))
        rows = [values.reshape(len(values), -1) for values in stored]
        whole = np.all(
            [np.isfinite(values).all(axis=1) for values in rows], axis=0
        ) & rows[2].any(axis=1)
        stored = Splat(*(values[whole] for values in stored))
        return stored._replace(
            scales=self.scales(stored.scales),
            opacities=self.opacities(stored.opacities),
        )

    # a wrong camera may have Gaussians beside it, at a depth of 0
    @np.errstate(divide="ignore", invalid="ignore")
    def render(self) -> Image:
        """What the renderer shows."""
        splat = self.splat
        background = np.array(self.background)
        convention = self.convention
        if self.before is not None:
            colours = self.before(project(splat, self.camera, convention).colour)
            splat = splat._replace(sh=(colours[:, None] - 0.5) / C0)
            background = self.before(background)
            convention = replace(convention, clamp="none")
        seen = render(splat, self.camera, background=background, convention=convention)
        if self.after is None:
            return seen
        return seen._replace(image=self.after(seen.image))


class Deviation(NamedTuple):
    """What a renderer or a reader does differently."""

    switch: str  # of all with the same one, at most one holds
    value: str
    kind: Literal["wrong", "another choice", "camera"]
    change: Callable[[Setup], Setup]


def _convention(**choices: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, convention=replace(setup.convention, **choices))


def _camera(
    change: Callable[[PinholeCamera], PinholeCamera],
) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, camera=change(setup.camera))


def _file(change: Callable[[Splat], Splat]) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, stored=change(setup.stored))


def _setup(**changes: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, **changes)


def _by_coefficient(splat: Splat) -> Splat:
    """SH that are stored channel by channel, read coefficient by coefficient."""
    rest = splat.sh[:, 1:].transpose(0, 2, 1).reshape(len(splat.sh), -1, 3)
    return splat._replace(sh=np.concatenate([splat.sh[:, :1], rest], axis=1))


def _odd_signs(splat: Splat) -> Splat:
    """SH without the Condon-Shortley phase."""
    orders = np.concatenate([np.arange(-degree, degree + 1) for degree in range(4)])[
        : splat.sh.shape[1]
    ]
    return splat._replace(sh=splat.sh * np.where(orders % 2, -1, 1)[:, None])


def _turned(matrix: ArrayLike) -> Callable[[Setup], Setup]:
    """A world of other axes, which is a camera of the inverse ones."""
    turn = np.eye(4)
    turn[:3, :3] = np.asarray(matrix).T
    return _camera(lambda camera: replace(camera, to_world=turn @ camera.to_world))


def _with_up(*up: float) -> Callable[[Setup], Setup]:
    """A camera that is told by its position and where it looks."""

    def change(camera: PinholeCamera) -> PinholeCamera:
        pose = camera.to_world.copy()
        pose[:3, :3] = _upright(pose[:3, 2], up)
        return replace(camera, to_world=pose)

    return _camera(change)


def _unrotated(splat: Splat) -> Splat:
    """Quaternions of zeros as no rotation."""
    empty = ~splat.rotations.any(axis=1, keepdims=True)
    return splat._replace(
        rotations=np.where(empty, (1.0, 0.0, 0.0, 0.0), splat.rotations)
    )


def _in_16_bits(splat: Splat) -> Splat:
    return splat._replace(means=splat.means.astype(np.float16))


_QUATERNIONS = {
    "read as x, y, z, w": lambda splat: splat._replace(
        rotations=splat.rotations[:, [3, 0, 1, 2]]
    ),
    "conjugated": lambda splat: splat._replace(
        rotations=splat.rotations * [1, -1, -1, -1]
    ),
    "w made positive": lambda splat: splat._replace(
        rotations=np.concatenate(
            [np.abs(splat.rotations[:, :1]), splat.rotations[:, 1:]], axis=1
        )
    ),
}
_LIGHT = {"before": to_linear, "after": to_srgb}

DEVIATIONS = (
    *(
        Deviation("quaternions", value, "wrong", _file(change))
        for value, change in _QUATERNIONS.items()
    ),
    Deviation(
        "length of quaternions",
        "not divided out",
        "wrong",
        _convention(unit_rotations=False),
    ),
    Deviation(
        "broken rows",
        "a quaternion of zeros taken as no rotation",
        "another choice",
        _file(_unrotated),
    ),
    Deviation(
        "broken rows",
        "NaN taken as 0",
        "wrong",
        _file(lambda splat: Splat(*map(np.nan_to_num, splat))),
    ),
    Deviation("positions", "in 16 bits", "another choice", _file(_in_16_bits)),
    Deviation("scales", "not exponentiated", "wrong", _setup(scales=np.abs)),
    Deviation(
        "opacities",
        "not through a sigmoid",
        "wrong",
        _setup(opacities=lambda values: np.clip(values, 0, 1)),
    ),
    Deviation(
        "SH coefficients",
        "read coefficient by coefficient",
        "wrong",
        _file(_by_coefficient),
    ),
    Deviation(
        "signs of SH", "without the Condon-Shortley phase", "wrong", _file(_odd_signs)
    ),
    Deviation(
        "direction of SH",
        "from Gaussian to camera",
        "wrong",
        _convention(towards="camera"),
    ),
    Deviation(
        "direction of SH",
        "in the camera's frame",
        "wrong",
        _convention(towards="camera's frame"),
    ),
    Deviation(
        "direction of SH",
        "the optical axis",
        "wrong",
        _convention(towards="optical axis"),
    ),
    *(
        Deviation(
            "degree of SH",
            f"at most {degree}",
            "another choice",
            _convention(sh_degree=degree),
        )
        for degree in (0, 1, 2)
    ),
    Deviation("clamp of colours", "none", "wrong", _convention(clamp="none")),
    Deviation(
        "clamp of colours",
        "to 0 to 1",
        "another choice",
        _convention(clamp="outside 0 to 1"),
    ),
    Deviation(
        "colour space", "blended in linear light", "another choice", _setup(**_LIGHT)
    ),
    Deviation("colour space", "encoded twice", "wrong", _setup(after=to_srgb)),
    Deviation("colour space", "decoded, not encoded", "wrong", _setup(after=to_linear)),
    Deviation(
        "order",
        "by distance, not by depth",
        "another choice",
        _convention(order="distance"),
    ),
    Deviation("order", "that of the file", "wrong", _convention(order="file")),
    Deviation("low-pass filter", "none", "another choice", _convention(low_pass=0.0)),
    Deviation(
        "low-pass filter", "0.1 pixels^2", "another choice", _convention(low_pass=0.1)
    ),
    Deviation(
        "low-pass filter", "1 pixel^2", "another choice", _convention(low_pass=1.0)
    ),
    Deviation(
        "compensation",
        "opacity lowered for the filter",
        "another choice",
        _convention(compensated=True),
    ),
    *(
        Deviation(
            "cut-off",
            f"at {text} standard deviations",
            "another choice",
            _convention(cutoff=value),
        )
        for text, value in (("2", 2.0), ("sqrt(8)", 8**0.5), ("3", 3.0))
    ),
    Deviation("least alpha", "none", "another choice", _convention(min_alpha=0.0)),
    Deviation("largest alpha", "1", "another choice", _convention(max_alpha=1.0)),
    Deviation("largest alpha", "0.999", "another choice", _convention(max_alpha=0.999)),
    Deviation(
        "limit of the Jacobian",
        "none",
        "another choice",
        _convention(tangent_limit=math.inf),
    ),
    *(
        Deviation("near plane", f"at {near:g}", "camera", _convention(near=near))
        for near in (0.01, 0.1, 1.0)
    ),
    Deviation(
        "pixel centres", "at whole numbers", "camera", _convention(pixel_centre=0.0)
    ),
    Deviation(
        "pixel centres", "a whole pixel off", "camera", _convention(pixel_centre=1.0)
    ),
    Deviation(
        "principal point",
        "ignored",
        "camera",
        _camera(lambda c: replace(c, cx=c.width / 2, cy=c.height / 2)),
    ),
    Deviation(
        "focal lengths", "fx for both", "camera", _camera(lambda c: replace(c, fy=c.fx))
    ),
    Deviation(
        "focal lengths", "fy for both", "camera", _camera(lambda c: replace(c, fx=c.fy))
    ),
    Deviation(
        "focal lengths",
        "horizontal field of view taken as the vertical one",
        "camera",
        _camera(
            lambda c: replace(
                c, fx=c.fx * c.height / c.width, fy=c.fy * c.height / c.width
            )
        ),
    ),
    *(
        Deviation("camera's up", f"always {axis}", "camera", _with_up(*up))
        for axis, up in (("z", (0, 0, 1)), ("y", (0, 1, 0)))
    ),
    Deviation(
        "axes", "turned by 180 degrees about x", "wrong", _turned(np.diag([1, -1, -1]))
    ),
    Deviation(
        "axes", "turned by 180 degrees about z", "wrong", _turned(np.diag([-1, -1, 1]))
    ),
    Deviation(
        "axes",
        "y up instead of z",
        "wrong",
        _turned([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ),
    Deviation("axes", "x mirrored", "wrong", _turned(np.diag([-1, 1, 1]))),
    Deviation(
        "orientation", "mirrored", "camera", _setup(after=lambda image: image[:, ::-1])
    ),
    Deviation(
        "orientation", "upside down", "camera", _setup(after=lambda image: image[::-1])
    ),
    Deviation(
        "orientation",
        "turned by 180 degrees",
        "camera",
        _setup(after=lambda image: image[::-1, ::-1]),
    ),
    Deviation("background", "black", "wrong", _setup(background=(0.0, 0.0, 0.0))),
    Deviation("background", "white", "wrong", _setup(background=(1.0, 1.0, 1.0))),
)


class Cause(NamedTuple):
    """A deviation that explains images, and by how much their summed error grows
    without it.
    """

    deviation: Deviation
    decibels: float


def error(image: Array, reference: Array) -> float:
    """Mean squared error of an image as a screen shows it."""
    return float(np.mean((np.clip(image, 0, 1) - np.clip(reference, 0, 1)) ** 2))


def find_deviations(
    images: Mapping[str, Array], setups: Mapping[str, Setup], *, most: int = 8
) -> list[Cause]:
    """The deviations under which the oracle makes the images, the one that explains
    most first.

    Coordinate descent over the switches: each round adds the deviation that lowers the
    summed logarithm of the errors most, and at the end those that explain nothing are
    dropped. Where images stay unexplained, it begins again without the deviation that
    explained most.

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
            known[name, chosen] = math.log(
                (error(images[name], seen) if same else 1.0) + _FLOOR
            )
        return known[name, chosen]

    def total(chosen: frozenset[Deviation]) -> float:
        return sum(cost(name, chosen) for name in images)

    def descended(banned: frozenset[Deviation]) -> frozenset[Deviation]:
        chosen: frozenset[Deviation] = frozenset()
        every = [deviation for deviation in DEVIATIONS if deviation not in banned]
        tried = every
        for _ in range(2 * most):
            sets = {
                d: (
                    frozenset(other for other in chosen if other.switch != d.switch)
                    | {d}
                )
                for d in tried
            }
            gains = {
                d: [
                    cost(name, chosen) - cost(name, sets[d])
                    for name in unexplained(chosen)
                ]
                for d in tried
            }
            best = sorted(tried, key=lambda d: -sum(gains[d]))[:6]
            better = (
                sets[d]
                for d in best
                if sum(gains[d]) > _GAIN and total(sets[d]) < total(chosen)
            )
            found = next(better, None)
            if found is None and len(tried) == len(every):
                break
            # All are tried again at the end; until then those that explain some image
            # better.
            if found is None:
                tried = every
            else:
                tried = [d for d in tried if max(gains[d], default=0.0) > _GAIN]
            chosen = chosen if found is None else found
        return chosen

    def unexplained(chosen: frozenset[Deviation]) -> list[str]:
        left = [name for name in images if cost(name, chosen) > math.log(2.5 * _FLOOR)]
        return sorted(left, key=lambda name: -cost(name, chosen))[:_AT_ONCE]

    chosen = descended(frozenset())
    banned: frozenset[Deviation] = frozenset()
    for _ in range(_RESTARTS):
        if not chosen or not unexplained(chosen):
            break
        banned |= {
            max(
                chosen - banned,
                key=lambda deviation: total(chosen - {deviation}),
                default=next(iter(chosen)),
            )
        }
        chosen = min(chosen, descended(banned), key=total)
    worth = {
        deviation: total(chosen - {deviation}) - total(chosen) for deviation in chosen
    }
    causes = [
        Cause(deviation, 10 * value / math.log(10))
        for deviation, value in worth.items()
        if value > _GAIN
    ]
    return sorted(causes, key=lambda cause: -cause.decibels)


# -------------------------------------------------------------------------------- tests


def random_splat(count: int, *, degree: int, seed: int) -> Splat:
    """Gaussians on a noisy unit sphere, among them needles, discs, huge and tiny ones,
    float64.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = (
        directions
        / np.linalg.norm(directions, axis=1, keepdims=True)
        * rng.uniform(0.7, 1.2, (count, 1))
    )
    scales = 0.06 * np.exp(rng.normal(size=(count, 3)) * 0.5)
    kind = rng.integers(0, 12, count)
    for number, factors in enumerate(
        ([20.0, 0.05, 0.05], [4.0, 4.0, 0.01], [0.02] * 3, [6.0] * 3)
    ):
        scales[kind == number] *= factors
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    opacities = np.where(kind == 4, 1.0, rng.uniform(0.0, 1.0, count))
    return Splat(
        means,
        scales,
        rotations,
        opacities,
        rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def assert_renders_like_3dgs(
    render_image: Callable[[Splat, PinholeCamera], ArrayLike],
    *,
    tolerance: float = 1e-4,
    sh_degree: int = 3,
    convention: Convention = DEFAULT,
) -> None:
    """Hold a renderer to the definition, for use in a test.

    Args:
        render_image: Takes float32 Gaussians and a camera, and returns (H, W, 3) on
            black.
        tolerance: Largest difference in any channel of any pixel; float32 renderers
            reach 1e-5.
        sh_degree: Highest degree that the renderer knows.
        convention: Choices that the renderer is meant to make.

    Raises:
        AssertionError: An image differs; says in which scene, where, and by how much.
    """
    for degree in range(sh_degree + 1):
        splat = Splat(
            *(
                value.astype(np.float32)
                for value in random_splat(150, degree=degree, seed=degree)
            )
        )
        for distance in (3.0, 0.5):  # from outside, and from within
            eye = distance * np.array([math.cos(degree), math.sin(degree), 0.4])
            camera = look_at(eye, (0, 0, 0), focal=58.0, width=61, height=43)
            camera = replace(camera, fy=52.0, cx=27.0)
            wanted = render(splat, camera, convention=convention).image
            got = np.asarray(render_image(splat, camera), dtype=np.float64)
            where = f"150 Gaussians of SH degree {degree} from a distance of {distance}"
            assert got.shape == wanted.shape, (
                f"{where}: expected an image {wanted.shape}, got {got.shape}"
            )
            error = np.abs(got - wanted).max(-1)
            row, column = np.unravel_index(np.argmax(error), error.shape)
            colours = (
                f"{wanted[row, column].round(4).tolist()}, got"
                f" {got[row, column].round(4).tolist()}"
            )
            at = (
                f"{error.max():.3g} at row {row}, column {column}, where the colour is"
                f" {colours}"
            )
            assert error.max() <= tolerance, (
                f"{where}: expected differences up to {tolerance:g}, got {at}"
            )
