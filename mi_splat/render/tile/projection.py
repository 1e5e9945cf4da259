"""From 3D Gaussians to 2D ones: EWA projection (Zwicker et al. 2001) as 3DGS (Kerbl et
al. 2023) uses it.

Ordinary Dr.Jit code without side effects, so its derivatives come from automatic
differentiation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile.pinhole import KernelCamera

BLUR = 0.3
"""Variance added to both axes of every 2D Gaussian, px^2 (the low-pass filter of
3DGS).
"""

CUTOFF = math.log2(1.0 / 255.0)
"""log2 of the smallest alpha that contributes to a pixel."""

_HALF_LOG2_E = 0.5 * math.log2(math.e)


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """One 3D Gaussian a lane, as the kernels take them."""

    mean: Any  # Point3f, world units
    scale: Any  # Vector3f, standard deviations
    rotation: Any  # four Floats (w, x, y, z), any length but 0
    opacity: Any  # Float
    sh: list[Any]  # K Color3f

    def parts(self) -> list[Any]:
        """All arrays in one list."""
        return [self.mean, self.scale, *self.rotation, self.opacity, *self.sh]

    def finite(self) -> Any:
        """Bool, whether all numbers are finite.

        By their bits: not every backend's maximum passes a NaN on.
        """
        largest = mi.UInt32(0)
        for part in self.parts():
            for value in part if dr.depth_v(part) > 1 else [part]:
                largest = dr.maximum(
                    largest, dr.reinterpret_array(mi.UInt32, value) & 0x7FFFFFFF
                )
        return largest < 0x7F800000

    def gradient(self) -> Gaussians:
        """The gradients that a backward pass left in the arrays, in the same form."""
        return Gaussians(
            mean=dr.grad(self.mean),
            scale=dr.grad(self.scale),
            rotation=[dr.grad(q) for q in self.rotation],
            opacity=dr.grad(self.opacity),
            sh=[dr.grad(c) for c in self.sh],
        )


@dataclass(slots=True, eq=False)
class Splat:
    """One 2D Gaussian a lane: log2 alpha(dx, dy) = level - (u0 dx + u1 dy)^2 - (v1
    dy)^2, (dx, dy) from `centre`.

    The square roots of the conic's Cholesky factors, not the conic itself: a needle's
    exponent is then a difference of small numbers, and it is never positive.
    """

    centre: Any  # Point2f, px
    u0: Any
    u1: Any
    v1: Any
    level: Any  # log2 of the opacity (of the filtered Gaussian, if `antialiased`)
    colour: Any  # Color3f, >= 0

    def components(self) -> list[Any]:
        """The nine numbers in the order of a record."""
        return [*self.centre, self.u0, self.u1, self.v1, self.level, *self.colour]


def rotation_matrix(quaternion: Any) -> Any:
    """Matrix3f of the rotation of a quaternion (w, x, y, z) of any length but 0."""
    w, x, y, z = quaternion
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return mi.Matrix3f(
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip


def colour(gaussians: Gaussians, camera: KernelCamera) -> Any:
    """max(0, 0.5 + SH) along the direction from the camera centre to the mean, Color3f
    in sRGB.
    """
    direction = dr.normalize(mi.Vector3f(gaussians.mean - camera.position))
    basis = dr.sh_eval(direction, math.isqrt(len(gaussians.sh)) - 1)
    total = mi.Color3f(0.5)
    for factor, coefficient in zip(basis, gaussians.sh, strict=True):
        total += factor * coefficient
    return dr.maximum(total, 0.0)


def project(gaussians: Gaussians, camera: KernelCamera) -> tuple[Splat, Any, Any]:
    """Project every Gaussian.

    The blur of 0.3 px^2 makes small Gaussians heavier than they are: with S for the 2D
    covariance, the sum of a Gaussian's weights over the image grows by sqrt(det(S +
    0.3 I) / det(S)). With `camera.antialiased` its opacity is divided by that, so that
    the blur is a low-pass filter that keeps the sum: the 2D filter of Mip-Splatting (Yu
    et al. 2024, eq. 10), in the form that gsplat calls "antialiased", with the blur of
    0.3 and no floor under the factor (the 3DGS reference has one of 0.005; the code of
    Mip-Splatting blurs by 0.1). alpha is clamped at 0.99 after that.
    """
    local = camera.rotation @ mi.Vector3f(gaussians.mean) + camera.translation
    inverse = 1.0 / local.z
    tangent = mi.Vector2f(local.x * inverse, local.y * inverse)
    centre = mi.Point2f(dr.fma(camera.focal, tangent, camera.principal))

    # Rows of J W R S, the 2 x 3 factor of the 2D covariance (EWA splatting, eq. 24 with
    # the Jacobian of eq. 29).
    tx = dr.clip(tangent.x, -camera.guard.x, camera.guard.x)
    ty = dr.clip(tangent.y, -camera.guard.y, camera.guard.y)
    jx = camera.focal.x * inverse
    jy = camera.focal.y * inverse
    r = camera.rotation
    row_x = mi.Vector3f(*[jx * (r[0, i] - tx * r[2, i]) for i in range(3)])
    row_y = mi.Vector3f(*[jy * (r[1, i] - ty * r[2, i]) for i in range(3)])
    axes = rotation_matrix(gaussians.rotation)
    columns = [mi.Vector3f(axes[0, i], axes[1, i], axes[2, i]) for i in range(3)]
    v0 = mi.Vector3f(*[dr.dot(row_x, column) for column in columns]) * gaussians.scale
    v1 = mi.Vector3f(*[dr.dot(row_y, column) for column in columns]) * gaussians.scale

    n0 = dr.squared_norm(v0)
    n1 = dr.squared_norm(v1)
    xx = n0 + BLUR
    yy = n1 + BLUR
    xy = dr.dot(v0, v1)
    # Lagrange's identity: no cancellation between xx yy and xy^2 for long thin splats.
    area = dr.squared_norm(dr.cross(v0, v1))
    determinant = area + BLUR * (n0 + n1 + BLUR)
    u0 = dr.sqrt(_HALF_LOG2_E * yy / determinant)
    level = dr.log2(gaussians.opacity)
    if camera.antialiased:
        level += 0.5 * dr.log2(area / determinant)
    splat = Splat(
        centre=centre,
        u0=u0,
        u1=-u0 * xy / yy,
        v1=dr.sqrt(_HALF_LOG2_E / yy),
        level=level,
        colour=colour(gaussians, camera),
    )
    # squared Mahalanobis radius where alpha = 1/255
    reach = dr.detach((splat.level - CUTOFF) / _HALF_LOG2_E)
    extent = dr.select(
        reach >= 0.0,
        mi.Vector2f(dr.sqrt(dr.detach(xx) * reach), dr.sqrt(dr.detach(yy) * reach)),
        mi.Vector2f(-1.0),
    )
    return splat, extent, local.z
