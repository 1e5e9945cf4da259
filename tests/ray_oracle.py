"""A slow, obvious float64 ray tracer of splats: every Gaussian on every ray, sorted by its peak, no tree."""

from __future__ import annotations

import numpy as np

from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene
from tests.oracle import Array, quaternion_matrix, sh_colour


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
