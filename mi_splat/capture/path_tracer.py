"""Path-traced images of mesh scenes, with exact cameras.

Everything here runs in a variant of Mitsuba that is fast at it (`tracing_variant`) and
puts the caller's back afterwards. Pixels are box-filtered averages, converted to sRGB
and clipped to [0, 1]; the same arguments give the same image, on any number of
threads.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.capture.mesh import Floats, to_srgb
from mi_splat.errors import InvalidValueError
from mi_splat.render.plugins.sensor import sensor_dict
from mi_splat.render.scene_files import load_mitsuba_scene
from mi_splat.render.setup import prepare_llvm, set_up_mitsuba

MANY_PICTURES = "llvm_ad_rgb"
"""Variant that traces a whole image at once: five times as fast, after half a second
of compiling for each scene.
"""
FEW_PICTURES = "scalar_rgb"
"""Variant that compiles nothing."""
MAX_DEPTH = 3
"""Bounces followed by the path tracer, the camera's own ray included."""

_chosen: ContextVar[str | None] = ContextVar("_chosen", default=None)


@contextlib.contextmanager
def tracing_variant(variant: str | None = None) -> Iterator[None]:
    """Have Mitsuba use the variant that path traces inside of a `with` block, and the
    earlier one after it.

    Mitsuba loads its Python modules again for another variant, 0.2 s each time. Every
    function here switches by itself; around many calls, one more switch outside makes
    theirs free. A scene belongs to the variant that it was made in.
    """
    wanted = variant or _chosen.get() or MANY_PICTURES
    if wanted == MANY_PICTURES:
        prepare_llvm()
    token = _chosen.set(wanted)
    previous = mi.variant()
    set_up_mitsuba()
    if previous != wanted:
        mi.set_variant(wanted)
    try:
        yield
    finally:
        _chosen.reset(token)
        if previous is not None and previous != wanted:
            mi.set_variant(previous)


def made_in(scene: dict[str, Any] | Path) -> str | None:
    """The variant that a scene's objects were made in, in which alone they can be
    traced; None if it has none yet.
    """
    parts = scene.values() if isinstance(scene, dict) else ()
    return next(
        (part.variant_name() for part in parts if hasattr(part, "variant_name")), None
    )


def load_scene(scene: dict[str, Any] | Path) -> mi.Scene:
    """A scene dictionary or a Mitsuba XML file as a scene of the variant that is
    set.
    """
    if isinstance(scene, dict):
        return mi.load_dict(scene)
    return load_mitsuba_scene(scene)


BRIGHTEST = 1.6
"""Intensity at which each pass of an image is clipped."""

AT_ONCE = 1 << 21
"""The most paths that are traced at once, which bounds memory; a larger image is
traced in bands of rows.
"""
_BANDS_APART = 0x9E3779B9
"""Between the seeds of an image's bands."""

NEAR = 0.01
"""Distance in world units up to which a camera sees nothing."""

PASSES = 2
"""The most passes of one image; seeds of images are so many apart."""


_Depths = TypeVar("_Depths", NDArray[Any], Tensor)


def pass_samples(samples: int) -> tuple[int, ...]:
    """Samples of each pass, which sum up to `samples` (1 or more): as equal as
    `fits_grid` allows.
    """
    if samples < PASSES:
        return (samples,)
    half = samples // PASSES
    first = [count for count in range(half, 0, -1) if fits_grid(count)]
    exact = (count for count in first if fits_grid(samples - count))
    chosen = next(exact, first[0])
    return chosen, samples - chosen


def fits_grid(samples: int) -> bool:
    """Whether Mitsuba's multi-jittered sampler takes so many samples, and rounds none
    up.

    Its grid has floor(sqrt(n)) rows that are all full.
    """
    return samples % math.isqrt(samples) == 0


def sampler_type(samples: int) -> str:
    """Name of the Mitsuba sampler that takes exactly so many samples with the least
    noise.
    """
    # Correlated multi-jittered (Kensler 2013): at 16 and 64 samples per pixel 6 dB less
    # noise than independent ones.
    if fits_grid(samples):
        return "multijitter"
    return "independent"


def _sensor(
    camera: Camera,
    *,
    samples: int,
    seed: int,
    alpha: bool = False,
    near: float = NEAR,
    rows: tuple[int, int] | None = None,
) -> mi.Sensor:
    """A sensor of the whole image, or of the `rows` from the first up to the
    second.
    """
    sampler = {"type": sampler_type(samples), "sample_count": samples, "seed": seed}
    values = {**sensor_dict(camera), "sampler": sampler, "near_clip": near}
    if alpha:
        values["film"] = {**values["film"], "pixel_format": "rgba"}
    if rows is not None:
        crop = {
            "crop_offset_x": 0,
            "crop_offset_y": rows[0],
            "crop_width": camera.width,
        }
        values["film"] = {**values["film"], **crop, "crop_height": rows[1] - rows[0]}
    return mi.load_dict(values)


def _picture(
    scene: mi.Scene,
    camera: Camera,
    *,
    samples: int,
    seed: int,
    integrator: mi.Integrator | None = None,
    near: float = NEAR,
) -> Tensor:
    """One image; the mean of passes that are clipped on their own, so that no single
    bright path leaves a speck.
    """
    channels = 3 if integrator is None else 4
    total = np.zeros((camera.height, camera.width, channels))
    given = {} if integrator is None else {"integrator": integrator}
    for number, in_pass in enumerate(pass_samples(samples)):
        height = max(1, AT_ONCE // (in_pass * camera.width))
        for band, first in enumerate(range(0, camera.height, height)):
            rows = (first, min(first + height, camera.height))
            sensor = _sensor(
                camera,
                samples=in_pass,
                seed=seed,
                alpha=integrator is not None,
                near=near,
                rows=rows,
            )
            of_band = (seed * PASSES + number + band * _BANDS_APART) % (1 << 32)
            film = mi.render(scene, sensor=sensor, spp=in_pass, seed=of_band, **given)
            total[slice(*rows)] += np.clip(
                np.array(film)[..., :channels], 0, BRIGHTEST
            ) * (in_pass / samples)
    if integrator is None:
        return torch.from_numpy(to_srgb(total))
    alpha = np.clip(total[..., 3:], 0, 1)
    colours = to_srgb(total[..., :3] / np.maximum(alpha, 1e-6))
    return torch.from_numpy(
        np.concatenate([colours, alpha.astype(np.float32)], axis=-1)
    )


class PathTracer:
    """A loaded mesh scene that takes images one at a time; each depends on its
    camera, samples and seed alone.
    """

    def __init__(
        self,
        scene: dict[str, Any] | Path,
        *,
        samples: int = 32,
        alpha: bool = False,
        near: float = NEAR,
    ) -> None:
        """Load a scene."""
        if samples < 1:
            raise InvalidValueError.of(
                "samples",
                "a positive number of samples per pixel",
                samples,
                "use 16 or more",
            )
        self.samples = samples
        self._near = near
        with tracing_variant(made_in(scene)):
            self._variant = mi.variant()
            self._scene = load_scene(scene)
            if not alpha and self._scene.integrator() is None:
                do = 'add <integrator type="path"/>'
                raise InvalidValueError.of(
                    str(scene), "a scene with an integrator", "none", do
                )
            hidden = {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True}
            self._integrator = mi.load_dict(hidden) if alpha else None

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the box around all shapes."""
        box = self._scene.bbox()
        return np.array(
            [np.array(box.min).ravel(), np.array(box.max).ravel()], np.float32
        )

    def picture(self, camera: Camera, *, seed: int) -> Tensor:
        """(H, W, 3 or 4) float32, sRGB in [0, 1] and alpha, whose colours are not
        multiplied with it.
        """
        with tracing_variant(self._variant):
            shape = {"samples": self.samples, "seed": seed}
            return _picture(
                self._scene,
                camera,
                **shape,
                integrator=self._integrator,
                near=self._near,
            )

    def surface(self, camera: Camera, *, seed: int) -> tuple[Tensor, Tensor]:
        """What one ray per pixel meets first."""
        with tracing_variant(self._variant):
            sensor = _sensor(camera, samples=1, seed=seed, near=self._near)
            integrator = mi.load_dict(
                {"type": "aov", "aovs": "point:position,distance:depth"}
            )
            film = np.array(
                mi.render(
                    self._scene, sensor=sensor, integrator=integrator, spp=1, seed=seed
                ),
                np.float32,
            )
        return torch.from_numpy(film[..., :3].copy()), torch.from_numpy(
            film[..., 3].copy()
        )


def in_front(alone: _Depths, nearest: _Depths) -> _Depths:
    """(H, W) bool, where something is the first that a ray meets."""
    return (alone > 0) & (alone <= nearest * (1 + 1e-5))
