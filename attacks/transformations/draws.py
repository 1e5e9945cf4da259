"""Cameras drawn from a region around an object, and what happens to an image between
renderer and detector.

The attack and the judge use the same functions. Where the real thing has no derivative
(8 bits, JPEG), the derivative is that of doing nothing: a straight-through estimate
(Bengio et al. 2013; BPDA, Athalye et al. 2018).
"""

import dataclasses
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from attacks.transformations.config import (
    CameraCone,
    CameraRegion,
    ImageTransformations,
)
from mi_splat.cameras.camera import Camera, RenderFn, orbit_pose
from mi_splat.cameras.directions import UP, Point
from mi_splat.errors import InvalidValueError
from mi_splat.io.images import to_bytes
from mi_splat.maths.rotation import from_z, to_matrix
from mi_splat.maths.srgb import tensor_to_linear, tensor_to_srgb
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene

_BEST_QUALITY = 95
_SAME_SIZE = 0.5
"""Share of the images that keep their size, where others get another one."""
_DARK = 1e-4
"""Images are kept this far from 0 where a power has no derivative."""


def draw_camera(
    cameras: CameraRegion | CameraCone,
    generator: np.random.Generator,
    *,
    centre: Sequence[float],
    radius: float,
    reference: Camera,
    up: Point = UP,
) -> Camera:
    """A camera of a region, with the reference's lens, whose rows are level; or the
    reference itself, turned about the centre.
    """
    if isinstance(cameras, CameraCone):
        return _around(cameras, generator, centre=centre, reference=reference)
    camera = _level(
        cameras, generator, centre=centre, radius=radius, reference=reference
    )
    if tuple(up) == UP:
        return camera
    middle = torch.tensor(list(centre), dtype=torch.float64)
    return camera.turned(from_z(torch.tensor(list(up))), middle)


def _level(
    region: CameraRegion,
    generator: np.random.Generator,
    *,
    centre: Sequence[float],
    radius: float,
    reference: Camera,
) -> Camera:
    """A camera of the region in a world whose up is z."""
    unit = math.dist(reference.position.tolist(), [float(x) for x in centre])
    if not unit > 0:
        do = "choose one that looks at it"
        raise InvalidValueError.of(
            "reference", "a camera away from the object", "one in its middle", do
        )
    # Two of the numbers were those of options that are no more: seeds draw the same
    # cameras as before.
    azimuth, elevation, distance, _, _, *shift = generator.uniform(size=8).tolist()
    pose = orbit_pose(
        [
            c + region.aim * radius * s
            for c, s in zip(centre, _in_ball(shift), strict=True)
        ],
        azimuth=_between(region.azimuths, azimuth),
        elevation=_between(region.elevations, elevation),
        distance=unit * _between(region.distances, distance),
    )
    return dataclasses.replace(reference, to_world=pose)


def _around(
    cone: CameraCone,
    generator: np.random.Generator,
    *,
    centre: Sequence[float],
    reference: Camera,
) -> Camera:
    """The chosen camera, turned about a point and moved along the line to it."""
    share, turned_by, distance = generator.uniform(size=3).tolist()
    # Even in the cosine, as the area of a cap of the sphere is.
    angle = math.acos(1 - share * (1 - math.cos(math.radians(cone.angle))))
    middle = torch.tensor(list(centre), dtype=torch.float64)
    away = reference.position.to("cpu", torch.float64) - middle
    turned = reference.turned(_tilt(away, 2 * math.pi * turned_by, angle), middle)
    factor = 1 + cone.margin * (2 * distance - 1)
    pose = turned.to_world.clone()
    pose[:3, 3] = middle + factor * (pose[:3, 3] - middle)
    return dataclasses.replace(turned, to_world=pose)


def _tilt(direction: Tensor, towards: float, angle: float) -> Tensor:
    """(3, 3) float64, the rotation by an angle about an axis across a direction; angles
    in radians.
    """
    along = from_z(direction)
    axis = math.cos(towards) * along[:, 0] + math.sin(towards) * along[:, 1]
    real = torch.tensor([math.cos(angle / 2)], dtype=torch.float64)
    return to_matrix(torch.cat([real, math.sin(angle / 2) * axis]))


def draw_size(
    changes: ImageTransformations, generator: np.random.Generator, camera: Camera
) -> Camera:
    """The camera with another number of pixels, or as it is."""
    is_other, share = generator.uniform(size=2).tolist()
    if changes.sizes == (1.0, 1.0) or is_other < _SAME_SIZE:
        return camera
    least, most = (math.log(factor) for factor in changes.sizes)
    factor = math.exp(least + (most - least) * share)
    size = (round(camera.width * factor), round(camera.height * factor))
    return resized(camera, size)


def _between(interval: tuple[float, float], share: float) -> float:
    return interval[0] + (interval[1] - interval[0]) * share


def _in_ball(shares: Sequence[float]) -> tuple[float, float, float]:
    """Three numbers in [0, 1] to a point of the unit ball, evenly."""
    height = 2 * shares[0] - 1
    turn = 2 * math.pi * shares[1]
    length = shares[2] ** (1 / 3)
    flat = math.sqrt(max(0.0, 1 - height * height))
    return (
        length * flat * math.cos(turn),
        length * flat * math.sin(turn),
        length * height,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageTransformation:
    """One draw from `ImageTransformations`; the fields are named alike."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of red, green and blue, in linear light; exposure and white balance
    together.
    """
    gamma: float = 1.0  # exponent of the image
    blur: float = 0.0  # standard deviation, pixels
    resize: float = 1.0  # factor
    noise: float = 0.0  # standard deviation
    noise_seed: int = 0  # seed of the noise
    jpeg: int = 0  # quality; 0 for none


def draw_change(
    changes: ImageTransformations, generator: np.random.Generator
) -> ImageTransformation:
    """What happens to one image."""
    exposure, red, blue, gamma, blur, resize, noise, jpeg, seed = generator.uniform(
        size=9
    ).tolist()
    if changes.plain and generator.uniform() < changes.plain:
        return ImageTransformation()
    light = 2.0 ** (changes.exposure * (2 * exposure - 1))
    red, blue = (1 + changes.white_balance * (2 * share - 1) for share in (red, blue))
    return ImageTransformation(
        gains=(light * red, light, light * blue),
        gamma=math.exp(changes.gamma * (2 * gamma - 1)),
        blur=changes.blur * blur,
        resize=1 - (1 - changes.resize) * resize,
        noise=changes.noise * noise,
        noise_seed=int(seed * 2**31),
        jpeg=changes.jpeg
        and changes.jpeg + round((_BEST_QUALITY - changes.jpeg) * jpeg),
    )


def transform_image(picture: Tensor, change: ImageTransformation) -> Tensor:
    """The changed image, differentiable in the image."""
    if change.gains != (1.0, 1.0, 1.0):
        picture = tensor_to_srgb(
            tensor_to_linear(picture) * picture.new_tensor(change.gains)
        )
    if change.gamma != 1.0:
        picture = picture.clamp(min=_DARK) ** change.gamma
    if change.blur > 0:
        picture = _blurred(picture, change.blur)
    if change.resize < 1:
        picture = _resized(picture, change.resize)
    if change.noise > 0:
        generator = torch.Generator().manual_seed(change.noise_seed)
        picture = picture + change.noise * torch.randn(
            picture.shape, generator=generator
        ).to(picture)
    picture = picture.clamp(0, 1)
    if change.jpeg:
        compressed: Tensor = _Jpeg.apply(picture, change.jpeg)
        return compressed
    return picture


def changing(
    render: RenderFn, changes: Mapping[Camera, ImageTransformation]
) -> RenderFn:
    """A renderer to whose images something happens."""

    def changed(scene: GaussianScene, camera: Camera) -> Tensor:
        return transform_image(render(scene, camera).clamp(0, 1), changes[camera])

    return changed


def _blurred(picture: Tensor, sigma: float) -> Tensor:
    """Gaussian blur; the edge pixels go on beyond the edge."""
    reach = max(1, math.ceil(3 * sigma))
    kernel = torch.exp(
        -0.5 * (torch.arange(-reach, reach + 1).to(picture) / sigma) ** 2
    )
    kernel = (kernel / kernel.sum()).expand(3, 1, 1, -1)
    planes = torch.nn.functional.pad(
        picture.permute(2, 0, 1)[None], (reach,) * 4, mode="replicate"
    )
    planes = torch.nn.functional.conv2d(planes, kernel, groups=3)
    planes = torch.nn.functional.conv2d(planes, kernel.transpose(2, 3), groups=3)
    return planes[0].permute(1, 2, 0)


def _resized(picture: Tensor, factor: float) -> Tensor:
    """Made smaller, each new pixel the mean of the old ones, and back to its size, so
    that boxes stay in place.
    """
    height, width = picture.shape[:2]
    small = (max(1, round(height * factor)), max(1, round(width * factor)))
    planes = picture.permute(2, 0, 1)[None]
    planes = torch.nn.functional.interpolate(
        planes, small, mode="bilinear", antialias=True
    )
    planes = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear")
    return planes[0].permute(1, 2, 0)


class _Jpeg(torch.autograd.Function):
    """A real JPEG file forwards, and backwards as if it were not there."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, quality: int) -> Tensor:
        buffer = io.BytesIO()
        Image.fromarray(to_bytes(picture)).save(buffer, format="JPEG", quality=quality)
        with Image.open(buffer) as read:
            pixels = np.asarray(read.convert("RGB"), dtype=np.float32) / 255
        return torch.from_numpy(pixels).to(picture)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
