"""How Gaussians lie in flat arrays: as five tensors (ours), or as Mitsuba's `ellipsoids` keep them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.rasterization.projection import Gaussians


@dataclass(frozen=True)
class Layout:
    """How to read rows of Gaussians from flat Float arrays, and how to write rows of a gradient into such arrays."""

    names: tuple[str, ...]  # of the arrays, for messages
    read: Callable[[tuple[Any, ...], Any, int], Gaussians]  # from arrays, UInt32 rows, number of SH terms
    write: Callable[[tuple[Any, ...], Any, Gaussians], None]  # to arrays, UInt32 rows, a gradient


def _rows(array: Any, index: Any, width: int) -> Any:
    return dr.gather(mi.ArrayXf, array, index, shape=(width, dr.width(index)))


def _colours(row: Any, terms: int) -> list[Any]:
    return [mi.Color3f(row[3 * k], row[3 * k + 1], row[3 * k + 2]) for k in range(terms)]


def _flat(coefficients: list[Any]) -> Any:
    return mi.ArrayXf([channel for colour in coefficients for channel in colour])


def _read_tensors(arrays: tuple[Any, ...], index: Any, terms: int) -> Gaussians:
    means, scales, rotations, opacities, sh = arrays
    return Gaussians(
        mean=mi.Point3f(_rows(means, index, 3)),
        scale=mi.Vector3f(_rows(scales, index, 3)),
        rotation=list(_rows(rotations, index, 4)),
        opacity=dr.gather(mi.Float, opacities, index),
        sh=_colours(_rows(sh, index, 3 * terms), terms),
    )


def _write_tensors(arrays: tuple[Any, ...], index: Any, gradient: Gaussians) -> None:
    means, scales, rotations, opacities, sh = arrays
    dr.scatter(means, mi.ArrayXf([*gradient.mean]), index)
    dr.scatter(scales, mi.ArrayXf([*gradient.scale]), index)
    dr.scatter(rotations, mi.ArrayXf(gradient.rotation), index)
    dr.scatter(opacities, gradient.opacity, index)
    dr.scatter(sh, _flat(gradient.sh), index)


def _read_ellipsoids(arrays: tuple[Any, ...], index: Any, terms: int) -> Gaussians:
    data, opacities, sh = arrays
    row = _rows(data, index, 10)
    return Gaussians(
        mean=mi.Point3f(*row[0:3]),
        scale=mi.Vector3f(*row[3:6]),
        rotation=[row[9], row[6], row[7], row[8]],
        opacity=dr.gather(mi.Float, opacities, index),
        sh=_colours(_rows(sh, index, 3 * terms), terms),
    )


def _write_ellipsoids(arrays: tuple[Any, ...], index: Any, gradient: Gaussians) -> None:
    data, opacities, sh = arrays
    w, x, y, z = gradient.rotation
    dr.scatter(data, mi.ArrayXf([*gradient.mean, *gradient.scale, x, y, z, w]), index)
    dr.scatter(opacities, gradient.opacity, index)
    dr.scatter(sh, _flat(gradient.sh), index)


TENSORS = Layout(ATTRIBUTES, _read_tensors, _write_tensors)
"""means (3N), scales (3N), rotations (4N, wxyz), opacities (N), sh (3KN)."""

ELLIPSOIDS = Layout(("data (means, scales, rotations)", "opacities", "sh_coeffs"), _read_ellipsoids, _write_ellipsoids)
"""data (10N: centre, scale, quaternion xyzw), opacities (N), sh_coeffs (3KN)."""


def check_finite(layout: Layout, arrays: tuple[Any, ...]) -> None:
    """Refuse Gaussians with a number that is not finite."""
    for name, array in zip(layout.names, arrays, strict=True):
        bad = dr.count(~dr.isfinite(array))[0] if len(array) else 0
        if bad:
            do = "look at the last update of the parameters: a step may have been too long"
            raise InvalidValueError.of(name, "finite numbers", f"{bad} that are not", do)
