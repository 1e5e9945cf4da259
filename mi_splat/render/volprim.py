"""Mitsuba's own integrator of splats, `volprim_rf_basic`, as a torch function, to
compare with.

The image is in sRGB, as that of `Renderer`, and every pixel is looked at through its
centre. What is Mitsuba's stays so: a Gaussian ends at 3 standard deviations, Gaussians
are met in the order in which a ray enters these shells, 64 at most on each ray, and
what is behind 99 % opacity is left out. After each entry the search goes on 1e-4 world
units farther on, so shells that are entered closer together are missed. Whether a ray
meets a shell that is small beside its distance is decided nearly at random, the more so
the smaller its numbers are (`benchmarks/mitsuba_ellipsoids.py`). So the image depends
on the unit of length.
"""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.render import variant
from mi_splat.render.renderer import RenderSettings
from mi_splat.scene import GaussianScene, check_scene


class Volprim:
    """Renders splats with `volprim_rf_basic`; a `RenderFn`, differentiable in the five
    tensors of the scene.

    Its derivatives hold for colours and opacities. Those of means, scales and rotations
    are wrong where Gaussians overlap: 1 to 50 % off finite differences. Rays begin at
    the near plane, so what they enter before is not met.
    """

    def __init__(self, settings: RenderSettings | None = None) -> None:
        self.settings = settings or RenderSettings()
        if any(self.settings.background):
            got = self.settings.background
            do = "take --background black, or leave volprim out"
            raise InvalidValueError.of(
                "volprim", "a black background, since it adds none", got, do
            )
        if self.settings.alpha or self.settings.linear:
            do = "leave alpha and linear off"
            raise InvalidValueError.of(
                "volprim", "three channels in sRGB", "alpha or linear", do
            )
        self.variant = variant.use(self.settings.variant)

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one image."""
        check_scene("scene", scene)
        variant.use(self.variant)
        if not len(scene):
            return scene.means.new_zeros(camera.height, camera.width, 3)
        tensors = [t.to(torch.float32).contiguous() for t in scene.tensors()]
        if not torch.is_grad_enabled():
            tensors = [t.detach() for t in tensors]
        means, scales, (w, *xyz), opacities, sh = (
            tensors[0],
            tensors[1],
            tensors[2].unbind(1),
            tensors[3],
            tensors[4],
        )
        data = torch.cat([means, scales, torch.stack([*xyz, w], dim=1)], dim=1)
        return _bridge(self.variant)(
            data, opacities[:, None], sh.flatten(1), _Job(camera, self.settings.near)
        )


class _Job:
    """What a render call needs besides tensors; an opaque leaf to `dr.wrap`."""

    def __init__(self, camera: Camera, near: float) -> None:
        self.camera = camera
        self.near = near


@functools.cache
def _bridge(name: str) -> Callable[..., Tensor]:
    """From torch to Mitsuba and back, for one variant."""
    import drjit as dr
    import mitsuba as mi
    from mitsuba.python.ad.integrators.volprim_rf_basic import (
        BasicVolumetricPrimitiveRadianceFieldIntegrator,
    )

    from mi_splat.render.plugins.sensor import sensor_dict

    class Centres:
        """A sampler whose points are the middles of the pixels."""

        def __init__(self, sampler: Any) -> None:
            self.sampler = sampler

        def sample_count(self) -> int:
            return int(self.sampler.sample_count())

        def next_2d(self) -> Any:
            return mi.Point2f(0.5)

    class Centred(BasicVolumetricPrimitiveRadianceFieldIntegrator):  # type: ignore[misc]
        """`volprim_rf_basic` that looks through the middle of each pixel; Mitsuba's
        looks at random points of it.
        """

        def sample_rays(self, scene: Any, sensor: Any, sampler: Any) -> Any:
            ray, weight, position = super().sample_rays(scene, sensor, Centres(sampler))
            # no far plane, as with tile and ray
            ray.maxt = dr.full(mi.Float, dr.inf, dr.width(position))
            return ray, weight, position

    @dr.wrap(source="torch", target="drjit")  # type: ignore[untyped-decorator]
    def bridge(data: Any, opacities: Any, sh: Any, job: _Job) -> Any:
        given = {"data": data, "opacities": opacities, "sh_coeffs": sh}
        plain = {key: mi.TensorXf(dr.detach(tensor)) for key, tensor in given.items()}
        sensor = {
            **sensor_dict(job.camera),
            "near_clip": job.near,
            "far_clip": 1e4 * job.near,
        }
        scene = mi.load_dict(
            {
                "type": "scene",
                "splat": {"type": "ellipsoids", **plain},
                "sensor": sensor,
            },
            parallel=False,
        )
        properties = mi.Properties("volprim_rf_basic")
        properties["srgb_primitives"] = False
        parameters = mi.traverse(scene)
        if any(dr.grad_enabled(tensor) for tensor in given.values()):
            for key, tensor in given.items():
                parameters[f"splat.{key}"] = tensor.array
            parameters.update()
        return mi.render(
            scene,
            parameters,
            integrator=Centred(properties),
            spp=1,
            spp_grad=1,
            seed=0,
            seed_grad=1,
        )

    return bridge  # type: ignore[no-any-return]
