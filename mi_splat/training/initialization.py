"""Gaussians to begin a training with: on the points of a cloud, beside them, or
anywhere in a box.
"""

from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from mi_splat.cameras.camera import Camera, View, cameras_of, project_points
from mi_splat.cameras.framing import looked_at
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.maths.neighbours import nearest_distances
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import GaussianScene

_NEAREST = 3
"""Neighbours whose distances make the size of a Gaussian."""
_MATCHED = 3
_ROUNDS = 32
"""Images in which an outlier lies at least, and how often as many as are wanted are
drawn.
"""


def spacing(points: Tensor) -> Tensor:
    """Root mean squared distance of each point to its three nearest neighbours.

    Args:
        points: (N, 3) world units.

    Returns:
        (N,) world units; 1 for a single point.

    Raises:
        InvalidValueError: A coordinate is not finite.
    """
    finite = points.isfinite().all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0, 0])
        got = f"{points[row].tolist()} in row {row}"
        raise InvalidValueError.of(
            "points", "finite coordinates", got, "remove those points"
        )
    nearest = min(_NEAREST, len(points) - 1)
    if nearest < 1:
        return torch.ones(len(points), dtype=points.dtype)
    distances = nearest_distances(points.detach().cpu(), nearest)
    return distances.square().mean(1).sqrt().to(points)


def from_points(
    points: Tensor | NDArray[Any],
    colours: Tensor | NDArray[Any],
    *,
    opacity: float = 0.1,
) -> GaussianScene:
    """Round Gaussians on points, as large as the points are apart (Kerbl et al. 2023,
    section 5.1).

    Args:
        points: (N, 3) world units, of torch or NumPy.
        colours: (N, 3) sRGB in [0, 1].
        opacity: Opacity of all of them.

    Returns:
        One Gaussian for each point, in their order.

    Raises:
        InvalidValueError: The shapes differ, or there are no points.
    """
    points, colours = (torch.as_tensor(values).float() for values in (points, colours))
    if (
        points.ndim != 2
        or points.shape[-1] != 3
        or points.shape != colours.shape
        or not len(points)
    ):
        shapes = (tuple(points.shape), tuple(colours.shape))
        raise InvalidValueError.of(
            "points and colours", "two of shape (N, 3)", shapes, "pass a cloud"
        )
    count = len(points)
    size = spacing(points).clamp(min=1e-7)
    return GaussianScene(
        means=points.clone(),
        scales=size[:, None].expand(count, 3).contiguous(),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), opacity),
        sh=colour_to_dc(colours)[:, None],
    )


def with_outliers(
    cloud: PointCloud, views: Sequence[View], count: int, *, seed: int = 0
) -> PointCloud:
    """A cloud with points in the air, as false matches leave them in one from structure
    from motion.
    """
    if count < 0 or not len(views) or not len(cloud.points):
        got = (count, len(views), len(cloud.points))
        raise InvalidValueError.of(
            "count, views and points",
            "0 or more, and some of each",
            got,
            "check the set",
        )
    generator = Generator().manual_seed(seed)
    cameras = cameras_of(views)
    positions = torch.stack([camera.position for camera in cameras])
    beside = cloud.points[:0].to(positions)
    owners = torch.zeros(0, dtype=torch.int64)
    for _ in range(_ROUNDS):
        eyes = positions[torch.randint(len(positions), (count,), generator=generator)]
        seen = torch.randint(len(cloud.points), (count,), generator=generator)
        fraction = 0.1 + 0.8 * torch.rand(
            count, 1, generator=generator, dtype=torch.float64
        )
        drawn = eyes + fraction * (cloud.points[seen].to(eyes) - eyes)
        kept = sum(_in_picture(drawn, camera).int() for camera in cameras) >= min(
            _MATCHED, len(cameras)
        )
        beside = torch.cat([beside, drawn[kept]])[:count]
        owners = torch.cat([owners, seen[kept]])[:count]
        if len(beside) == count:
            break
    points = torch.cat([cloud.points, beside.to(cloud.points)])
    return PointCloud(points, torch.cat([cloud.colours, cloud.colours[owners]]))


def thinned(cloud: PointCloud, count: int, *, seed: int = 0) -> PointCloud:
    """A random part of a cloud, in its order; all of it if it has no more than `count`
    points.
    """
    if len(cloud.points) <= count:
        return cloud
    kept = (
        torch.randperm(len(cloud.points), generator=Generator().manual_seed(seed))[
            :count
        ]
        .sort()
        .values
    )
    return PointCloud(cloud.points[kept], cloud.colours[kept])


def _in_picture(points: Tensor, camera: Camera) -> Tensor:
    """(N,) bool, which of (N, 3) points lie in a camera's image, whatever is in front
    of them.
    """
    pixels, depth = project_points(points, camera)
    size = pixels.new_tensor([camera.width, camera.height])
    return (depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)


def random_points(views: Sequence[View], count: int, *, seed: int = 0) -> GaussianScene:
    """Gaussians of random colour in a box around where the cameras look: the point
    nearest to all optical axes.
    """
    if count < 1 or not len(views):
        raise InvalidValueError.of(
            "count and views",
            "at least one of each",
            (count, len(views)),
            "ask for more",
        )
    cameras = cameras_of(views)
    positions = torch.stack([camera.position for camera in cameras])
    centre = looked_at(cameras)
    half = 0.5 * (positions - centre).norm(dim=1).mean()
    generator = Generator().manual_seed(seed)
    points = centre + half * (
        2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    )
    return from_points(points, torch.rand(count, 3, generator=generator))
