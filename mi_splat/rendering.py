"""Renderer: the splat rasteriser as a torch function. The only caller of `dr.wrap`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mi_splat import variant
from mi_splat.cameras import Camera, as_cameras
from mi_splat.errors import InvalidValueError, message
from mi_splat.rasterization.settings import checked_background, checked_near
from mi_splat.scene import GaussianScene, check_scene


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """What a picture of a splat depends on besides the splat and the camera; the defaults are those of 3DGS.

    Attributes:
        background: sRGB colour behind the splat.
        near: Gaussians whose mean is nearer than this (camera-space depth, world units) are culled.
        alpha: Append opacity (1 - transmittance) as a fourth channel.
        linear: Return linear values instead of sRGB.
        variant: Mitsuba variant, "llvm_ad_rgb" or "cuda_ad_rgb"; the current one (or LLVM) if empty.

    Raises:
        InvalidValueError: A number is not finite, `near` is not positive, or the background has not three channels.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = 0.2
    alpha: bool = False
    linear: bool = False
    variant: str = ""

    def __post_init__(self) -> None:
        checked_background(self.background)
        checked_near(self.near)


class ScreenGradients:
    """What the backward pass of a renderer saw of each Gaussian: the statistics that densification goes by.

    Attributes:
        lengths: (N,) length of the gradient of the centre on the screen, in normalised device coordinates (half
            pictures), summed over the pictures of the last backward pass.
        visible: (N,) in how many of them the Gaussian touched a tile.
    """

    def __init__(self) -> None:
        self.lengths = torch.zeros(0)
        self.visible = torch.zeros(0)

    def _begin(self, count: int) -> None:
        self.lengths, self.visible = torch.zeros(count), torch.zeros(count)

    def _add(self, screen: Tensor, camera: Camera) -> None:
        half = torch.tensor([camera.width / 2, camera.height / 2])
        self.lengths += (screen[:, :2] * half).norm(dim=1)
        self.visible += screen[:, 2]


class _Job:
    """What a render call needs besides tensors; an opaque leaf to `dr.wrap`."""

    def __init__(
        self, cameras: Sequence[Camera], settings: RenderSettings, screen_gradients: ScreenGradients | None
    ) -> None:
        self.cameras = tuple(cameras)
        self.settings = settings
        self.screen_gradients = screen_gradients


class Renderer:
    """Renders splats with the `splat_tile` rasteriser; a `RenderFn`.

    Differentiable in the five tensors of the scene (reverse mode), deterministic to the bit, and free of random
    numbers: a picture depends on the scene, the camera and the settings only.

    Args:
        settings: How to render.
        screen_gradients: Filled in every backward pass, if given.
    """

    def __init__(
        self, settings: RenderSettings | None = None, *, screen_gradients: ScreenGradients | None = None
    ) -> None:
        self.settings = settings or RenderSettings()
        self.screen_gradients = screen_gradients
        self.variant = variant.use(self.settings.variant)

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one picture.

        Args:
            scene: N Gaussians; N may be 0.
            camera: The camera.

        Returns:
            (H, W, 3) float32 tensor, or (H, W, 4) with `settings.alpha`. Values above 1 are not clipped.

        Raises:
            InvalidValueError: The scene's tensors are not on the device of the variant, or something else was passed.
        """
        if not isinstance(camera, Camera):
            got = f"{type(camera).__name__}"
            raise InvalidValueError(message("camera", "one Camera", got, "call batch(scene, cameras) for several"))
        return self.batch(scene, [camera])[0]

    def batch(self, scene: GaussianScene, cameras: Camera | Sequence[Camera]) -> list[Tensor]:
        """Render one picture per camera in one differentiable call; sizes may differ."""
        cameras = as_cameras(cameras)
        if not cameras:
            return []
        check_scene("scene", scene)
        variant.use(self.variant)
        device = "cuda" if self.variant.startswith("cuda") else "cpu"
        if scene.means.device.type != device:
            raise InvalidValueError(
                message(
                    "scene", f"tensors on {device} for {self.variant}", scene.means.device, f'call scene.to("{device}")'
                )
            )
        tensors = [t.to(torch.float32).contiguous() for t in scene.tensors()]
        if not torch.is_grad_enabled():
            tensors = [t.detach() for t in tensors]
        return list(_bridge(self.variant)(*tensors, _Job(cameras, self.settings, self.screen_gradients)))


@functools.cache
def _bridge(name: str) -> Callable[..., tuple[Tensor, ...]]:
    """The one crossing from torch to Dr.Jit and back, for one variant."""
    import drjit as dr
    import mitsuba as mi

    from mi_splat.rasterization import layouts, pinhole
    from mi_splat.rasterization.colour import develop, develop_backward
    from mi_splat.rasterization.frozen import aligned, buffer
    from mi_splat.rasterization.picture import Picture
    from mi_splat.rasterization.pipeline import rasterize, rasterize_backward

    class Rasterize(dr.CustomOp):  # type: ignore[misc]
        """Rasteriser as one node of Dr.Jit's AD graph."""

        def eval(self, means: Any, scales: Any, rotations: Any, opacities: Any, sh: Any, job: _Job) -> Any:
            """One image per camera.

            Args:
                means: TensorXf (N, 3), world units.
                scales: TensorXf (N, 3), standard deviations, world units.
                rotations: TensorXf (N, 4), quaternions w, x, y, z.
                opacities: TensorXf (N,).
                sh: TensorXf (N, K, 3).
                job: Cameras and settings.
            """
            tensors = (means, scales, rotations, opacities, sh)
            self.shapes = [t.shape for t in tensors]
            # Here and not only in `rasterize`, so that memory that is not aligned is copied once and not once a camera.
            arrays = tuple(aligned(mi.Float(dr.detach(t.array))) for t in tensors)
            self.job = job
            self.pictures: list[Picture] = []
            images = []
            for camera in job.cameras:
                numbers = pinhole.from_camera(camera, near=job.settings.near)
                picture = rasterize(layouts.TENSORS, arrays, numbers, job.settings.background)
                self.pictures.append(picture)
                images.append(develop(picture, numbers.size, alpha=job.settings.alpha, linear=job.settings.linear))
            return images

        def backward(self) -> None:
            totals: list[Any] | None = None
            settings, screen_gradients, count = self.job.settings, self.job.screen_gradients, self.shapes[0][0]
            if screen_gradients is not None:
                screen_gradients._begin(count)
            for camera, picture, grad_image in zip(self.job.cameras, self.pictures, self.grad_out(), strict=True):
                grad_picture = develop_backward(picture, grad_image, alpha=settings.alpha, linear=settings.linear)
                screen = None if screen_gradients is None else buffer(3 * count, value=0.0)
                gradients = rasterize_backward(picture, *grad_picture, screen=screen)
                if screen_gradients is not None and screen is not None:
                    screen_gradients._add(torch.from_numpy(screen.numpy().reshape(-1, 3)), camera)
                totals = list(gradients) if totals is None else [a + b for a, b in zip(totals, gradients, strict=True)]
            names = ("means", "scales", "rotations", "opacities", "sh")
            for key, shape, total in zip(names, self.shapes, totals or [], strict=True):
                self.set_grad_in(key, mi.TensorXf(total, shape))

        def forward(self) -> None:
            raise InvalidValueError(
                message(
                    "Renderer", "reverse-mode differentiation", "forward mode", "use backward(), or jvp by two of them"
                )
            )

        def name(self) -> str:
            return "mi_splat.Rasterize"

    @dr.wrap(source="torch", target="drjit")  # type: ignore[untyped-decorator]
    def bridge(means: Any, scales: Any, rotations: Any, opacities: Any, sh: Any, job: _Job) -> Any:
        return tuple(dr.custom(Rasterize, means, scales, rotations, opacities, sh, job))

    return bridge  # type: ignore[no-any-return]
