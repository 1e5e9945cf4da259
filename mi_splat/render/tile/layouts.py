"""How Gaussians lie in flat arrays: as five tensors (ours), or as Mitsuba's
`ellipsoids` keep them.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.render.tile.projection import Gaussians


@dataclass(frozen=True)
class Layout:
    """How to read rows of Gaussians from flat Float arrays, and how to write rows of a
    gradient into such arrays.
    """

    # of the arrays, for messages; the last two are opacities and SH
    names: tuple[str, ...]

    def read(self, arrays: tuple[Any, ...], index: Any, terms: int) -> Gaussians:
        """From arrays, UInt32 rows, number of SH terms."""
        *geometry, opacities, sh = arrays
        if len(geometry) == 1:
            row = rows_of(geometry[0], index, 10)
            mean = row[0:3]
            scale = row[3:6]
            rotation = [row[9], *row[6:9]]
        else:
            mean, scale, rotation = (
                rows_of(array, index, k)
                for array, k in zip(geometry, (3, 3, 4), strict=True)
            )
        coefficients = rows_of(sh, index, 3 * terms)
        return Gaussians(
            mean=mi.Point3f(*mean),
            scale=mi.Vector3f(*scale),
            rotation=list(rotation),
            opacity=dr.gather(mi.Float, opacities, index),
            sh=[mi.Color3f(*coefficients[3 * k : 3 * k + 3]) for k in range(terms)],
        )

    def write(self, arrays: tuple[Any, ...], index: Any, gradient: Gaussians) -> None:
        """To arrays, UInt32 rows, a gradient."""
        *geometry, opacities, sh = arrays
        w, x, y, z = gradient.rotation
        rows = [[*gradient.mean], [*gradient.scale], [w, x, y, z]]
        if len(geometry) == 1:
            rows = [[*gradient.mean, *gradient.scale, x, y, z, w]]
        rows += [
            [gradient.opacity],
            [channel for colour in gradient.sh for channel in colour],
        ]
        for array, row in zip((*geometry, opacities, sh), rows, strict=True):
            dr.scatter(array, mi.ArrayXf(row), index)


def rows_of(array: Any, index: Any, width: int) -> Any:
    """ArrayXf, rows of so many numbers each of a flat array."""
    return dr.gather(mi.ArrayXf, array, index, shape=(width, dr.width(index)))


TENSORS = Layout(ATTRIBUTES)
"""means (3N), scales (3N), rotations (4N, wxyz), opacities (N), sh (3KN)."""

ELLIPSOIDS = Layout(("data (means, scales, rotations)", "opacities", "sh_coeffs"))
"""data (10N: centre, scale, quaternion xyzw), opacities (N), sh_coeffs (3KN)."""


def check_finite(layout: Layout, arrays: tuple[Any, ...]) -> None:
    """Refuse Gaussians with a number that is not finite."""
    for name, array in zip(layout.names, arrays, strict=True):
        bad = dr.count(~dr.isfinite(array))[0] if len(array) else 0
        if bad:
            do = (
                "look at the last update of the parameters: a step may have been too"
                " long"
            )
            raise InvalidValueError.of(
                name, "finite numbers", f"{bad} that are not", do
            )
