"""What renderers and readers do differently from 3D Gaussian Splatting, and the
profiles that some of them mean to have.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.conformance.setups import Setup, upright
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.maths.srgb import to_linear, to_srgb
from mi_splat.oracle import Array, PinholeCamera, Splat

Kind = Literal["wrong", "another choice", "camera"]


class Deviation(NamedTuple):
    """What a renderer or a reader does differently."""

    key: str  # switch=value; of all with the same switch, at most one holds
    text: str
    kind: Kind
    change: Callable[[Setup], Setup]

    @property
    def switch(self) -> str:
        """What it sets."""
        return self.key.partition("=")[0]


DEVIATIONS: dict[str, Deviation] = {}
"""By key, in the order in which they are applied."""


def _add(key: str, text: str, kind: Kind, change: Callable[[Setup], Setup]) -> None:
    DEVIATIONS[key] = Deviation(key, text, kind, change)


def changes(setup: Setup, deviation: Deviation) -> bool:
    """Whether a setup becomes another one by a deviation; false where it is so
    already.
    """
    changed = deviation.change(setup)
    if changed.convention != setup.convention:
        return True
    names = (field.name for field in fields(Setup) if field.name != "convention")
    return any(getattr(changed, name) is not getattr(setup, name) for name in names)


def applied(setup: Setup, keys: Iterable[str]) -> Setup:
    """The setup of a renderer with these deviations."""
    chosen = set(keys)
    for key, deviation in DEVIATIONS.items():
        if key in chosen:
            setup = deviation.change(setup)
    return setup


# ----------------------------------------------------------------------- what changes


def _setup(**changes: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, **changes)


def _convention(**choices: Any) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, convention=replace(setup.convention, **choices))


def _file(change: Callable[[Splat], Splat]) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, stored=change(setup.stored))


def _sh(change: Callable[[Array], Array]) -> Callable[[Setup], Setup]:
    """A change of all 16 coefficients (N, 16, 3), as many as there are are kept."""

    def changed(splat: Splat) -> Splat:
        count = splat.sh.shape[1]
        rest = np.zeros((len(splat.sh), 16 - count, 3))
        whole = np.concatenate([splat.sh, rest], axis=1)
        return splat._replace(sh=change(whole)[:, :count])

    return _file(changed)


def _rotations(change: Callable[[Array], Array]) -> Callable[[Setup], Setup]:
    return _file(lambda splat: splat._replace(rotations=change(splat.rotations)))


def _camera(
    change: Callable[[PinholeCamera], PinholeCamera],
) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, camera=change(setup.camera))


def _pose(change: Callable[[Array], Array]) -> Callable[[Setup], Setup]:
    return _camera(lambda camera: replace(camera, to_world=change(camera.to_world)))


def _after(change: Callable[[Array, Array], Array]) -> Callable[[Setup], Setup]:
    """A change of the finished image, after those that are made already."""

    def changed(setup: Setup) -> Setup:
        first = setup.after
        if first is None:
            return replace(setup, after=change)
        return replace(
            setup, after=lambda image, alpha: change(first(image, alpha), alpha)
        )

    return changed


def _image(change: Callable[[Array], Array]) -> Callable[[Setup], Setup]:
    return _after(lambda image, _: change(image))


# --------------------------------------------------------------------------- the file

_ORDERS = np.concatenate([np.arange(-band, band + 1) for band in range(4)])
_BANDS = np.repeat(np.arange(4), [1, 3, 5, 7])


def _w_positive(rotations: Array) -> Array:
    return np.concatenate([np.abs(rotations[:, :1]), rotations[:, 1:]], axis=1)


_add(
    "quaternions=xyzw",
    "quaternions read as x, y, z, w",
    "wrong",
    _rotations(lambda rotations: rotations[:, [3, 0, 1, 2]]),
)
_add(
    "quaternions=conjugated",
    "quaternions conjugated",
    "wrong",
    _rotations(lambda rotations: rotations * [1, -1, -1, -1]),
)
_add(
    "quaternions=w-positive",
    "w of quaternions made positive, without x, y and z",
    "wrong",
    _rotations(_w_positive),
)
_add(
    "quaternion-length=kept",
    "length of quaternions not divided out",
    "wrong",
    _convention(unit_rotations=False),
)


def _unrotated(rotations: Array) -> Array:
    empty = ~rotations.any(axis=1, keepdims=True)
    return np.where(empty, (1.0, 0.0, 0.0, 0.0), rotations)


_add(
    "broken-rows=zero-quaternions-drawn",
    "a quaternion of zeros taken as no rotation",
    "another choice",
    _rotations(_unrotated),
)
_add(
    "broken-rows=nan-as-0",
    "NaN taken as 0",
    "wrong",
    _file(lambda splat: Splat(*map(np.nan_to_num, splat))),
)
_add(
    "positions=16-bit",
    "positions in 16 bits",
    "another choice",
    _file(lambda splat: splat._replace(means=splat.means.astype(np.float16))),
)
_add("scales=linear", "scales not exponentiated", "wrong", _setup(scales=np.abs))
_add(
    "scales=variances",
    "exponentiated scales taken as variances",
    "wrong",
    _setup(scales=lambda logarithms: np.exp(0.5 * logarithms)),
)


def _stepped(steps: int) -> Callable[[Splat], Splat]:
    """Logarithms of scales in steps, which viewers store in 8 bits."""
    step = 21 / steps

    def change(splat: Splat) -> Splat:
        numbers = np.clip(np.round((splat.scales + 12) / step), 0, steps)
        return splat._replace(scales=(numbers * step - 12).astype(np.float32))

    return change


for _steps in (254, 255):
    _add(
        f"scales={_steps}-steps",
        f"logarithms of scales in {_steps} steps from -12 to 9",
        "another choice",
        _file(_stepped(_steps)),
    )
_add(
    "opacities=linear",
    "opacities not through a sigmoid",
    "wrong",
    _setup(opacities=lambda values: np.clip(values, 0, 1)),
)


def _by_coefficient(splat: Splat) -> Splat:
    rest = splat.sh[:, 1:].transpose(0, 2, 1).reshape(len(splat.sh), -1, 3)
    return splat._replace(sh=np.concatenate([splat.sh[:, :1], rest], axis=1))


_add(
    "sh-layout=by-coefficient",
    "SH read coefficient by coefficient, not channel by channel",
    "wrong",
    _file(_by_coefficient),
)
_add(
    "sh-order=xyz",
    "SH of degree 1 taken as x, y, z and not y, z, x",
    "wrong",
    _sh(lambda sh: np.concatenate([sh[:, [0, 2, 3, 1]], sh[:, 4:]], axis=1)),
)
_add(
    "sh-order=degree-2-reversed",
    "SH of degree 2 in the reverse order",
    "wrong",
    _sh(
        lambda sh: np.concatenate([sh[:, :4], sh[:, 8:3:-1], sh[:, 9:]], axis=1),
    ),
)
_add(
    "sh-signs=no-phase",
    "SH without the Condon-Shortley phase",
    "wrong",
    _sh(lambda sh: sh * np.where(_ORDERS % 2, -1, 1)[:, None]),
)


def _negated(band: int) -> Callable[[Array], Array]:
    return lambda sh: sh * np.where(band == _BANDS, -1, 1)[:, None]


for _band in (1, 2, 3):
    _add(
        f"sh-signs=degree-{_band}-negated",
        f"signs of SH of degree {_band}",
        "wrong",
        _sh(_negated(_band)),
    )

# --------------------------------------------------------------------------- colours

for _value, _towards, _text in (
    ("to-camera", "camera", "SH in the direction from Gaussian to camera"),
    ("camera-frame", "camera's frame", "SH in the direction in the camera's frame"),
    ("optical-axis", "optical axis", "SH in the direction of the optical axis"),
):
    _add(f"sh-direction={_value}", _text, "wrong", _convention(towards=_towards))
for _degree in (0, 1, 2):
    _add(
        f"sh-degree={_degree}",
        f"SH of degree {_degree} at most",
        "another choice",
        _convention(sh_degree=_degree),
    )
_add(
    "clamp=below-0",
    "colours clamped at 0",
    "another choice",
    _convention(clamp="below 0"),
)
_add("clamp=none", "colours not clamped", "wrong", _convention(clamp="none"))
_add(
    "clamp=0-1",
    "colours clamped to 0 to 1",
    "another choice",
    _convention(clamp="outside 0 to 1"),
)
_add(
    "colour-space=linear",
    "colours blended in linear light",
    "another choice",
    _setup(before=to_linear, after=lambda image, _: to_srgb(image)),
)
_add("colour-space=encoded", "image encoded as sRGB twice", "wrong", _image(to_srgb))
_add(
    "colour-space=decoded",
    "image decoded from sRGB, not encoded",
    "wrong",
    _image(to_linear),
)

# ------------------------------------------------------------------ order and coverage

_add("order=depth", "sorted by depth", "another choice", _convention(order="depth"))
_add(
    "order=distance",
    "sorted by distance, not by depth",
    "another choice",
    _convention(order="distance"),
)
_add("order=file", "not sorted", "wrong", _convention(order="file"))
_add("order=reversed", "sorted back to front", "wrong", _convention(order="reversed"))
for _bits in (8, 16):
    _add(
        f"depth-keys={_bits}-bit",
        f"sorted by depths in {_bits} bits",
        "another choice",
        _convention(depth_bits=_bits),
    )
for _variance, _text in (
    (0.0, ""),
    (0.075, ", which is 0.3 in half pixels"),
    (0.1, ""),
    (0.3, ""),
    (1.0, ""),
):
    _add(
        f"low-pass={_variance:g}",
        f"low-pass filter of {_variance:g} pixels^2{_text}",
        "another choice",
        _convention(low_pass=_variance),
    )
_add(
    "compensation=off",
    "opacity not lowered for the low-pass filter",
    "another choice",
    _convention(compensated=False),
)
_add(
    "compensation=on",
    "opacity lowered for the low-pass filter",
    "another choice",
    _convention(compensated=True),
)
_add(
    "falloff=exp(-m)",
    "exp(-m) of the squared deviations m, not exp(-m / 2)",
    "wrong",
    _convention(falloff="whole"),
)
_add(
    "falloff=normalised",
    "exponential lowered to reach 0 at sqrt(8) standard deviations",
    "another choice",
    _convention(falloff="to 0 at sqrt(8)"),
)
for _text, _variance in (("dropped", 0.5), ("smallest-dropped", 0.125)):
    _add(
        f"dots={_text}",
        f"Gaussians with variances below {_variance:g} pixels^2 not drawn",
        "another choice",
        _convention(min_variance=_variance),
    )
_add(
    "axes-of-ellipses=0.63-apart",
    "variances along the axes of an ellipse at least 2 sqrt(0.1) pixels^2 apart",
    "wrong",
    _convention(min_spread=2 * math.sqrt(0.1)),
)
_add(
    "reach=image",
    "sqrt(8) standard deviations at most as long as the image's shorter side",
    "another choice",
    _convention(max_reach=1.0),
)
_add(
    "cut-off=none",
    "Gaussians end where alpha falls below 1/255",
    "another choice",
    _convention(cutoff=math.inf),
)
for _text, _cutoff in (("2", 2.0), ("sqrt(8)", 8**0.5), ("3", 3.0)):
    _add(
        f"cut-off={_text}",
        f"Gaussians end at {_text} standard deviations",
        "another choice",
        _convention(cutoff=_cutoff),
    )
_add(
    "tiles=16",
    "drawn only in the tiles of 16 pixels that three standard deviations touch",
    "another choice",
    _convention(tile=16),
)
_add(
    "least-alpha=0",
    "alphas below 1/255 drawn",
    "another choice",
    _convention(min_alpha=0.0),
)
for _most in (0.99, 0.999, 1.0):
    _add(
        f"largest-alpha={_most:g}",
        f"alpha of {_most:g} at most",
        "another choice",
        _convention(max_alpha=_most),
    )
_add("stop=never", "no early stop", "another choice", _convention(stop=0.0))
for _text, _left in (("1/10000", 1e-4), ("1/1000", 1e-3), ("1/255", 1 / 255)):
    _add(
        f"stop={_text}",
        f"early stop at a transmittance of {_text}",
        "another choice",
        _convention(stop=_left),
    )
_add(
    "jacobian-limit=1.3",
    "Jacobian taken at most 1.3 half fields of view off",
    "another choice",
    _convention(tangent_limit=1.3),
)
_add(
    "jacobian-limit=none",
    "no limit of the Jacobian",
    "another choice",
    _convention(tangent_limit=math.inf),
)

# --------------------------------------------------------------------------- cameras

for _near in (0.01, 0.1, 0.2, 1.0):
    _add(
        f"near={_near:g}",
        f"near plane at {_near:g}",
        "camera",
        _convention(near=_near),
    )
for _value, _centre, _text in (
    ("whole-numbers", 0.0, "pixel centres at whole numbers"),
    ("one-off", 1.0, "pixel centres at whole numbers from 1"),
):
    _add(f"pixel-centres={_value}", _text, "camera", _convention(pixel_centre=_centre))


def _shifted(x: float, y: float) -> Callable[[PinholeCamera], PinholeCamera]:
    return lambda camera: replace(camera, cx=camera.cx + x, cy=camera.cy + y)


for _value, _x, _y in (
    ("left", -1.0, 0.0),
    ("right", 1.0, 0.0),
    ("up", 0.0, -1.0),
    ("down", 0.0, 1.0),
):
    _add(
        f"shift={_value}",
        f"image a pixel further {_value}",
        "camera",
        _camera(_shifted(_x, _y)),
    )
_add(
    "principal-point=centre",
    "principal point ignored",
    "camera",
    _camera(lambda c: replace(c, cx=c.width / 2, cy=c.height / 2)),
)
_add(
    "focal-lengths=fx",
    "horizontal focal length taken for both",
    "camera",
    _camera(lambda c: replace(c, fy=c.fx)),
)
_add(
    "focal-lengths=fy",
    "vertical focal length taken for both",
    "camera",
    _camera(lambda c: replace(c, fx=c.fy)),
)


def _horizontal_as_vertical(camera: PinholeCamera) -> PinholeCamera:
    focal = camera.fx * camera.height / camera.width
    return replace(camera, fx=focal, fy=focal)


_add(
    "focal-lengths=horizontal-fov",
    "horizontal field of view taken as the vertical one",
    "camera",
    _camera(_horizontal_as_vertical),
)


def _with_up(pose: Array, up: ArrayLike) -> Array:
    changed = pose.copy()
    changed[:3, :3] = upright(pose[:3, 2], up)
    return changed


_add(
    "up=z",
    "camera's up always z",
    "camera",
    _pose(lambda pose: _with_up(pose, (0, 0, 1))),
)
_add(
    "up=y",
    "camera's up always y",
    "camera",
    _pose(lambda pose: _with_up(pose, (0, 1, 0))),
)


def _transposed(pose: Array) -> Array:
    changed = pose.copy()
    changed[:3, :3] = pose[:3, :3].T
    return changed


_add("pose=inverted", "camera's pose inverted", "camera", _pose(np.linalg.inv))
_add("pose=transposed", "camera's rotation transposed", "camera", _pose(_transposed))


def _turned(matrix: ArrayLike) -> Callable[[Setup], Setup]:
    """A world of other axes, which is a camera of the inverse ones."""
    turn = np.eye(4)
    turn[:3, :3] = np.asarray(matrix).T
    return _pose(lambda pose: turn @ pose)


_add(
    "axes=about-x",
    "world turned by 180 degrees about x",
    "wrong",
    _turned(np.diag([1, -1, -1])),
)
_add(
    "axes=about-z",
    "world turned by 180 degrees about z",
    "wrong",
    _turned(np.diag([-1, -1, 1])),
)
_add(
    "axes=y-up",
    "world's y up instead of z",
    "wrong",
    _turned([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
)
_add("axes=x-mirrored", "world mirrored along x", "wrong", _turned(np.diag([-1, 1, 1])))

# ---------------------------------------------------------------------------- images

_add(
    "orientation=mirrored",
    "image mirrored",
    "camera",
    _setup(mirrored="left to right"),
)
_add(
    "orientation=upside-down",
    "image upside down",
    "camera",
    _setup(mirrored="upside down"),
)
_add(
    "orientation=turned",
    "image turned by 180 degrees",
    "camera",
    _setup(mirrored="both"),
)
_add(
    "channels=bgr",
    "red and blue exchanged",
    "wrong",
    _image(lambda image: image[..., ::-1]),
)


def _divided(image: Array, alpha: Array) -> Array:
    return np.where(alpha > 0, image / np.where(alpha > 0, alpha, 1.0), 0.0)


_add(
    "alpha=straight",
    "colours divided by alpha",
    "wrong",
    _after(_divided),
)
_add(
    "alpha=twice",
    "colours multiplied by alpha twice",
    "wrong",
    _after(lambda image, alpha: image * alpha),
)
_add(
    "background=black", "background black", "wrong", _setup(background=(0.0, 0.0, 0.0))
)
_add(
    "background=white", "background white", "wrong", _setup(background=(1.0, 1.0, 1.0))
)

# --------------------------------------------------------------------------- profiles

PROFILES: dict[str, tuple[str, ...]] = {
    "3dgs": (),
    "antialiased": ("compensation=on",),
    "gsplat": ("near=0.01",),
    "khr": ("order=distance", "low-pass=0", "cut-off=3", "jacobian-limit=none"),
    "webgl": (
        "clamp=0-1",
        "cut-off=sqrt(8)",
        "largest-alpha=1",
        "stop=never",
        "jacobian-limit=none",
    ),
    "ray": (),
}
"""Sets of deviations that kinds of renderers are meant to have: the 3DGS code, the same
with antialiasing, gsplat, KHR_gaussian_splatting as its text says, viewers that draw
quads with the graphics card, and renderers that evaluate Gaussians along rays.
"""


def of_profile(setup: Setup, profile: str) -> Setup:
    """The setup of a renderer that has a profile."""
    if profile not in PROFILES:
        do = nearest(profile, PROFILES, "pass one of these")
        raise InvalidValueError.of("profile", ", ".join(PROFILES), profile, do)
    if profile == "ray":
        setup = replace(setup, model="ray")
    return applied(setup, PROFILES[profile])
