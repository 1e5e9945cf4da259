"""Where a scene's Gaussians are, how near a camera they may be to be drawn, and how many are nearer."""

from collections.abc import Sequence

import torch

from mi_splat.cameras import Camera, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene

REFERENCE_NEAR = 0.2
"""Near plane of the 3DGS reference rasteriser, world units."""
_LOOSE = 3.0
"""How much larger than the ball that holds half of the means a scene may be."""
_NEAR_SHARE, _LEAST_SHARE = 0.1, 0.001


def bounds(scene: GaussianScene) -> tuple[tuple[float, float, float], float]:
    """Middle and radius, world units, of what there is to look at.

    They are those of the box around the middle 98 % of the means along each axis: the rest are often floaters. Where
    that is more than three times as large as the ball that holds half of the means, there is a sky or a background,
    too; then it is that ball about the median of the means, three times as large.
    """
    if not len(scene):
        raise InvalidValueError.of("scene", "Gaussians to look at", "none", "pass another file")
    means = scene.means.detach().double().cpu()
    ordered = means.sort(dim=0).values
    last = len(ordered) - 1
    low, high = ordered[round(0.01 * last)], ordered[round(0.99 * last)]
    middle, radius = (low + high) / 2, float(torch.linalg.vector_norm(high - low)) / 2
    median = means.median(dim=0).values
    half = _LOOSE * float((means - median).norm(dim=1).median())
    if 0 < half < radius:
        middle, radius = median, half
    x, y, z = middle.tolist()
    return (x, y, z), max(radius, float(scene.scales.detach().mean()))


def near_plane(scene: GaussianScene, cameras: Sequence[Camera] = ()) -> float:
    """The near plane that suits a scene, in world units: the 0.2 of 3DGS, or less where scene or cameras are small.

    3DGS culls Gaussians nearer than 0.2 world units whatever the scene. An object of 5 cm in metres would be culled
    whole. So near is a tenth of the scene's radius, or of the usual distance of the cameras where that is less, but at
    least a thousandth of the radius and at most 0.2.
    """
    return near_plane_of(*bounds(scene), cameras) if len(scene) else REFERENCE_NEAR


def near_plane_of(middle: Sequence[float], radius: float, cameras: Sequence[Camera] = ()) -> float:
    """The near plane that suits a ball, world units, as `near_plane` of a scene."""
    reach = radius
    if cameras:
        eyes = torch.stack([camera.position for camera in cameras])
        reach = min(reach, float((eyes - eyes.new_tensor(middle)).norm(dim=1).median()))
    near = max(_NEAR_SHARE * reach, _LEAST_SHARE * radius)
    return min(REFERENCE_NEAR, near) if near > 0 else REFERENCE_NEAR


def culled_in_view(scene: GaussianScene, camera: Camera, near: float) -> int:
    """How many Gaussians a picture lacks because they are nearer than `near`, though inside the view of the camera."""
    pose, means = camera.to_camera, scene.means.detach().double().cpu()
    depth = means @ pose[2, :3] + pose[2, 3]
    near_by = (depth > 0) & (depth < near)  # few, mostly none: a training asks for every one of its cameras
    pixels, _ = project_points(means[near_by], camera)
    inside = (pixels >= 0) & (pixels <= pixels.new_tensor([camera.width, camera.height]))
    return int(inside.all(1).sum())
