"""Which way is up in a splat file: what it says, else what its cameras or its ground
tell, else z.

No format of splats says which way is up, but for a comment that some programs write
into a PLY, and glTF and OpenUSD, which define it. Worlds of structure from motion have
any direction up, often -y. Light: needs neither torch nor SciPy.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_splat.errors import MiSplatError
from mi_splat.io.loaded import Loaded
from mi_splat.io.parsing import DocumentReader

Direction = tuple[float, float, float]
Z: Direction = (0.0, 0.0, 1.0)

_COMMENT = re.compile(r"vertical axis:\s*(.+)", re.IGNORECASE)
_BRUSH = re.compile(r"exported from brush", re.IGNORECASE)
_AXIS = re.compile(r"([-+]?)([xyz])\b", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?\d*\.?\d+(?:e[-+]?\d+)?", re.IGNORECASE)

_CAMERAS = "cameras.json"
_MOST_CAMERAS_BYTES = 64 << 20
_LEAST_AGREED = 0.4
"""How far along up the cameras' own up directions point in the mean; 1 is all alike,
and none looks up or down.
"""
_ORTHONORMAL = 0.01
"""How far the products of the rows of a rotation may be from 0 and 1."""
_ALIKE = 0.02
_MOST_ROLL = 0.03
"""Mean squares of what points right in the cameras: across of the first of its axes,
where all look the same way if it is less, and along up, where they were rolled if it is
more.
"""

_SOLID = 0.5
_SAMPLE = 3000
_TRIALS = 400
"""Opacity from which a Gaussian is part of a surface; Gaussians and planes that are
tried to find the ground.
"""
_EXTENT = (0.05, 0.95)
"""Quantiles of the coordinates between which the extent of a scene is measured, without
what lies far out.
"""
_THICK = 0.012
_WIDE = 1.2
"""Thickness of a ground as a share of the extent, and how much wider it is than what
stands on it.
"""
_LEAST_SHARE = 0.15
_ONE_SIDE = 0.9
"""Share of the Gaussians that lie on a ground, and of the others that are on its upper
side.
"""
_NEAR_AXIS = np.cos(np.radians(20.0))
"""Cosine from which on a direction that was guessed is taken for that of an axis."""


@dataclass(frozen=True, slots=True)
class UpAxis:
    """A direction that is taken for up, and why."""

    direction: Direction  # unit vector, in the axes of the scene
    reason: str  # "as its comment says"
    is_stated: bool = False  # whether the file says so itself


def up_axis(path: str | os.PathLike[str], loaded: Loaded) -> UpAxis:
    """The direction that is up in a splat that was read from a file.

    Args:
        path: The file, or the folder that stands for it; cameras of a training are
            looked for beside it.
        loaded: Its content.

    Returns:
        The first that there is of: what the file says; the mean of the cameras that
        3DGS left beside it; the ground that its Gaussians stand on; what its format
        defines; z.
    """
    if loaded.stated_up is not None:
        return UpAxis(loaded.stated_up, "as its comment says", is_stated=True)
    from_cameras = _up_of_cameras_beside(path)
    if from_cameras is not None:
        return UpAxis(from_cameras, "as the cameras of its training stood")
    from_ground = ground_up(loaded.arrays["means"], loaded.arrays["opacities"])
    if from_ground is not None:
        return UpAxis(from_ground, "a guess: it stands on a ground")
    if loaded.format_up is not None:
        return UpAxis(loaded.format_up, "as its format defines")
    return UpAxis(Z, "nothing says otherwise")


def commented_up(comments: Sequence[str]) -> Direction | None:
    """What the comments of a PLY say of the vertical axis; None if nothing.

    An axis is that axis, as nerfstudio writes z for up. Brush writes y into every file,
    and reads it as -y, since its worlds are those of COLMAP. Three numbers are a
    direction.
    """
    texts = [
        match[1].strip()
        for comment in comments
        if (match := _COMMENT.fullmatch(comment.strip()))
    ]
    if not texts:
        return None
    axis = _AXIS.match(texts[-1])
    if axis is not None:
        is_brush = any(_BRUSH.search(comment) for comment in comments)
        sign = -1.0 if axis[1] == "-" or (is_brush and axis[2].lower() == "y") else 1.0
        return _along("xyz".index(axis[2].lower()), sign)
    numbers = [float(number) for number in _NUMBER.findall(texts[-1])]
    if len(numbers) == 3:
        return _unit(np.array(numbers))
    return None


def cameras_up(rotations: NDArray[np.float64]) -> Direction | None:
    """The direction that is up for cameras that were held upright, looking up or down
    as they may.

    What points to the right in such a camera is level, so up is what is across of all
    of these. Where all cameras look the same way this says nothing, and up is the mean
    of their own.

    Args:
        rotations: (N, 3, 3) camera to world; x of a camera points right, y down.

    Returns:
        (3,) unit vector, an axis if it is near to one; None if the cameras do not
        agree, or one has no rotation.
    """
    if not len(rotations) or not _are_rotations(rotations):
        return None
    rights = rotations[:, :, 0]
    ups = -rotations[:, :, 1]
    mean = ups.mean(axis=0)
    shares, directions = np.linalg.eigh(rights.T @ rights / len(rights))
    if shares[1] < _ALIKE:
        if np.linalg.norm(mean) > _LEAST_AGREED:
            return _rounded(mean)
        return None
    across = directions[:, 0]
    agreed = float(mean @ across)
    if shares[0] > _MOST_ROLL or abs(agreed) < _LEAST_AGREED:
        return None
    return _rounded(across if agreed > 0 else -across)


@np.errstate(all="ignore")  # of what is no number, or too large, no comparison is true
def _are_rotations(matrices: NDArray[np.float64]) -> bool:
    errors = matrices @ matrices.transpose(0, 2, 1) - np.eye(3)
    return bool(np.abs(errors).max() < _ORTHONORMAL)


def ground_up(
    means: NDArray[np.floating], opacities: NDArray[np.floating]
) -> Direction | None:
    """The normal of the ground of a splat, on the side of what stands on it; None if it
    has none that is plain.

    A ground is flat, holds many of the Gaussians, has nearly all others on one side,
    and reaches farther than these. A room has several such planes, and an object
    without a ground none.

    Args:
        means: (N, 3) world units.
        opacities: (N,) in [0, 1].

    Returns:
        (3,) unit vector, an axis if it is near to one.
    """
    points = _sample(means, opacities)
    if len(points) < 100:
        return None
    low, high = np.quantile(points, _EXTENT, axis=0)
    extent = float((high - low).max())
    if not 0 < extent < np.inf:
        return None
    found = _largest_plane(points, _THICK * extent)
    if found is None:
        return None
    normal, heights = found
    on = np.abs(heights) < _THICK * extent
    others = np.abs(heights) >= 2 * _THICK * extent
    if on.mean() < _LEAST_SHARE or others.sum() < 0.02 * len(points):
        return None
    above = float((heights[others] > 0).mean())
    if max(above, 1 - above) < _ONE_SIDE:
        return None
    across = points - np.median(points[on], axis=0)
    across -= (across @ normal)[:, None] * normal
    reach = np.linalg.norm(across, axis=1)
    if np.quantile(reach[on], 0.9) < _WIDE * np.quantile(reach[others], 0.75):
        return None
    return _rounded(normal if above > 0.5 else -normal)


def _sample(
    means: NDArray[np.floating], opacities: NDArray[np.floating]
) -> NDArray[np.float64]:
    """(M, 3) some of the solid Gaussians, the same each time."""
    rows = np.flatnonzero((opacities > _SOLID) & np.isfinite(means).all(axis=1))
    if len(rows) > _SAMPLE:
        rows = np.random.default_rng(0).permutation(rows)[:_SAMPLE]
    return means[rows].astype(np.float64)


def _largest_plane(
    points: NDArray[np.float64], thick: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The normal of the plane with the most points (RANSAC, Fischler and Bolles 1981),
    and heights over it.
    """
    corners = points[np.random.default_rng(1).integers(len(points), size=(_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 0
    if not usable.any():
        return None
    corners = corners[usable]
    normals = normals[usable] / lengths[usable, None]
    offsets = (normals * corners[:, 0]).sum(1)
    counts = [
        int((np.abs(points @ n - offset) < thick).sum())
        for n, offset in zip(normals, offsets, strict=True)
    ]
    best = int(np.argmax(counts))
    on = np.abs(points @ normals[best] - offsets[best]) < thick
    middle = points[on].mean(axis=0)
    normal = np.linalg.svd(points[on] - middle, full_matrices=False)[2][2]
    return normal, (points - middle) @ normal


def _up_of_cameras_beside(path: str | os.PathLike[str]) -> Direction | None:
    """The up direction of the cameras.json that 3DGS writes beside
    point_cloud/iteration_N; None without one.
    """
    around = os.path.abspath(path)
    for _ in range(4):
        file = os.path.join(around, _CAMERAS)
        if os.path.isfile(file):
            return _up_of_cameras_file(file)
        if os.path.basename(around) == "point_cloud" and not os.path.isdir(around):
            break
        around = os.path.dirname(around)
    return None


def _up_of_cameras_file(file: str) -> Direction | None:
    reader = DocumentReader(most=_MOST_CAMERAS_BYTES)
    try:
        entries = reader.read_json_value(Path(file))
    except (MiSplatError, OSError):
        return None
    if not isinstance(entries, list):  # of a command of ours, whose scene has z up
        return None
    try:
        rotations = np.array([entry["rotation"] for entry in entries], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if rotations.shape[1:] == (3, 3):
        return cameras_up(rotations)
    return None


def _rounded(direction: NDArray[np.float64]) -> Direction | None:
    """The unit vector of a guess: an axis if it is near to one."""
    unit = _unit(direction)
    if unit is None:
        return None
    axis = int(np.argmax(np.abs(unit)))
    if abs(unit[axis]) >= _NEAR_AXIS:
        return _along(axis, float(np.sign(unit[axis])))
    return unit


def _along(axis: int, sign: float) -> Direction:
    values = [0.0, 0.0, 0.0]
    values[axis] = sign
    return values[0], values[1], values[2]


def _unit(direction: NDArray[np.float64]) -> Direction | None:
    length = float(np.linalg.norm(direction))
    if not 0 < length < np.inf:
        return None
    x, y, z = (direction / length).round(4).tolist()
    return x, y, z
