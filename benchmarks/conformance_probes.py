"""Whether an adapter shows what its viewer draws: a few splats whose image is known in
closed form, without the reference renderer.

Faults of an adapter move, turn or recolour everything: a wrong pose, a wrong size, sRGB
encoded twice, an image taken before the viewer has sorted. What a viewer itself does
otherwise changes shapes: the low-pass filter and the falloff are measured.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from mi_splat.conformance import ConformanceScene, Setup, look_at
from mi_splat.conformance.files import read_images
from mi_splat.conformance.setups import C0
from mi_splat.oracle import Array, PinholeCamera, Splat

SIZE = 64
DISTANCE = 3.0
FOCAL = 60.0  # pixels
PIXEL = DISTANCE / FOCAL
"""Of a Gaussian at `DISTANCE`, world units."""
EYE = np.array([1.2, -2.4, 1.1])
OPACITY = 0.9
COLOUR = (0.9, 0.7, 0.5)
BACKGROUND = (0.2, 0.4, 0.6)
OFF_AXIS = ((-17.0, -12.0), (14.0, -19.0), (-11.0, 15.0), (19.0, 13.0))
"""Pixels right of and below the centre."""
WIDTHS = (1.0, 1.5, 2.0, 3.0)
"""Standard deviations of Gaussians from which the low-pass filter is measured."""
LOW_PASSES = np.arange(0.0, 1.0, 0.025)
FALLOFFS = {"exponential": 0.0, "normalised": math.exp(-4.0)}
"""What is taken from the exponential, so that it ends at sqrt(8) deviations."""
PADDED = 256
MOST_OFF = 0.05
"""Pixels by which a centre may be off."""
MOST_WRONG = 3 / 255
"""By which a colour may be off."""


def _camera() -> PinholeCamera:
    eye = EYE * DISTANCE / np.linalg.norm(EYE)
    return look_at(eye, (0, 0, 0), focal=FOCAL, width=SIZE, height=SIZE)


CAMERA = _camera()


def _at(right: float, down: float, depth: float = DISTANCE) -> Array:
    """Where a camera sees a point that many pixels off its axis."""
    local = np.array([right * depth / FOCAL, down * depth / FOCAL, depth])
    point: Array = CAMERA.to_world[:3, :3] @ local + CAMERA.to_world[:3, 3]
    return point


def _scene(
    name: str,
    means: list[Array],
    sigmas: list[float],
    colours: Array,
    *,
    opacity: float = OPACITY,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ConformanceScene:
    """Round Gaussians before others that nobody sees, since viewers make textures of
    blocks; colours (N, 3), or (N, K, 3) SH.
    """
    count = PADDED - len(means)
    behind = CAMERA.to_world[:3, 3] - 4 * CAMERA.to_world[:3, 2]
    shown = np.array(means)
    where = np.concatenate([shown, np.tile(behind, (count, 1))])
    sizes = np.concatenate([np.array(sigmas), np.full(count, 0.01)])
    sh = colours if colours.ndim == 3 else (colours[:, None] - 0.5) / C0
    rest = np.zeros((count, *sh.shape[1:]))
    values = (
        where,
        np.log(np.tile(sizes[:, None], (1, 3))),
        np.tile([1.0, 0.0, 0.0, 0.0], (PADDED, 1)),
        np.full(PADDED, math.log(opacity / (1 - opacity))),
        np.concatenate([sh, rest]),
    )
    stored = Splat(*(value.astype(np.float32) for value in values))
    setup = Setup(stored=stored, camera=CAMERA, background=background)
    return ConformanceScene(name=name, fact="", setup=setup)


# The sides of a Gaussian that the camera sees from ahead, in degree 1.
_TERMS = 0.4886025119029199 * np.array([-1.0, 1.0, -1.0])
_BAND = 0.6


def _sh_colour(number: int, mean: Array) -> float:
    towards = mean - CAMERA.to_world[:3, 3]
    unit = towards / np.linalg.norm(towards)
    value = 0.5 + _BAND * _TERMS[number] * unit[[1, 2, 0][number]]
    return float(value)


def _sh_scene() -> ConformanceScene:
    sh = np.zeros((3, 4, 3))
    for number in range(3):
        sh[number, 1 + number] = _BAND
    means = [_at(*pixels) for pixels in OFF_AXIS[:3]]
    return _scene("directions", means, [4 * PIXEL] * 3, sh)


def scenes() -> dict[str, ConformanceScene]:
    """The splats by name."""
    colour = np.array([COLOUR])
    corners = [_at(*pixels) for pixels in OFF_AXIS]
    pair = [_at(0, 0, 0.9 * DISTANCE), _at(0, 0, 1.1 * DISTANCE)]
    sizes = [4 * PIXEL * 0.9, 8 * PIXEL * 1.1]
    colours = np.array([[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]])
    found = [
        _scene("centre", [_at(0, 0)], [6 * PIXEL], colour),
        _scene("off-axis", corners, [3 * PIXEL] * 4, np.repeat(colour, 4, axis=0)),
        _sh_scene(),
        _scene("near-first", pair, sizes, colours),
        _scene("far-first", pair[::-1], sizes[::-1], colours[::-1]),
        _scene("background", [_at(0, 0)], [3 * PIXEL], colour, background=BACKGROUND),
    ]
    found += [
        _scene(f"width-{width:g}", [_at(0.5, 0.5)], [width * PIXEL], colour)
        for width in WIDTHS
    ]
    return {scene.name: scene for scene in found}


# ---------------------------------------------------------------------------- measured


def _squared(centre: tuple[float, float]) -> Array:
    """(H, W) squared distances from a point, pixels."""
    at = np.arange(SIZE) + 0.5 - SIZE / 2
    squared: Array = (at - centre[0]) ** 2 + (at[:, None] - centre[1]) ** 2
    return squared


class Shape(NamedTuple):
    """How a viewer draws a round Gaussian."""

    low_pass: float  # pixels^2
    compensated: bool  # opacity lowered for it
    falloff: str

    def alpha(self, sigma: float) -> Array:
        """(H, W) of the Gaussian of a scene of widths, in closed form."""
        variance = sigma**2 + self.low_pass
        end = FALLOFFS[self.falloff]
        value = np.exp(-0.5 * _squared((0.5, 0.5)) / variance)
        opacity = OPACITY * sigma**2 / variance if self.compensated else OPACITY
        alpha: Array = opacity * np.maximum(0.0, (value - end) / (1 - end))
        return alpha


def _centroid_error(image: Array, centre: tuple[float, float]) -> float:
    """How far the middle of what is near a point is off it, pixels."""
    near = _squared(centre) <= 8.0**2
    weights = np.where(near, image.sum(axis=2), 0.0)
    if not weights.any():
        return math.inf
    at = np.arange(SIZE) + 0.5 - SIZE / 2
    across = float((weights.sum(axis=0) * at).sum() / weights.sum())
    along = float((weights.sum(axis=1) * at).sum() / weights.sum())
    return math.hypot(across - centre[0], along - centre[1])


def _colour_at(image: Array, centre: tuple[float, float]) -> Array:
    """Mean of the four pixels around a point."""
    column = round(centre[0] + SIZE / 2)
    row = round(centre[1] + SIZE / 2)
    colour: Array = image[row - 1 : row + 1, column - 1 : column + 1].mean(axis=(0, 1))
    return colour


def _largest(values: Array) -> float:
    return round(float(np.abs(values).max()), 4)


def _shape(images: Mapping[str, Array]) -> dict[str, Any]:
    """The shape under which Gaussians of several widths have the alphas that are
    seen.
    """
    alphas = {width: images[f"width-{width:g}"][..., 0] / COLOUR[0] for width in WIDTHS}

    def rms(shape: Shape) -> float:
        off = [alphas[width] - shape.alpha(width) for width in WIDTHS]
        return float(np.sqrt(np.mean(np.square(off))))

    every = itertools.product(LOW_PASSES.tolist(), (False, True), FALLOFFS)
    best = min(itertools.starmap(Shape, every), key=rms)
    return {
        "low_pass": round(best.low_pass, 3),
        "compensated": best.compensated,
        "falloff": best.falloff,
        "rms": round(rms(best), 5),
    }


def measured(images: Mapping[str, Array]) -> dict[str, Any]:
    """What images of `scenes` show of an adapter and a viewer.

    Args:
        images: (H, W, 3) by name.
    """
    expected = OPACITY * np.array(COLOUR)
    positions = [_centroid_error(images["centre"], (0.0, 0.0))]
    positions += [_centroid_error(images["off-axis"], each) for each in OFF_AXIS]
    # Beside the peak a Gaussian is a little fainter.
    peak = np.exp(-0.5 * 0.5 / 6.0**2) * expected
    beside = np.exp(-0.5 * 0.5 / 4.0**2) * OPACITY
    directions = [
        _colour_at(images["directions"], OFF_AXIS[number])
        - beside * _sh_colour(number, _at(*OFF_AXIS[number]))
        for number in range(3)
    ]
    front = OPACITY * np.array([0.9, 0.2, 0.1])
    behind = (1 - OPACITY) * OPACITY * np.array([0.1, 0.3, 0.9])
    orders = [
        _colour_at(images[name], (0.0, 0.0)) - front - behind
        for name in ("near-first", "far-first")
    ]
    corner = images["background"][:4, :4] - np.array(BACKGROUND)
    faults = {
        "position, pixels": round(max(positions), 4),
        "colour": _largest(_colour_at(images["centre"], (0.0, 0.0)) - peak),
        "background": _largest(corner),
        "directions": _largest(np.array(directions)),
    }
    order = _largest(np.array(orders))
    free = faults["position, pixels"] <= MOST_OFF and order <= 4 * MOST_WRONG
    colours = [value for key, value in faults.items() if "pixels" not in key]
    return {
        "adapter_is_right": free and max(colours) <= MOST_WRONG,
        "errors": {**faults, "order": order},
        "shape": _shape(images),
    }


def drawn_in_browser(adapter: Path) -> dict[str, Array]:
    """The images of `scenes` that a viewer draws."""
    from mi_splat.cli.conform_browser import draw_in_browser

    with TemporaryDirectory() as folder:
        draw_in_browser(adapter, Path(folder) / "images", scenes())
        found = read_images(Path(folder) / "images", scenes())
    return {name: image.values[..., :3] for name, image in found.items()}
