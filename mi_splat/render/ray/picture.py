"""An image of splats alone by ray tracing, one ray through every pixel centre, and its
derivative.

The counterpart of `mi_splat.render.tile.pipeline`: the same arrays, camera and
colours in, the same form of image out.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.ray import segments
from mi_splat.render.ray.segments import Stretch
from mi_splat.render.ray.splats import Splats, gradients, zero_sums
from mi_splat.render.tile.binning import TILE
from mi_splat.render.tile.frozen import buffer
from mi_splat.render.tile.picture import tile_columns
from mi_splat.render.tile.pinhole import Pinhole

_FAR = 1e9  # world units; no peak is farther away


@dataclass(frozen=True, slots=True, eq=False)
class RayPicture:
    """What the forward pass returns and the backward pass takes."""

    colour: Any  # Float, height x width x 3 values, row-major, background blended in
    opacity: Any  # Float, height x width values of 1 - transmittance
    splats: Splats | None
    camera: Pinhole
    # colour and transmittance of each of `_rays`; None where there is no Gaussian
    seen: tuple[Any, Any] | None
    background: tuple[float, float, float]  # sRGB
    to_mean: bool  # see `segments.view_direction`


def _rays(camera: Pinhole) -> tuple[Stretch, Any, Any]:
    """A ray a lane from the near plane on, tile after tile, as packets like it; its
    pixel, and whether it is one.
    """
    width, height = (dr.opaque(mi.Int32, side) for side in camera.size)
    columns = tile_columns(width)
    tiles = -(-camera.size[0] // TILE) * -(-camera.size[1] // TILE)
    lane = dr.arange(mi.Int32, TILE * TILE * tiles)
    tile = lane // (TILE * TILE)
    inside = lane % (TILE * TILE)
    x = (tile % columns) * TILE + inside % TILE
    y = (tile // columns) * TILE + inside // TILE
    numbers = camera.for_rays()
    centre = mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5) - numbers.principal
    plane = centre / numbers.focal
    lens = camera.camera.lens
    start, local = lens.model.ray(plane.x, plane.y)
    local = mi.Vector3f(*local)
    length = dr.norm(local)
    direction = numbers.rotation.T @ (local / length)
    offset = dr.zeros(mi.Vector3f, dr.width(lane))
    if not lens.is_perspective:
        offset += numbers.rotation.T @ mi.Vector3f(*start)
    origin = mi.Point3f(numbers.position) + offset
    stretch = Stretch(
        origin, mi.Vector3f(direction), numbers.near * length, mi.Float(_FAR)
    )
    return stretch, mi.UInt32(y * width + x), (x < width) & (y < height)


def raytrace(
    splats: Splats | None,
    camera: Pinhole,
    background: tuple[float, float, float],
    *,
    to_mean: bool,
) -> RayPicture:
    """Render Gaussians to an image."""
    pixels = camera.size[0] * camera.size[1]
    colour = buffer(3 * pixels)
    opacity = buffer(pixels, value=0.0)
    if splats is None:
        return RayPicture(
            dr.tile(mi.Float(background), pixels),
            opacity,
            None,
            camera,
            None,
            background,
            to_mean,
        )
    # without a centre of projection, the direction to a mean is that of the rays
    to_mean = to_mean and camera.camera.lens.is_perspective
    stretch, pixel, active = _rays(camera)
    seen = segments.blend(splats, stretch, active, to_mean=to_mean)
    dr.scatter(colour, seen[0] + seen[1] * mi.Color3f(background), pixel, active)
    dr.scatter(opacity, 1.0 - seen[1], pixel, active)
    dr.eval(colour, opacity, seen)
    return RayPicture(colour, opacity, splats, camera, seen, background, to_mean)


def raytrace_backward(
    picture: RayPicture, grad_colour: Any, grad_opacity: Any | None = None
) -> tuple[Any, ...] | None:
    """Gradient with respect to each array of the Gaussians; None where there are
    none.
    """
    if picture.splats is None or picture.seen is None:
        return None
    stretch, pixel, active = _rays(picture.camera)
    grad_seen = dr.gather(mi.Color3f, grad_colour, pixel, active)
    grad_through = dr.dot(grad_seen, mi.Color3f(picture.background))
    if grad_opacity is not None:
        grad_through -= dr.gather(mi.Float, grad_opacity, pixel, active)
    sums = zero_sums(picture.splats)
    gradient = grad_seen, grad_through
    segments.blend_backward(
        picture.splats,
        stretch,
        active,
        picture.seen,
        gradient,
        sums,
        to_mean=picture.to_mean,
    )
    dr.eval(sums.moments, sums.pulls, sums.sh)
    return gradients(picture.splats, sums)
