"""Path-traced pictures of mesh scenes, with exact cameras.

Everything here runs in a variant of Mitsuba that is fast at it (`tracing_variant`) and puts the caller's back
afterwards. Pixels are box-filtered averages, converted to sRGB and clipped to [0, 1]; the same arguments give the same
picture, on any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.assets.daylight import Light, daylight
from mi_splat.assets.mesh import Floats
from mi_splat.assets.srgb import to_linear, to_srgb
from mi_splat.cameras import Camera, View
from mi_splat.capture.mitsuba_meshes import (
    MAX_DEPTH,
    corner_normals,
    load_scene,
    made_in,
    scene_dict,
    shapes,
    tracing_variant,
)
from mi_splat.errors import InvalidValueError
from mi_splat.plugins.sensor import sensor_dict

BRIGHTEST = 1.6
"""Intensity at which each pass of a picture is clipped."""

AT_ONCE = 1 << 21
"""The most paths that are traced at once, which bounds memory; a larger picture is traced in bands of rows."""
_BANDS_APART = 0x9E3779B9
"""Between the seeds of a picture's bands."""

NEAR = 0.01
"""Distance in world units up to which a camera sees nothing."""

PASSES = 2
"""The most passes of one picture; seeds of pictures are so many apart."""

__all__ = [
    "Light",
    "PathTracer",
    "capture",
    "check_camera",
    "corner_normals",
    "daylight",
    "depth_maps",
    "in_front",
    "scene_dict",
    "shapes",
    "to_linear",
    "to_srgb",
    "tracing_variant",
]

_Depths = TypeVar("_Depths", NDArray[Any], Tensor)

OnStep = Callable[[int, int], None]
"""Called after each picture with the number finished and the number wanted."""


def pass_samples(samples: int) -> tuple[int, ...]:
    """Samples of each pass, which sum up to `samples` (1 or more): as equal as `fits_grid` allows."""
    if samples < PASSES:
        return (samples,)
    half = samples // PASSES
    first = [count for count in range(half, 0, -1) if fits_grid(count)]
    exact = (count for count in first if fits_grid(samples - count))
    chosen = next(exact, first[0])
    return chosen, samples - chosen


def fits_grid(samples: int) -> bool:
    """Whether Mitsuba's multi-jittered sampler takes so many samples, and rounds none up.

    Its grid has floor(sqrt(n)) rows that are all full.
    """
    return samples % math.isqrt(samples) == 0


def sampler_type(samples: int) -> str:
    """Name of the Mitsuba sampler that takes exactly so many samples with the least noise."""
    # Correlated multi-jittered (Kensler 2013): at 16 and 64 samples per pixel 6 dB less noise than independent ones.
    return "multijitter" if fits_grid(samples) else "independent"


def _sensor(
    camera: Camera,
    *,
    samples: int,
    seed: int,
    alpha: bool = False,
    near: float = NEAR,
    rows: tuple[int, int] | None = None,
) -> mi.Sensor:
    """A sensor of the whole picture, or of the `rows` from the first up to the second."""
    sampler = {"type": sampler_type(samples), "sample_count": samples, "seed": seed}
    values = {**sensor_dict(camera), "sampler": sampler, "near_clip": near}
    if alpha:
        values["film"] = {**values["film"], "pixel_format": "rgba"}
    if rows is not None:
        crop = {"crop_offset_x": 0, "crop_offset_y": rows[0], "crop_width": camera.width}
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
    """One picture; the mean of passes that are clipped on their own, so that no single bright path leaves a speck.

    With an `integrator`, which has to hide emitters, a fourth channel is the fraction of paths that met a surface.
    The colours are then those of the surfaces alone.
    """
    channels = 3 if integrator is None else 4
    total = np.zeros((camera.height, camera.width, channels))
    given = {} if integrator is None else {"integrator": integrator}
    for number, in_pass in enumerate(pass_samples(samples)):
        height = max(1, AT_ONCE // (in_pass * camera.width))
        for band, first in enumerate(range(0, camera.height, height)):
            rows = (first, min(first + height, camera.height))
            sensor = _sensor(camera, samples=in_pass, seed=seed, alpha=integrator is not None, near=near, rows=rows)
            of_band = (seed * PASSES + number + band * _BANDS_APART) % (1 << 32)
            film = mi.render(scene, sensor=sensor, spp=in_pass, seed=of_band, **given)
            total[slice(*rows)] += np.clip(np.array(film)[..., :channels], 0, BRIGHTEST) * (in_pass / samples)
    if integrator is None:
        return torch.from_numpy(to_srgb(total))
    alpha = np.clip(total[..., 3:], 0, 1)
    colours = to_srgb(total[..., :3] / np.maximum(alpha, 1e-6))
    return torch.from_numpy(np.concatenate([colours, alpha.astype(np.float32)], axis=-1))


def check_camera(camera: Camera) -> None:
    """Raise if no picture can be taken from a camera."""
    with tracing_variant():
        sensor_dict(camera)


class PathTracer:
    """A loaded mesh scene that takes pictures one at a time; each depends on its camera, samples and seed alone."""

    def __init__(
        self, scene: dict[str, Any] | Path, *, samples: int = 32, alpha: bool = False, near: float = NEAR
    ) -> None:
        """Load a scene."""
        if samples < 1:
            raise InvalidValueError.of("samples", "a positive number of samples per pixel", samples, "use 16 or more")
        self.samples, self._near = samples, near
        with tracing_variant(made_in(scene)):
            self._variant = mi.variant()
            self._scene = load_scene(scene)
            if not alpha and self._scene.integrator() is None:
                do = 'add <integrator type="path"/>'
                raise InvalidValueError.of(str(scene), "a scene with an integrator", "none", do)
            hidden = {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True}
            self._integrator = mi.load_dict(hidden) if alpha else None

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the box around all shapes."""
        box = self._scene.bbox()
        return np.array([np.array(box.min).ravel(), np.array(box.max).ravel()], np.float32)

    def picture(self, camera: Camera, *, seed: int) -> Tensor:
        """(H, W, 3 or 4) float32, sRGB in [0, 1] and alpha, whose colours are not multiplied with it."""
        with tracing_variant(self._variant):
            shape = {"samples": self.samples, "seed": seed}
            return _picture(self._scene, camera, **shape, integrator=self._integrator, near=self._near)

    def surface(self, camera: Camera, *, seed: int) -> tuple[Tensor, Tensor]:
        """What one ray per pixel meets first."""
        with tracing_variant(self._variant):
            sensor = _sensor(camera, samples=1, seed=seed, near=self._near)
            integrator = mi.load_dict({"type": "aov", "aovs": "point:position,distance:depth"})
            film = np.array(mi.render(self._scene, sensor=sensor, integrator=integrator, spp=1, seed=seed), np.float32)
        return torch.from_numpy(film[..., :3].copy()), torch.from_numpy(film[..., 3].copy())


def capture(
    scene: dict[str, Any] | Path,
    cameras: Sequence[Camera],
    *,
    samples: int = 32,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> list[View]:
    """Path-traced views of a mesh scene."""
    views = []
    with tracing_variant(made_in(scene)):
        tracer = PathTracer(scene, samples=samples)
        for number, camera in enumerate(cameras):
            views.append(View(camera, tracer.picture(camera, seed=seed + number)))
            if on_step is not None:
                on_step(number + 1, len(cameras))
    return views


def first_hits(scene: mi.Scene, camera: Camera, *, seed: int = 0) -> Floats:
    """(H, W) distance from the camera along one ray a pixel, 0 where it meets nothing; rays depend on the seed only."""
    sensor = _sensor(camera, samples=1, seed=seed)
    film = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "depth"}), spp=1, seed=seed)
    return np.array(film, dtype=np.float32)[..., 0]


def in_front(alone: _Depths, nearest: _Depths) -> _Depths:
    """(H, W) bool, where something is the first that a ray meets."""
    return (alone > 0) & (alone <= nearest * (1 + 1e-5))


def depth_maps(scene: dict[str, Any] | Path, cameras: Sequence[Camera], *, seed: int = 0) -> list[Tensor]:
    """Of each camera, (H, W) float32 distance from its centre to the first surface, 0 where there is none."""
    with tracing_variant(made_in(scene)):
        loaded = load_scene(scene)
        return [torch.from_numpy(first_hits(loaded, camera, seed=seed)) for camera in cameras]
