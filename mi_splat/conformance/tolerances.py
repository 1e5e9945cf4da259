"""How far an image may be off."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mi_splat.conformance.setups import Setup
from mi_splat.oracle import Array, blend, project


class Tolerance(NamedTuple):
    """How far an image may be off."""

    psnr: float  # dB, at least
    largest: float  # of a channel, at most

    def holds(self, error: Error) -> bool:
        """Whether an error is within the tolerance."""
        return error.psnr >= self.psnr and error.largest <= self.largest


class Error(NamedTuple):
    """How far an image is from its reference, as a screen shows both."""

    squared: float  # mean
    largest: float  # of a channel

    @property
    def psnr(self) -> float:
        """dB, at most 120."""
        return -10 * math.log10(max(self.squared, 1e-12))


FLOATS = Tolerance(80.0, 1e-3)
_BYTES = Tolerance(46.0, 5 / 255)
_MARGIN = 6.0
"""Of images in floats; of images in bytes, whose renderer may blend in bytes and so may
be off by more where many Gaussians lie in front of each other: twice what that does.
"""


def difference(image: Array, reference: Array) -> Error:
    """How far an image is from its reference."""
    off = np.clip(image, 0, 1) - np.clip(reference, 0, 1)
    return Error(float(np.mean(off**2)), float(np.abs(off).max(initial=0.0)))


def least_tolerance(bits: int) -> Tolerance:
    """How far every image may be off at least, 8 or 32 bits."""
    return _BYTES if bits == 8 else FLOATS


def tolerance_of(setup: Setup, bits: int) -> Tolerance:
    """How far the image of a scene may be off.

    Args:
        setup: What makes the reference.
        bits: Of a channel, 8 or 32.
    """
    if bits == 32 or setup.model == "ray":
        return least_tolerance(bits)
    exact, _ = replace(setup, after=None, mirrored="no").render()
    rounding = difference(_blended_in_bytes(setup), exact)
    return Tolerance(
        min(_BYTES.psnr, rounding.psnr - _MARGIN),
        max(_BYTES.largest, 2 * rounding.largest),
    )


def _blended_in_bytes(setup: Setup) -> Array:
    """The image of a viewer that has colours of Gaussians and pixels in bytes."""
    projected = project(setup.splat, setup.camera, setup.convention)
    layers = list(blend(projected, setup.camera, setup.convention))
    shape = (setup.camera.height, setup.camera.width)
    image = _in_bytes(np.broadcast_to(np.array(setup.background), (*shape, 3)))
    for layer in reversed(layers):
        alpha = layer.alpha[..., None]
        colour = _in_bytes(projected.colour[layer.number])
        blended = alpha * colour + (1 - alpha) * image[layer.box]
        image[layer.box] = _in_bytes(blended)
    return image


def _in_bytes(values: Array) -> Array:
    rounded: Array = np.round(values * 255) / 255
    return rounded
