"""From the rasteriser's flat image to the image that a caller asked for, and back for
gradients.
"""

from typing import Any

import drjit as dr
import mitsuba as mi


def linear_value(value: Any) -> Any:
    """Linear value of an sRGB one (IEC 61966-2-1)."""
    return dr.select(
        value <= 0.04045,
        value / 12.92,
        dr.power((dr.maximum(value, 0.0) + 0.055) / 1.055, 2.4),
    )


def srgb_value(value: Any) -> Any:
    """SRGB value of a linear one, the inverse of `linear_value`."""
    return dr.select(
        value <= 0.0031308,
        value * 12.92,
        1.055 * dr.power(dr.maximum(value, 0.0), 1 / 2.4) - 0.055,
    )


def linear_derivative(value: Any) -> Any:
    """d(linear value) / d(sRGB value)."""
    return dr.select(
        value <= 0.04045,
        1 / 12.92,
        2.4 / 1.055 * dr.power((dr.maximum(value, 0.0) + 0.055) / 1.055, 1.4),
    )


def develop(
    colour: Any, opacity: Any | None, size: tuple[int, int], *, linear: bool
) -> Any:
    """The image of row-major sRGB colours: TensorXf (H, W, 3), or (H, W, 4) with
    opacities.
    """
    width, height = size
    colour = linear_value(colour) if linear else colour
    if opacity is None:
        return mi.TensorXf(colour, (height, width, 3))
    flat = dr.empty(mi.Float, 4 * width * height)
    pixel = dr.arange(mi.UInt32, width * height)
    rgb = dr.gather(mi.ArrayXf, colour, pixel, shape=(3, width * height))
    dr.scatter(flat, mi.ArrayXf([*rgb, opacity]), pixel)
    return mi.TensorXf(flat, (height, width, 4))


def develop_backward(
    colour: Any, grad_image: Any, *, alpha: bool, linear: bool
) -> tuple[Any, ...]:
    """dL/d(colour), and with `alpha` dL/d(opacity), from dL/d(image)."""
    flat = mi.Float(dr.detach(grad_image.array))
    grad_opacity: tuple[Any, ...] = ()
    if alpha:
        pixels = len(colour) // 3
        pixel = dr.arange(mi.UInt32, pixels)
        rgba = dr.gather(mi.ArrayXf, flat, pixel, shape=(4, pixels))
        flat = dr.empty(mi.Float, 3 * pixels)
        dr.scatter(flat, mi.ArrayXf([rgba[0], rgba[1], rgba[2]]), pixel)
        grad_opacity = (mi.Float(rgba[3]),)
    return (flat * linear_derivative(colour) if linear else flat, *grad_opacity)
