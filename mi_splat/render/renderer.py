"""Renderer: the rasteriser and the ray tracer of splats as torch functions.

Of the callers of `dr.wrap` there are two: this module, and `mi_splat.render.volprim`
for Mitsuba's own integrator.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, as_cameras
from mi_splat.errors import InvalidValueError, MiSplatError, one_line
from mi_splat.io.documents import save_bytes
from mi_splat.io.picture_files import PictureFileError, check_texture
from mi_splat.render import variant
from mi_splat.render.ray.picture import RayPicture, raytrace, raytrace_backward
from mi_splat.render.ray.splats import prepare
from mi_splat.render.settings import Method, RenderSettings
from mi_splat.render.tile import layouts
from mi_splat.render.tile.colour import develop, develop_backward
from mi_splat.render.tile.frozen import aligned, buffer
from mi_splat.render.tile.picture import Picture
from mi_splat.render.tile.pinhole import Pinhole
from mi_splat.render.tile.pipeline import rasterize, rasterize_backward
from mi_splat.scene import GaussianScene, check_scene


@dataclass(frozen=True, slots=True, eq=False)
class SideOutputs:
    """An image with opacity and depths; w_i = alpha_i T_i is the weight of Gaussian i,
    z_i its mean's depth.

    The median depth is that of the Gaussian at which the transmittance falls to one
    half or below. It is a step function of the scene, and a constant to autograd.
    Depths are in world units, and 0 where there is none.
    """

    image: Tensor  # (H, W, 3) as `Renderer.__call__` gives it, to the bit
    alpha: Tensor  # (H, W) opacity, the sum of w_i
    depth: Tensor  # (H, W) expected depth sum(w_i z_i) / sum(w_i)
    median_depth: Tensor  # (H, W)


def save_floats(channels: Mapping[str, NDArray[np.float32]], path: Path) -> None:
    """Write (H, W) channels by their names as OpenEXR with 32-bit floats, without
    loss.
    """
    variant.use()
    stream = mi.MemoryStream()
    planes = np.stack(list(channels.values()), -1)
    mi.Bitmap(planes, mi.Bitmap.PixelFormat.MultiChannel, list(channels)).write(
        stream, mi.Bitmap.FileFormat.OpenEXR
    )
    save_bytes(bytes(stream.raw_buffer()), path)


def load_floats(path: Path) -> dict[str, NDArray[np.float32]]:
    """(H, W) channels of an OpenEXR file by their names."""
    check_texture(path)
    variant.use()
    try:
        bitmap = mi.Bitmap(str(path))
        pixels = np.asarray(bitmap, dtype=np.float32)
    except (RuntimeError, ValueError, MemoryError) as error:
        got = one_line(
            str(error).splitlines()[-1] if str(error) else type(error).__name__, 160
        )
        raise PictureFileError.of(
            str(path), "an OpenEXR image", got, "write it again"
        ) from error
    planes = np.moveaxis(pixels.reshape(*pixels.shape[:2], -1), 2, 0)
    return dict(zip((part.name for part in bitmap.struct_()), planes, strict=True))


__all__ = ["Method", "RenderSettings", "Renderer", "ScreenGradients"]


class ScreenGradients:
    """What the backward pass of a renderer saw of each Gaussian: the statistics that
    densification goes by.

    Attributes:
        lengths: (N,) length of the gradient of the centre on the screen, in normalised
            device coordinates (half images), summed over the images of the last
            backward pass.
        visible: (N,) in how many of them the Gaussian touched a tile.
    """

    def __init__(self) -> None:
        self.lengths = torch.zeros(0)
        self.visible = torch.zeros(0)

    def _begin(self, count: int, device: str) -> None:
        self.lengths, self.visible = torch.zeros(2, count, device=device)

    def _add(self, screen: Tensor, camera: Camera) -> None:
        self.lengths += (
            screen[:, :2] * screen.new_tensor([camera.width / 2, camera.height / 2])
        ).norm(dim=1)
        self.visible += screen[:, 2]


class _Job:
    """What a render call needs besides tensors; an opaque leaf to `dr.wrap`, which
    would walk through a dataclass.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        renderer: Renderer,
        *,
        side_outputs: bool = False,
    ) -> None:
        self.cameras = tuple(cameras)
        self.settings = renderer.settings
        self.screen_gradients = renderer.screen_gradients
        self.side_outputs = side_outputs
        self.alpha = side_outputs or self.settings.alpha


class Renderer:
    """Renders splats with the rasteriser of `splat_tile` or the ray tracer of
    `splat_ray`; a `RenderFn`.

    Differentiable in the five tensors of the scene (reverse mode) and free of random
    numbers: an image depends on the scene, the camera and the settings only, to the
    bit. So do the gradients of "tile"; the last bits of those of "ray" depend on the
    order in which threads come.

    Args:
        settings: How to render.
        screen_gradients: Filled in every backward pass, if given.

    Raises:
        InvalidValueError: Screen gradients are requested with "ray", which has no
            Gaussians on a screen.
    """

    def __init__(
        self,
        settings: RenderSettings | None = None,
        *,
        screen_gradients: ScreenGradients | None = None,
    ) -> None:
        self.settings = settings or RenderSettings()
        if screen_gradients is not None and self.settings.method == "ray":
            do = 'use the method "tile", or a strategy without them (fixed, mcmc)'
            raise InvalidValueError.of(
                "screen_gradients", 'the method "tile"', '"ray"', do
            )
        self.screen_gradients = screen_gradients
        self.variant = variant.use(self.settings.variant)

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one image.

        Args:
            scene: N Gaussians; N may be 0.
            camera: The camera.

        Returns:
            (H, W, 3) float32 tensor, or (H, W, 4) with `settings.alpha`. Values above 1
            are not clipped.

        Raises:
            InvalidValueError: The scene's tensors are not on the device of the variant
                or not finite, or something else was passed.
        """
        return self.batch(scene, [_one_camera(camera)])[0]

    def batch(
        self, scene: GaussianScene, cameras: Camera | Sequence[Camera]
    ) -> list[Tensor]:
        """Render one image per camera in one differentiable call; sizes may differ.

        Args:
            scene: The splat.
            cameras: One camera or several; each says how large its image is.

        Returns:
            (H, W, 3) or (H, W, 4) float32 of each camera, in their order.
        """
        cameras = as_cameras(cameras)
        if cameras:
            return self._run(scene, _Job(cameras, self))
        return []

    def outputs(self, scene: GaussianScene, camera: Camera) -> SideOutputs:
        """Render one image with its depths; differentiable like `__call__`, the
        median apart.

        Args:
            scene: N Gaussians; N may be 0.
            camera: The camera.

        Returns:
            The image, its opacity, and its expected and median depths.

        Raises:
            InvalidValueError: As in `__call__`, or the method is "ray", whose Gaussians
                have no one depth.
        """
        if self.settings.method != "tile":
            do = 'use a Renderer(RenderSettings(method="tile"))'
            raise InvalidValueError.of(
                "outputs", 'the method "tile"', f'"{self.settings.method}"', do
            )
        image, depth, median = self._run(
            scene, _Job([_one_camera(camera)], self, side_outputs=True)
        )
        return SideOutputs(
            image=image[..., :3],
            alpha=image[..., 3],
            depth=depth,
            median_depth=median.detach(),
        )

    def _run(self, scene: GaussianScene, job: _Job) -> list[Tensor]:
        """What the bridge makes of a checked scene."""
        check_scene("scene", scene)
        variant.use(self.variant)
        device = variant.device_of(self.variant)
        if scene.means.device.type != device:
            expected = f"tensors on {device} for {self.variant}"
            do = f'call scene.to("{device}")'
            raise InvalidValueError.of("scene", expected, scene.means.device, do)
        tensors = [t.to(torch.float32).contiguous() for t in scene.tensors()]
        if not torch.is_grad_enabled():
            tensors = [t.detach() for t in tensors]
        try:
            results = list(_bridge(self.variant)(*tensors, job))
            if len(scene):
                return results
            # Dr.Jit has no gradient of size 0, torch has
            nothing = torch.cat([t.flatten() for t in tensors]).sum()
            return [result.detach() + nothing for result in results]
        except RuntimeError as error:
            known = _own(error)
            if known is None:
                raise
            raise known from None


def _own(error: BaseException | None) -> MiSplatError | None:
    """The error of this library that Dr.Jit wrapped in others, if there is one."""
    while error is not None and not isinstance(error, MiSplatError):
        error = error.__cause__
    return error


def _one_camera(camera: Camera) -> Camera:
    """The camera, if it is one."""
    if not isinstance(camera, Camera):
        do = "call batch(scene, cameras) for several"
        raise InvalidValueError.of("camera", "one Camera", type(camera).__name__, do)
    return camera


@functools.cache
def _bridge(name: str) -> Callable[..., tuple[Tensor, ...]]:
    """The one crossing from torch to Dr.Jit and back, for one variant."""

    def make_pictures(arrays: tuple[Any, ...], job: _Job) -> list[Picture | RayPicture]:
        settings = job.settings
        depths = job.side_outputs
        near = settings.near
        filtered = settings.antialiased
        behind = settings.background
        cameras = [
            Pinhole(camera=camera, near=near, antialiased=filtered)
            for camera in job.cameras
        ]
        if settings.method == "tile":
            return [
                rasterize(layouts.TENSORS, arrays, camera, behind, depths=depths)
                for camera in cameras
            ]
        layouts.check_finite(layouts.TENSORS, arrays)
        splats = prepare(layouts.TENSORS, arrays)
        return [
            raytrace(splats, camera, behind, to_mean=settings.colour_to_mean)
            for camera in cameras
        ]

    class Render(dr.CustomOp):  # type: ignore[misc]
        """A renderer as one node of Dr.Jit's AD graph."""

        def eval(
            self,
            means: Any,
            scales: Any,
            rotations: Any,
            opacities: Any,
            sh: Any,
            job: _Job,
        ) -> Any:
            """One image per camera, followed by its two depths if the job has side
            outputs.
            """
            tensors = (means, scales, rotations, opacities, sh)
            self.shapes = [t.shape for t in tensors]
            # Here and not only in `rasterize`, so that memory that is not aligned is
            # copied once and not once a camera.
            arrays = tuple(aligned(mi.Float(dr.detach(t.array))) for t in tensors)
            self.job = job
            self.pictures = make_pictures(arrays, job)
            results = []
            for camera, picture in zip(job.cameras, self.pictures, strict=True):
                size = camera.width, camera.height
                opacity = picture.opacity if job.alpha else None
                results.append(
                    develop(picture.colour, opacity, size, linear=job.settings.linear)
                )
                if isinstance(picture, Picture):
                    results += [
                        mi.TensorXf(depth, size[::-1]) for depth in picture.depths[:2]
                    ]
            return results

        def backward(self) -> None:
            totals: list[Any] | None = None
            job, screen_gradients, count = (
                self.job,
                self.job.screen_gradients,
                self.shapes[0][0],
            )
            outputs = self.grad_out()
            outputs_of_each = len(outputs) // len(self.pictures)
            if screen_gradients is not None:
                screen_gradients._begin(count, variant.device_of(name))
            for number, (camera, picture) in enumerate(
                zip(job.cameras, self.pictures, strict=True)
            ):
                grad_image, *grad_depths = outputs[number * outputs_of_each :][
                    :outputs_of_each
                ]
                grad_picture = develop_backward(
                    picture.colour,
                    grad_image,
                    alpha=job.alpha,
                    linear=job.settings.linear,
                )
                # not the median's
                grad_picture += tuple(
                    mi.Float(dr.detach(grad.array)) for grad in grad_depths[:1]
                )
                if screen_gradients is None:
                    screen = None
                else:
                    screen = buffer(3 * count, value=0.0)
                if isinstance(picture, RayPicture):
                    gradients = raytrace_backward(picture, *grad_picture)
                else:
                    gradients = rasterize_backward(
                        picture, *grad_picture, screen=screen
                    )
                if gradients is None:
                    continue
                if screen_gradients is not None and screen is not None:
                    screen_gradients._add(screen.torch().reshape(-1, 3), camera)
                if totals is None:
                    totals = list(gradients)
                else:
                    totals = [a + b for a, b in zip(totals, gradients, strict=True)]
            totals = totals or [
                dr.zeros(mi.Float, math.prod(shape)) for shape in self.shapes
            ]
            for key, shape, total in zip(ATTRIBUTES, self.shapes, totals, strict=True):
                self.set_grad_in(key, mi.TensorXf(total, shape))

        def forward(self) -> None:
            do = "use backward(), or jvp by two of them"
            raise InvalidValueError.of(
                "Renderer", "reverse-mode differentiation", "forward mode", do
            )

        def name(self) -> str:
            return "mi_splat.Render"

    @dr.wrap(source="torch", target="drjit")  # type: ignore[untyped-decorator]
    def bridge(
        means: Any, scales: Any, rotations: Any, opacities: Any, sh: Any, job: _Job
    ) -> Any:
        return tuple(dr.custom(Render, means, scales, rotations, opacities, sh, job))

    return bridge  # type: ignore[no-any-return]
