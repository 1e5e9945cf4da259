"""From the rasteriser's flat picture to the image that a caller asked for, and back for gradients."""

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi


class FlatPicture(Protocol):
    """A picture as any renderer here makes it: row-major colours, three a pixel, and opacities."""

    @property
    def colour(self) -> Any:
        """Float, height x width x 3 values in sRGB."""

    @property
    def opacity(self) -> Any:
        """Float, height x width values."""


def linear_value(value: Any) -> Any:
    """Linear value of an sRGB one (IEC 61966-2-1)."""
    return dr.select(value <= 0.04045, value / 12.92, dr.power((dr.maximum(value, 0.0) + 0.055) / 1.055, 2.4))


def srgb_value(value: Any) -> Any:
    """SRGB value of a linear one, the inverse of `linear_value`."""
    return dr.select(value <= 0.0031308, value * 12.92, 1.055 * dr.power(dr.maximum(value, 0.0), 1 / 2.4) - 0.055)


def linear_derivative(value: Any) -> Any:
    """d(linear value) / d(sRGB value)."""
    return dr.select(value <= 0.04045, 1 / 12.92, 2.4 / 1.055 * dr.power((dr.maximum(value, 0.0) + 0.055) / 1.055, 1.4))


def develop(picture: FlatPicture, size: tuple[int, int], *, alpha: bool, linear: bool) -> Any:
    """The picture as an image: TensorXf (H, W, 3), or (H, W, 4) with `alpha`."""
    width, height = size
    colour = linear_value(picture.colour) if linear else picture.colour
    if not alpha:
        return mi.TensorXf(colour, (height, width, 3))
    flat = dr.empty(mi.Float, 4 * width * height)
    pixel = dr.arange(mi.UInt32, width * height)
    rgb = dr.gather(mi.ArrayXf, colour, pixel, shape=(3, width * height))
    dr.scatter(flat, mi.ArrayXf([*rgb, picture.opacity]), pixel)
    return mi.TensorXf(flat, (height, width, 4))


def develop_backward(picture: FlatPicture, grad_image: Any, *, alpha: bool, linear: bool) -> tuple[Any, ...]:
    """dL/d(picture.colour), and with `alpha` dL/d(picture.opacity), from dL/d(image)."""
    flat = mi.Float(dr.detach(grad_image.array))
    grad_opacity: tuple[Any, ...] = ()
    if alpha:
        pixel = dr.arange(mi.UInt32, len(picture.opacity))
        rgba = dr.gather(mi.ArrayXf, flat, pixel, shape=(4, len(picture.opacity)))
        flat = dr.empty(mi.Float, 3 * len(picture.opacity))
        dr.scatter(flat, mi.ArrayXf([rgba[0], rgba[1], rgba[2]]), pixel)
        grad_opacity = (mi.Float(rgba[3]),)
    return (flat * linear_derivative(picture.colour) if linear else flat, *grad_opacity)
