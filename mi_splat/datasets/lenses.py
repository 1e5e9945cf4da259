"""Lenses that bend straight lines, and the pinhole cameras that see the same.

The models are those of OpenCV, which COLMAP and nerfstudio share: radial and tangential
distortion (Brown 1966), the rational model, and fisheye lenses (Kannala and Brandt
2006). OpenCV computes them. The pinhole camera is chosen as by COLMAP's
`image_undistorter`: focal lengths stay, and the image is cut, or grows, until none of
its pixels is blank.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.attributes import LARGEST
from mi_splat.cameras.lens import PERSPECTIVE
from mi_splat.errors import InvalidValueError, MiSplatError

OPENCV = 5
"""The first version whose `remap` interpolates exactly; before, it rounds positions to
1/32 pixel.
"""
LONGEST_SIDE = 32_767
"""Pixels: the longest side of an image that OpenCV undistorts."""
LARGEST_COEFFICIENT = 1e6
"""Coefficients of lenses with a long focal length go into the thousands."""

_WIDEST = 1.55
_ANGLES = 8192
"""The largest angle from the optical axis, radians, and the steps up to it that are
tried.
"""
_LEAST = 0.2
_MOST = 2.0
"""By what the sides of an image may change when it is undistorted; the defaults of
COLMAP.
"""
_CLOSE = 0.5
"""Pixels by which a point may miss itself after it was undistorted and distorted
again.
"""
_HALF = 0.5
"""The centre of the first pixel is (0.5, 0.5) here and (0, 0) in OpenCV."""

Values = NDArray[np.floating[Any]]
Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


def _opencv() -> Any:
    """OpenCV, imported when a lens has distortion: most sets need none of it.

    Several packages install it in one place; those with windows need libraries of a
    desktop, and one that comes last may be older.
    """
    try:
        import cv2
    except (ImportError, OSError) as error:
        raise _unusable(" ".join(str(error).split())[:200]) from error
    if int(cv2.__version__.partition(".")[0]) < OPENCV:
        raise _unusable(cv2.__version__)
    return cv2


def _unusable(got: str) -> MiSplatError:
    do = "pip install --force-reinstall --no-deps opencv-python-headless"
    return MiSplatError.of(
        "lenses with distortion", f"OpenCV {OPENCV} or later", got, do
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageLens:
    """Intrinsics of an image, in its pixels.

    Attributes:
        focal: Focal lengths (fx, fy).
        principal: Principal point (cx, cy).
        size: Width and height.
        distortion: Coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, or
            of a fisheye lens k1 to k4. Missing ones are zero.
        fisheye: Whether distances in the image grow with the angle and not with its
            tangent.
        projection: That of the camera (`mi_splat.cameras.lens.PROJECTIONS`); with
            distortion, perspective.

    Raises:
        InvalidValueError: A coefficient is not finite or too large, or a lens with
            distortion has no positive focal length or is too large for OpenCV.
    """

    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    projection: str = PERSPECTIVE.name

    def __post_init__(self) -> None:
        known = all(abs(value) <= LARGEST_COEFFICIENT for value in self.distortion)
        if not known:  # NaN is not smaller than anything
            expected = f"coefficients up to {LARGEST_COEFFICIENT:g}"
            do = "calibrate the camera again"
            raise InvalidValueError.of("distortion", expected, self.distortion, do)
        if self.is_pinhole:
            return
        if not all(1 / LARGEST <= value <= LARGEST for value in self.focal):
            do = "check the intrinsics"
            raise InvalidValueError.of(
                "focal", "positive numbers of pixels", self.focal, do
            )
        if max(self.size) > LONGEST_SIDE:
            expected = f"sides up to {LONGEST_SIDE:,} pixels"
            do = "make the images smaller"
            raise InvalidValueError.of(
                "a lens with distortion", expected, self.size, do
            )

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines stay straight."""
        return not (self.fisheye or any(self.distortion))

    def resized(self, size: tuple[int, int]) -> ImageLens:
        """The lens of the same image with another number of pixels."""
        across = size[0] / self.size[0]
        down = size[1] / self.size[1]
        focal = (self.focal[0] * across, self.focal[1] * down)
        principal = (self.principal[0] * across, self.principal[1] * down)
        return replace(self, focal=focal, principal=principal, size=size)

    def project(self, points: Values) -> Values:
        """(N, 2) pixels in which points (x, y, 1) of camera space appear; (N, 2)
        float64 in.
        """
        cv2 = _opencv()
        rays = np.ascontiguousarray(points, np.float64)[:, None]
        if self.fisheye:
            pixels = cv2.fisheye.distortPoints(rays, self._matrix, self._coefficients)
        else:
            rays = cv2.convertPointsToHomogeneous(rays)
            still = np.zeros(3)
            pixels, _ = cv2.projectPoints(
                rays, still, still, self._matrix, self._coefficients
            )
        return np.asarray(pixels, np.float64)[:, 0] + _HALF

    def rays(self, pixels: Values) -> Values:
        """(M, 2) points (x, y) at depth 1 that appear in (N, 2) pixels; unreachable
        ones are left out.
        """
        cv2 = _opencv()
        places = np.ascontiguousarray(pixels - _HALF)[:, None]
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        undo: Any = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        found = undo(places, self._matrix, self._coefficients, criteria=criteria)
        points: Values = np.asarray(found, np.float64)[:, 0]
        within = np.isfinite(points).all(1) & (np.hypot(*points.T) <= self.widest)
        points = points[within]
        pixels = pixels[within]
        if not len(points):
            return points
        misses = np.hypot(*(self.project(points) - pixels).T)
        close: Values = points[misses < _CLOSE]
        return close

    @property
    def widest(self) -> float:
        """Distance from the axis, at depth 1, up to which the lens does not fold the
        image back.
        """
        return _widest(self)

    @property
    def _matrix(self) -> Values:
        """(3, 3) intrinsics with OpenCV's centres of pixels."""
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0.0, cx - _HALF], [0.0, fy, cy - _HALF], [0.0, 0.0, 1.0]])

    @property
    def _coefficients(self) -> Values:
        count = 4 if self.fisheye else 8
        return np.array((*self.distortion, *[0.0] * count)[:count])


@functools.lru_cache(maxsize=64)
def _widest(lens: ImageLens) -> float:
    angles = np.linspace(0.0, _WIDEST, _ANGLES)
    axis = np.tan(angles)
    # Tangential distortion is not symmetric, but small: radial distortion decides where
    # a lens folds.
    radial = lens
    if not lens.fisheye:
        k1, k2, _, _, *rest = (*lens.distortion, *[0.0] * 8)[:8]
        radial = replace(lens, distortion=(k1, k2, 0.0, 0.0, *rest))
    with np.errstate(all="ignore"):  # where the divisor of the rational model is zero
        across = radial.project(np.stack([axis, np.zeros_like(axis)], 1))[:, 0]
        grows = (np.diff(across) > 0) & np.isfinite(across[1:])
    last = len(angles) - 1 if grows.all() else int(np.argmin(grows))
    return float(axis[last])


@functools.lru_cache(maxsize=256)
def pinhole(lens: ImageLens) -> ImageLens:
    """The lens without distortion whose image lies inside that of `lens`.

    Raises:
        InvalidValueError: The lens folds the image before its border, so that it cannot
            be undone.
    """
    if lens.is_pinhole:
        return lens
    width, height = lens.size
    cx, cy = lens.principal
    rows = np.arange(height) + 0.5
    columns = np.arange(width) + 0.5
    left, right = (lens.rays(_line(x, rows))[:, 0] for x in (0.5, width - 0.5))
    top, bottom = (lens.rays(_line(columns, y))[:, 1] for y in (0.5, height - 0.5))
    is_seen = all(map(len, (left, right, top, bottom)))
    if not is_seen or not (0 < cx < width and 0 < cy < height):
        got = (
            "one that folds the image before its border (coefficients"
            f" {lens.distortion})"
        )
        do = "calibrate the camera again"
        raise InvalidValueError.of("distortion", "a lens that can be undone", got, do)
    fx, fy = lens.focal
    wide = _scale(width, cx, float(left.max()) * fx + cx, float(right.min()) * fx + cx)
    high = _scale(height, cy, float(top.max()) * fy + cy, float(bottom.min()) * fy + cy)
    size = (max(1, int(wide * width)), max(1, int(high * height)))
    principal = (cx * size[0] / width, cy * size[1] / height)
    return ImageLens(focal=lens.focal, principal=principal, size=size)


def _line(x: Values | float, y: Values | float) -> Values:
    """(N, 2) pixels of a line of the image."""
    across, down = np.broadcast_arrays(x, y)
    return np.stack([across, down], 1).astype(np.float64)


def _scale(side: int, centre: float, low: float, high: float) -> float:
    """By what a side may be multiplied so that it ends where the image does, at low and
    high.
    """
    if not low < centre < high:
        return _LEAST
    before = centre / (centre - low)
    after = (side - 0.5 - centre) / (high - centre)
    return float(np.clip(1 / max(before, after), _LEAST, _MOST))


@functools.lru_cache(maxsize=2)
def _maps(lens: ImageLens, target: ImageLens) -> tuple[Maps, NDArray[np.bool_]]:
    """Where each pixel of the target lies in the image, with OpenCV's centres, and
    which of them do.
    """
    cv2 = _opencv()
    begin: Any = (
        cv2.fisheye.initUndistortRectifyMap
        if lens.fisheye
        else cv2.initUndistortRectifyMap
    )
    coefficients = lens._coefficients
    turn = np.eye(3)
    across, down = begin(
        lens._matrix, coefficients, turn, target._matrix, target.size, cv2.CV_32FC1
    )
    width, height = lens.size
    x = (np.arange(target.size[0]) + _HALF - target.principal[0]) / target.focal[0]
    y = (np.arange(target.size[1]) + _HALF - target.principal[1]) / target.focal[1]
    # beyond, the lens shows other things twice
    shown = np.hypot(x[None], y[:, None]) <= lens.widest
    for places, side in ((across, width), (down, height)):
        shown &= (places >= -_HALF) & (places <= side - _HALF)
    return (across, down), shown


def undistorted(
    pixels: NDArray[np.float32], lens: ImageLens, target: ImageLens
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The image of a pinhole camera out of that of a lens, each pixel interpolated
    between four.

    Args:
        pixels: (H, W, C) image, of the size of `lens`.
        lens: Lens that took it.
        target: Lens without distortion that is wanted.

    Returns:
        (H', W', C) image, 0 where nothing was seen; and (H', W') bool, where something
        was.
    """
    cv2 = _opencv()
    (across, down), shown = _maps(lens, target)
    image = cv2.remap(
        pixels, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    image = np.asarray(image, np.float32).reshape(*shown.shape, pixels.shape[2])
    # the four weights of a pixel may sum to a little more
    np.clip(image, 0, 1, out=image)
    image[~shown] = 0
    return image, shown
