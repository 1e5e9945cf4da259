"""Where a scene's Gaussians are, which cameras see them, and how near a camera they may
be to be drawn.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene

REFERENCE_NEAR = 0.2
"""Near plane of the 3DGS reference rasteriser, world units."""
_LOOSE = 3.0
"""How much larger than the ball that holds half of the means a scene may be."""
_NEAR_SHARE = 0.1
_LEAST_SHARE = 0.001
_SIGMAS = 3.0
"""Standard deviations to which a Gaussian is visible."""
_SAMPLE = 1000
_STIFFNESS = 1e-6
"""Weight of the squared distance to the origin beside those to axes."""


def bounds(scene: GaussianScene) -> tuple[tuple[float, float, float], float]:
    """Middle and radius, world units, of what there is to look at.

    They are those of the box around the middle 98 % of the means along each axis: the
    rest are often floaters. Where that is more than three times as large as the ball
    that holds half of the means, there is a sky or a background, too; then it is that
    ball about the median of the means, three times as large.
    """
    if not len(scene):
        raise InvalidValueError.of(
            "scene", "Gaussians to look at", "none", "pass another file"
        )
    means = scene.means.detach().double().cpu()
    ordered = means.sort(dim=0).values
    last = len(ordered) - 1
    low = ordered[round(0.01 * last)]
    high = ordered[round(0.99 * last)]
    middle = (low + high) / 2
    radius = float(torch.linalg.vector_norm(high - low)) / 2
    median = means.median(dim=0).values
    half = _LOOSE * float((means - median).norm(dim=1).median())
    if 0 < half < radius:
        middle = median
        radius = half
    x, y, z = middle.tolist()
    return (x, y, z), max(radius, float(scene.scales.detach().mean()))


def looked_at(cameras: Sequence[Camera]) -> Tensor:
    """(3,) float64 point, world units, that is nearest to the optical axes of cameras.

    It minimises the sum of squared distances to the axes; where these are parallel,
    which leaves it open, it is the nearest to the origin.
    """
    positions = torch.stack([camera.position for camera in cameras])
    axes = torch.stack([camera.to_world[:3, 2] for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    system = across.sum(0) + _STIFFNESS * torch.eye(3, dtype=torch.float64)
    towards = (across @ positions[:, :, None]).sum(0)[:, 0]
    point: Tensor = torch.linalg.solve(system, towards)
    return point


def near_plane(scene: GaussianScene, cameras: Sequence[Camera] = ()) -> float:
    """The near plane that suits a scene, in world units: the 0.2 of 3DGS, or less where
    scene or cameras are small.
    """
    if len(scene):
        return near_plane_of(*bounds(scene), cameras)
    return REFERENCE_NEAR


def near_plane_of(
    middle: Sequence[float], radius: float, cameras: Sequence[Camera] = ()
) -> float:
    """The near plane that suits a ball, world units, as `near_plane` of a scene."""
    reach = radius
    if cameras:
        eyes = torch.stack([camera.position for camera in cameras])
        reach = min(reach, float((eyes - eyes.new_tensor(middle)).norm(dim=1).median()))
    near = max(_NEAR_SHARE * reach, _LEAST_SHARE * radius)
    if near > 0:
        return min(REFERENCE_NEAR, near)
    return REFERENCE_NEAR


def culled_in_view(scene: GaussianScene, camera: Camera, near: float) -> int:
    """How many Gaussians an image lacks because they are nearer than `near`, though
    inside the view of the camera.
    """
    pose = camera.to_camera
    means = scene.means.detach().double().cpu()
    depth = means @ pose[2, :3] + pose[2, 3]
    # few, mostly none: a training asks for every one of its cameras
    near_by = (depth > 0) & (depth < near)
    pixels, _ = project_points(means[near_by], camera)
    inside = (pixels >= 0) & (
        pixels <= pixels.new_tensor([camera.width, camera.height])
    )
    return int(inside.all(1).sum())


def nothing_in_view(scene: GaussianScene, cameras: Sequence[Camera]) -> str | None:
    """The warning that no Gaussian reaches the images of some cameras; None if all see
    one.
    """
    if not len(scene):
        return "the splat has no Gaussians, so that its images are empty"
    middle, radius = bounds(scene)
    means = scene.means.detach().double().cpu()
    reach = _SIGMAS * scene.scales.detach().double().cpu().amax(1)
    # a few of a large splat are enough for most cameras
    step = max(1, len(means) // _SAMPLE)
    blind = [
        camera
        for camera in cameras
        if not (
            _sees(camera, means[::step], reach[::step]) or _sees(camera, means, reach)
        )
    ]
    return _warning("Gaussian", blind, len(cameras), means.new_tensor(middle), radius)


def no_surface_in_view(
    centre: Sequence[float], radius: float, cameras: Sequence[Camera]
) -> str | None:
    """The warning that a mesh scene within a sphere is outside the images of some
    cameras; None if all see it.
    """
    middle = torch.tensor([list(centre)], dtype=torch.float64)
    blind = [
        camera
        for camera in cameras
        if not _sees(camera, middle, middle.new_tensor([radius]))
    ]
    return _warning("surface", blind, len(cameras), middle[0], radius)


def _sees(camera: Camera, centres: Tensor, radii: Tensor) -> bool:
    """Whether one of some spheres reaches into the viewing frustum of a camera."""
    if not camera.lens.is_perspective:
        return True  # only the frusta of pinhole cameras are tested
    width, height = camera.lens.size
    cx, cy = camera.cx, camera.cy
    planes = [[0, 0, 1], [camera.fx, 0, cx], [-camera.fx, 0, width - cx]]
    planes += [[0, camera.fy, cy], [0, -camera.fy, height - cy]]
    normals = torch.nn.functional.normalize(centres.new_tensor(planes))
    pose = camera.to_camera.to(centres)
    distances = (centres @ pose[:3, :3].T + pose[:3, 3]) @ normals.T
    return bool((distances > -radii[:, None]).all(1).any())


def _warning(
    what: str, blind: Sequence[Camera], count: int, middle: Tensor, radius: float
) -> str | None:
    if not blind:
        return None
    away = sorted(float((camera.position - middle).norm()) for camera in blind)[
        len(blind) // 2
    ]
    return (
        f"no {what} is in view of {len(blind)} of {count} cameras, which are {away:.3g}"
        f" world units away from the middle of a scene of radius {radius:.3g}; their"
        " coordinate frame may be another one: try --up, check --centre, or check"
        " whether their axes follow another convention"
    )
