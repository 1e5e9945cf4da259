"""Small scenes for `splat_ray` in which a pixel is one ray, so that its value can be written down."""

from typing import Any

import numpy as np
import torch

from mi_splat import variant
from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from tests.oracle import Array, quaternion_matrix, sh_colour

variant.use()

import mitsuba as mi  # noqa: E402

from mi_splat.plugins.shape import shape_dict  # noqa: E402

T = mi.ScalarTransform4f
GREEN = (0.25, 0.5, 0.125)


def gaussian(
    mean: tuple[float, float, float], *, scale: float = 0.5, opacity: float = 0.6, colour: Any = GREEN
) -> GaussianScene:
    """One round Gaussian."""
    return GaussianScene(
        torch.tensor([mean], dtype=torch.float32),
        torch.full((1, 3), scale),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([opacity]),
        colour_to_dc(torch.tensor([[colour]])),
    )


def linear(value: Any) -> Any:
    """Linear value of an sRGB one."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def looking(*, origin: Any = (0, 0, -5), target: Any = (0, 0, 0), size: int = 1) -> dict[str, Any]:
    """A sensor with a narrow field, so that one pixel is one ray."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    up = [0, 1, 0]
    pose = T().look_at(origin=list(origin), target=list(target), up=up)
    return {"type": "perspective", "fov": 1e-3 if size == 1 else 40.0, "to_world": pose, "film": film}


def scene_of(*splats: GaussianScene, integrator: dict[str, Any] | None = None, **parts: Any) -> Any:
    shapes = {f"splat{n}": shape_dict(splat) for n, splat in enumerate(splats)}
    main = {"type": "splat_ray", **(integrator or {})}
    return mi.load_dict({"type": "scene", "integrator": main, "sensor": looking(), **shapes, **parts})


def pixel(loaded: Any, spp: int = 16) -> Any:
    return np.array(mi.render(loaded, spp=spp), dtype=np.float64)[0, 0]


def wall(z: float, **bsdf: Any) -> dict[str, Any]:
    """A large wall that faces the camera."""
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, z]).rotate([0, 1, 0], 180).scale(50),
        "bsdf": bsdf or diffuse(0.5),
    }


def diffuse(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def area(value: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": value}}


def constant(value: float) -> dict[str, Any]:
    return {"type": "constant", "radiance": {"type": "rgb", "value": value}}


def camera_rays(camera: Camera) -> tuple[Array, Array, Array]:
    """Origin (3,), unit directions (H W, 3) through pixel centres, and their lengths per unit of depth (H W,)."""
    ys, xs = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    local = np.stack([(xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy, np.ones_like(xs)], -1).reshape(-1, 3)
    lengths = np.linalg.norm(local, axis=1)
    pose = camera.to_world.numpy()
    return pose[:3, 3], (local / lengths[:, None]) @ pose[:3, :3].T, lengths


def peaks(scene: GaussianScene, origin: Array, directions: Array) -> tuple[Array, Array]:
    """(N, D) distances at which N Gaussians are densest along D rays, and their unclamped alphas there."""
    means, scales, rotations, opacities, _ = (t.detach().numpy().astype(np.float64) for t in scene.tensors())
    distances, alphas = [], []
    for i in range(len(means)):
        whitening = np.diag(1 / scales[i]) @ quaternion_matrix(rotations[i]).T
        g, h = directions @ whitening.T, whitening @ (origin - means[i])
        t = -(g @ h) / (g * g).sum(1)
        distances.append(t)
        alphas.append(opacities[i] * np.exp(-0.5 * ((h + g * t[:, None]) ** 2).sum(1)))
    return np.array(distances), np.array(alphas)


def render(
    scene: GaussianScene,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = 0.2,
    to_mean: bool = False,
) -> tuple[Array, Array]:
    """The picture (H, W, 3) and its opacity (H, W)."""
    origin, directions, lengths = camera_rays(camera)
    sh, means = scene.sh.detach().numpy().astype(np.float64), scene.means.detach().numpy().astype(np.float64)
    distances, alphas = peaks(scene, origin, directions)
    alphas = np.where((alphas >= 1 / 255) & (distances >= near * lengths), np.minimum(alphas, 0.99), 0.0)
    colours = np.empty((*alphas.shape, 3))
    for i in range(len(means)):
        towards = (means[i] - origin)[None] / np.linalg.norm(means[i] - origin) if to_mean else directions
        colours[i] = sh_colour(np.broadcast_to(sh[i], (len(towards), *sh[i].shape)), towards)
    order = np.argsort(distances, axis=0, kind="stable")
    alphas = np.take_along_axis(alphas, order, 0)
    colours = np.take_along_axis(colours, order[..., None], 0)
    picture, left = np.zeros((len(directions), 3)), np.ones(len(directions))
    for alpha, colour in zip(alphas, colours, strict=True):
        picture += (left * alpha)[:, None] * colour
        left = left * (1 - alpha)
        left[left < 1e-4] = 0.0
    picture += left[:, None] * np.asarray(background)
    size = (camera.height, camera.width)
    return picture.reshape(*size, 3), 1 - left.reshape(size)
