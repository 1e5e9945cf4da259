"""A slow, obvious float64 renderer of the picture that `splat_tile` must make: one loop over Gaussians, no tiles."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene

Array = NDArray[np.float64]


def sh_colour(sh: Array, directions: Array) -> Array:
    """max(0, 0.5 + sum of the real spherical harmonics of 3DGS), written out term by term."""
    x, y, z = directions.T
    terms = [np.full_like(x, 0.28209479177387814)]
    terms += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    terms += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    terms += [
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    basis = np.stack(terms[: sh.shape[1]], axis=1)
    return np.maximum(0.0, 0.5 + np.asarray(np.einsum("nk,nkc->nc", basis, sh), dtype=np.float64))


def quaternion_matrix(q: Array) -> Array:
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def blend(
    scene: GaussianScene, camera: Camera, *, near: float = 0.2, antialiased: bool = False
) -> Iterator[tuple[int, float, Array, Array]]:
    """Gaussians, nearest first: number, depth, weights (H, W), and the transmittance behind it (H, W)."""
    means, scales, rotations, opacities, _ = (t.detach().numpy().astype(np.float64) for t in scene.tensors())
    pose = camera.to_camera.numpy()
    height, width = camera.height, camera.width
    left, stopped = np.ones((height, width)), np.zeros((height, width), dtype=bool)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    # Ranked by the float32 depths that any renderer of float32 splats has: equal depths keep the file's order.
    order = np.argsort(local[:, 2].astype(np.float32), kind="stable")
    ys, xs = np.mgrid[0:height, 0:width] + 0.5
    limit = 1.3 * 0.5 * np.array([width / camera.fx, height / camera.fy])
    for i in order:
        z = local[i, 2]
        if z < near:
            continue
        tangent = local[i, :2] / z
        tx, ty = np.clip(tangent, -limit, limit)
        jacobian = np.array([[camera.fx / z, 0, -camera.fx * tx / z], [0, camera.fy / z, -camera.fy * ty / z]])
        factor = jacobian @ pose[:3, :3] @ quaternion_matrix(rotations[i]) @ np.diag(scales[i])
        blurred = factor @ factor.T + 0.3 * np.eye(2)
        conic = np.linalg.inv(blurred)
        opacity = opacities[i]
        if antialiased:
            opacity *= np.sqrt(max(0.0, np.linalg.det(factor @ factor.T)) / np.linalg.det(blurred))
        dx = xs - (camera.fx * tangent[0] + camera.cx)
        dy = ys - (camera.fy * tangent[1] + camera.cy)
        power = -0.5 * (conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy)
        alpha = np.minimum(0.99, opacity * np.exp(power))
        behind = left * (1 - alpha)
        contributes = (alpha >= 1 / 255) & ~stopped
        stopped |= contributes & (behind < 1e-4)
        contributes &= ~stopped
        weights = np.where(contributes, alpha * left, 0.0)
        left = np.where(contributes, behind, left)
        yield int(i), float(z), weights, left


def render(
    scene: GaussianScene,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = 0.2,
    antialiased: bool = False,
) -> tuple[Array, Array]:
    """The picture (H, W, 3) and its opacity (H, W)."""
    picture, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    directions = scene.means.detach().numpy().astype(np.float64) - camera.position.numpy()
    sh = scene.sh.detach().numpy().astype(np.float64)
    colours = sh_colour(sh, directions / np.linalg.norm(directions, axis=1, keepdims=True)) if len(scene) else None
    for i, _, weights, behind in blend(scene, camera, near=near, antialiased=antialiased):
        assert colours is not None
        picture += weights[..., None] * colours[i]
        left = behind
    return picture + left[..., None] * np.asarray(background), 1 - left


def depths(scene: GaussianScene, camera: Camera, *, near: float = 0.2) -> tuple[Array, Array]:
    """Expected and median depth (H, W); 0 where there is none."""
    total, summed, median = (np.zeros((camera.height, camera.width)) for _ in range(3))
    for _, z, weights, left in blend(scene, camera, near=near):
        total, summed = total + weights, summed + z * weights
        median = np.where((median == 0) & (left <= 0.5), z, median)
    return np.where(total > 0, summed / np.where(total > 0, total, 1), 0), median


def random_scene(count: int, *, degree: int, seed: int, dtype: Any = np.float32) -> GaussianScene:
    """Gaussians on a noisy unit sphere, among them needles, discs, huge and tiny ones."""
    import torch

    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0.7, 1.2, (count, 1))
    scales = 0.06 * np.exp(rng.normal(size=(count, 3)) * 0.5)
    kind = rng.integers(0, 12, count)
    scales[kind == 0] *= [20.0, 0.05, 0.05]
    scales[kind == 1] *= [4.0, 4.0, 0.01]
    scales[kind == 2] *= 0.02
    scales[kind == 3] *= 6.0
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    opacities = np.where(kind == 4, 1.0, rng.uniform(0.0, 1.0, count))
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3
    return GaussianScene(*(torch.from_numpy(a.astype(dtype)) for a in (means, scales, rotations, opacities, sh)))
