"""Lenses that bend straight lines: the pinhole camera that sees the same, and its picture out of the photograph.

The models are those of COLMAP (src/colmap/sensor/models.h) and OpenCV: Brown's radial and tangential distortion,
OpenCV's rational one (`FULL_OPENCV`), and the fisheye of Kannala and Brandt (2006). The pinhole camera is the one of
COLMAP's `image_undistorter` (src/colmap/image/undistortion.cc): focal lengths stay, and the picture is cut, or grows,
until no pixel is blank. Only the direction from the pinhole camera to the photograph is needed for pictures; it is a
closed form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError

LONGEST_SIDE = 65_535
"""Pixels: the longest side of a photograph that is undistorted, as long as that of a JPEG file."""

_WIDEST, _ANGLES = 1.55, 8192
"""Largest angle from the optical axis that a pinhole picture may show, radians; steps in which a lens is looked at."""
_LEAST, _MOST = 0.2, 2.0
"""By what a picture's sides may change; COLMAP's defaults."""
_LARGEST = 1e6
"""Of a coefficient; those of lenses of a long focal length go into the thousands."""
_TURNS = 20
_BAND = 1 << 19
"""Pixels that are worked on at once."""

Values = NDArray[np.floating[Any]]
_Table = tuple[Values, Values]


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Intrinsics of a photograph, in its pixels."""

    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]  # width and height
    radial: tuple[float, ...] = ()  # k1, k2, ...: of the distance from the axis, or for fisheye of the angle, radians
    divisor: tuple[float, ...] = ()  # k4, k5, k6 of OpenCV's rational model, by which radial distortion is divided
    tangential: tuple[float, float] = (0.0, 0.0)  # p1 and p2 of Brown's model; zero for fisheye
    fisheye: bool = False  # whether distances in the picture grow with the angle and not with its tangent

    def __post_init__(self) -> None:
        values = (*self.radial, *self.divisor, *self.tangential)
        if not all(abs(value) <= _LARGEST for value in values):  # nan is not smaller than anything
            raise InvalidValueError.of("distortion", f"coefficients up to {_LARGEST:g}", values, "calibrate again")
        if not (self.is_pinhole or all(1 / LARGEST <= value <= LARGEST for value in self.focal)):
            raise InvalidValueError.of("focal", "positive numbers of pixels", self.focal, "check the intrinsics")

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines stay straight."""
        return not (self.fisheye or any(self.radial) or any(self.divisor) or any(self.tangential))

    def resized(self, size: tuple[int, int], scale: tuple[float, float] | None = None) -> Intrinsics:
        """The lens of the same photograph with other pixels."""
        sx, sy = scale or (size[0] / self.size[0], size[1] / self.size[1])
        (fx, fy), (cx, cy) = self.focal, self.principal
        return replace(self, focal=(fx * sx, fy * sy), principal=(cx * sx, cy * sy), size=size)

    def project(self, x: Values, y: Values) -> tuple[Values, Values]:
        """Where a point (x, y, 1) of camera space is in the photograph, in pixels."""
        x, y = self._distorted(x, y)
        return self.focal[0] * x + self.principal[0], self.focal[1] * y + self.principal[1]

    def _distorted(self, x: Values, y: Values) -> tuple[Values, Values]:
        square = x * x + y * y
        if self.fisheye:
            length = np.sqrt(square)
            angle = np.arctan(length)
            factor = self._factor(angle * angle) * np.where(length > 0, angle / np.where(length > 0, length, 1), 1)
            return x * factor, y * factor
        dx, dy = self._tangential(x, y)
        factor = self._factor(square)
        return x * factor + dx, y * factor + dy

    def _tangential(self, x: Values, y: Values) -> tuple[Values, Values]:
        (p1, p2), square = self.tangential, x * x + y * y
        return 2 * p1 * x * y + p2 * (square + 2 * x * x), 2 * p2 * x * y + p1 * (square + 2 * y * y)

    def _factor(self, square: Values) -> Values:
        """By what radial distortion multiplies a distance of that square."""
        factor = _polynomial(self.radial, square)
        return factor / _polynomial(self.divisor, square) if any(self.divisor) else factor


def _polynomial(coefficients: tuple[float, ...], square: Values) -> Values:
    """1 + c1 s + c2 s^2 + ... of a square s."""
    value = np.zeros_like(square)
    for coefficient in (*coefficients[::-1], 1.0):
        value = value * square + coefficient
    return value


@functools.lru_cache(maxsize=256)
def pinhole(lens: Intrinsics) -> Intrinsics:
    """Intrinsics without distortion whose picture lies inside the photograph, as COLMAP's undistorter chooses them."""
    if lens.is_pinhole:
        return lens
    (width, height), (cx, cy) = lens.size, lens.principal
    if max(lens.size) > LONGEST_SIDE:
        do = "make the pictures smaller, or undistort them with colmap image_undistorter"
        raise InvalidValueError.of("a lens with distortion", f"sides up to {LONGEST_SIDE:,}", lens.size, do)
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5
    left, right = (_seen(lens, np.full(height, x), rows)[0] for x in (0.5, width - 0.5))
    top, bottom = (_seen(lens, columns, np.full(width, y))[1] for y in (0.5, height - 0.5))
    if min(map(len, (left, right, top, bottom))) == 0 or not (0 < cx < width and 0 < cy < height):
        got = f"one that folds the picture before its border (k {lens.radial + lens.divisor}, p {lens.tangential})"
        do = "calibrate again, or undistort the pictures with colmap image_undistorter"
        raise InvalidValueError.of("distortion", "a lens that can be undone", got, do)
    wide = _scale(width, cx, float(left.max()), float(right.min()))
    high = _scale(height, cy, float(top.max()), float(bottom.min()))
    size = (max(1, int(wide * width)), max(1, int(high * height)))
    principal = (cx * size[0] / width, cy * size[1] / height)
    return Intrinsics(focal=lens.focal, principal=principal, size=size)


def _scale(side: int, centre: float, low: float, high: float) -> float:
    """By what a side may be multiplied so that it ends where the photograph does, at low and high."""
    if not (low < centre < high):
        return _LEAST
    return float(np.clip(1 / max(centre / (centre - low), (side - 0.5 - centre) / (high - centre)), _LEAST, _MOST))


def _seen(lens: Intrinsics, u: Values, v: Values) -> tuple[Values, Values]:
    """Pixels of the photograph in the pixels of a pinhole camera; those that no angle reaches are left out."""
    (fx, fy), (cx, cy) = lens.focal, lens.principal
    angles, distances = _profile(lens)
    wanted = np.stack([(u - cx) / fx, (v - cy) / fy])
    x, y = wanted
    with np.errstate(all="ignore"):  # where a lens cannot be undone
        for _ in range(_TURNS if any(lens.tangential) else 1):
            dx, dy = lens._tangential(x, y)
            length = np.hypot(wanted[0] - dx, wanted[1] - dy)
            grown = np.tan(np.interp(length, distances, angles)) / np.where(length > 0, length, 1)
            x, y = (wanted[0] - dx) * grown, (wanted[1] - dy) * grown
        off = np.stack(lens._distorted(x, y)) - wanted
        good = np.hypot(fx * off[0], fy * off[1]) < 0.5
    return x[good] * fx + cx, y[good] * fy + cy


@functools.lru_cache(maxsize=64)
def _profile(lens: Intrinsics) -> _Table:
    """Angles from the axis, and distances from the centre at which the lens shows them, as far as both grow."""
    angles = np.linspace(0.0, _WIDEST, _ANGLES)
    lengths = angles if lens.fisheye else np.tan(angles)
    with np.errstate(all="ignore"):  # where a divisor is zero
        distances = lengths * lens._factor(lengths * lengths)
        grows = (np.diff(distances) > 0) & np.isfinite(distances[1:])
    count = len(angles) if bool(grows.all()) else 1 + int(np.argmin(grows))
    return angles[:count], distances[:count]


def undistorted(photograph: Tensor, lens: Intrinsics, target: Intrinsics) -> tuple[Tensor, Tensor]:
    """The picture of a pinhole camera out of a photograph, each pixel interpolated between four."""
    width, height = target.size
    (fx, fy), (cx, cy) = target.focal, target.principal
    widest = float(np.tan(_profile(lens)[0][-1]))
    source = photograph.permute(2, 0, 1)[None].contiguous()
    picture, known = (
        photograph.new_empty(height, width, photograph.shape[2]),
        torch.empty(height, width, dtype=torch.bool),
    )
    x = ((np.arange(width) + 0.5 - cx) / fx)[None]
    band = max(1, _BAND // width)
    for start in range(0, height, band):
        y = ((np.arange(start, min(start + band, height)) + 0.5 - cy) / fy)[:, None]
        with np.errstate(all="ignore"):  # beyond where the lens folds
            positions = np.stack([*np.broadcast_arrays(*lens.project(x, y))], -1)
            inside = ((positions >= 0) & (positions <= lens.size)).all(-1) & (np.hypot(x, y) <= widest)
            grid = np.where(inside[..., None], 2 * positions / lens.size - 1, 0)
        sampled = F.grid_sample(
            source, torch.from_numpy(grid)[None].to(source.dtype), padding_mode="border", align_corners=False
        )[0]
        shown = torch.from_numpy(inside)
        picture[start : start + band], known[start : start + band] = sampled.permute(1, 2, 0) * shown[..., None], shown
    return picture, known
