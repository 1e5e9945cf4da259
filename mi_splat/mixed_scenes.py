"""A scene file of splats among surfaces as a renderer: pictures of any splat in the place of its own."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mi_splat import variant
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io.scene_parts import scene_parts
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.scene_files import SplatScene, load_mitsuba_scene, values_of

SPLATS = ("gaussians", "ellipsoids")
"""Types of shapes that are splats."""

SAMPLES = 64
"""Samples a pixel where none are asked for."""


def holds_surfaces(path: Path) -> bool:
    """Whether a scene file names shapes that are no splats; False where it cannot be read."""
    try:
        elements = scene_parts(path).elements
    except InvalidValueError:
        return False
    return any(element.get("type") not in SPLATS for element in elements if element.tag == "shape")


class MixedScene:
    """A Mitsuba scene of splats among surfaces; a `RenderFn` whose pictures have no gradient.

    Args:
        path: An XML scene with the integrator `splat_ray`.
        samples: A pixel.
        seed: Of the samples.
        linear: Whether pictures have linear values, without an upper limit.
        parameters: Take the place of the file's default values, for instance `sun_z=0.25`.

    Attributes:
        splats: Its Gaussians, objects and cameras.

    Raises:
        MiSplatError: The file cannot be read, holds no splat or no sensor, or has another integrator.
    """

    def __init__(
        self, path: Path, *, samples: int = SAMPLES, seed: int = 0, linear: bool = False, **parameters: Any
    ) -> None:
        if samples < 1:
            raise InvalidValueError.of("samples", "at least 1", samples, "64 are little noise")
        variant.use()
        self._loaded = load_mitsuba_scene(path, **parameters)
        if type(self._loaded.integrator()).__name__ != "SplatRay":
            do = 'write <integrator type="splat_ray"/>'
            raise InvalidValueError.of(str(path), "the integrator splat_ray", "another one", do)
        self.splats: SplatScene = values_of(self._loaded, path, among="surfaces")
        self.samples, self.seed, self.linear = samples, seed, linear

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one picture."""
        import mitsuba as mi

        from mi_splat.plugins.sensor import sensor_dict
        from mi_splat.rasterization.colour import srgb_value

        self._put(scene)
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb"}
        sensor = mi.load_dict({**sensor_dict(camera), "film": film})
        picture = self._loaded.integrator().render(self._loaded, sensor, seed=self.seed, spp=self.samples)
        flat = picture.array if self.linear else srgb_value(picture.array)
        values = torch.from_numpy(flat.numpy().copy()).reshape(camera.height, camera.width, 3)
        return values if self.linear else values.clamp(0.0, 1.0)

    def _put(self, scene: GaussianScene) -> None:
        """Put Gaussians into the shapes of the file."""
        import mitsuba as mi

        from mi_splat.plugins.shape import ellipsoid_arrays

        check_scene("scene", scene)
        if len(scene) != len(self.splats.scene):
            expected, do = f"{len(self.splats.scene):,} Gaussians", "take a changed copy of the file's own"
            raise InvalidValueError.of("scene", expected, f"{len(scene):,}", do)
        params = mi.traverse(self._loaded)
        for name, rows in self.splats.objects.items():
            for key, value in ellipsoid_arrays(scene.select(torch.arange(len(scene))[rows])).items():
                params[f"{name}.{key}"] = mi.Float(value.array)
        params.update()
