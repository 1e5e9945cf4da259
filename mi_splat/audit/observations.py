"""What the images of a set show of the same points: colours, and which images see which
point.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.cameras.camera import Camera, View, cameras_of, project_points
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.training.initialization import spacing

DEPTH_SIDE = 128  # pixels along the longer side of a depth image
_LARGEST_DISC = 6  # pixels of its radius
_BEHIND = 2.0  # spacings by which a visible point may lie behind the depth image
_GRAZING = 0.17  # cosine below which a surface is not compared
_NEIGHBOURS = 12  # points that make a normal
_LEAST_IMAGES = 4  # that see a point that is compared
_DARK = 0.02  # sRGB below which a ratio of colours means nothing
_GAIN_ROUNDS = 3
_RINGS = 12  # parts of the images, from the middle outwards


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Colours of P points in V images, each at the exposure of all.

    A point has two sides, as those of a thin sheet show different things; each counts
    as a point of its own.
    """

    colours: Tensor  # (V, P, 3) sRGB; where not seen it means nothing
    seen: Tensor  # (V, P) bool
    directions: Tensor  # (V, 3) unit vectors from the middle of the points to cameras
    # (V, V) distances between two cameras in their mean distance from the middle, which
    # are angles in radians where both are as far away
    separation: Tensor

    def of(self, images: Tensor) -> "Observations":
        """What some images show of the points that enough of them see; (V,) bool."""
        kept = self.seen[images].sum(0) >= _LEAST_IMAGES
        return Observations(
            colours=self.colours[images][:, kept],
            seen=self.seen[images][:, kept],
            directions=self.directions[images],
            separation=self.separation[images][:, images],
        )


def observe(views: Sequence[View], cloud: Tensor, *, most: int) -> Observations:
    """Look up points in all images.

    Args:
        views: The images.
        cloud: (N, 3) points on surfaces, world units; all of them hide what is behind.
        most: At most so many of them are compared, drawn at random.

    Returns:
        What each image shows of them.
    """
    gaps = spacing(cloud)
    gaps = gaps.clamp(max=float(gaps.quantile(0.9)))
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(len(cloud), generator=generator)[:most]
    normals = _normals(cloud, rows)
    cameras = cameras_of(views)
    colours = []
    seen = []
    away = []
    for index, camera in enumerate(cameras):
        visible, pixels = _visible(cloud, gaps, rows, camera)
        towards = functional.normalize(camera.position.float() - cloud[rows], dim=1)
        facing = (towards * normals).sum(1)
        sides = [visible & (facing > _GRAZING), visible & (facing < -_GRAZING)]
        colours.append(_looked_up(views[index].image, pixels).repeat(2, 1))
        seen.append(torch.cat(sides))
        away.append(_squared_away(camera, pixels).repeat(2))
    all_seen = torch.stack(seen)
    kept = all_seen.sum(0) >= _LEAST_IMAGES
    all_seen = all_seen[:, kept]
    middle = cloud.double().median(0).values
    offsets = torch.stack([camera.position for camera in cameras]) - middle
    distances = offsets.norm(dim=1).clamp(min=1e-9)
    scale = (distances[:, None] * distances[None]).sqrt()
    return Observations(
        colours=_without_gain(
            torch.stack(colours)[:, kept], all_seen, torch.stack(away)[:, kept]
        ),
        seen=all_seen,
        directions=(offsets / distances[:, None]).float(),
        separation=(torch.cdist(offsets, offsets) / scale).float(),
    )


def _normals(cloud: Tensor, rows: Tensor) -> Tensor:
    """(P, 3) normals of some points, to either side."""
    _, neighbours = nearest_neighbours(cloud, _NEIGHBOURS)
    around = cloud[neighbours[rows]].double()
    around = around - around.mean(1, keepdim=True)
    covariance = around.transpose(1, 2) @ around
    vectors: Tensor = torch.linalg.eigh(covariance).eigenvectors
    return vectors[:, :, 0].float()


def _visible(
    cloud: Tensor, gaps: Tensor, rows: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """(P,) whether nothing of the cloud hides a point, and (P, 2) its pixel."""
    pixels, depth = project_points(cloud, camera)
    step = max(1.0, max(camera.width, camera.height) / DEPTH_SIDE)
    width = math.ceil(camera.width / step)
    height = math.ceil(camera.height / step)
    small = pixels / step
    ahead = depth > 1e-6
    largest = max(camera.lens.scale)
    radius = gaps * largest / step / depth.clamp(min=1e-6)
    nearest = torch.full((height * width,), math.inf)

    def place(across: int, down: int) -> tuple[Tensor, Tensor]:
        x = (small[:, 0] + across).floor().long()
        y = (small[:, 1] + down).floor().long()
        inside = ahead & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return inside, y * width + x

    usual = float(radius[ahead].quantile(0.9)) if bool(ahead.any()) else 1.0
    reach = min(_LARGEST_DISC, max(1, math.ceil(usual)))
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            inside, number = place(across, down)
            inside &= across**2 + down**2 <= radius.square() + 0.5
            nearest.scatter_reduce_(0, number[inside], depth[inside], "amin")
    inside, number = place(0, 0)
    surface = nearest[number.clamp(0, len(nearest) - 1)]
    shown = inside & (depth <= surface + _BEHIND * gaps)
    return shown[rows], pixels[rows]


def _looked_up(image: Tensor, pixels: Tensor) -> Tensor:
    """(P, 3) colours at pixels, which lie inside where a point is seen."""
    size = pixels.new_tensor([image.shape[1], image.shape[0]])
    grid = (pixels / size * 2 - 1).clamp(-1, 1)[None, None]
    planes = image.permute(2, 0, 1)[None]
    found = functional.grid_sample(planes, grid, align_corners=False)
    return found[0, :, 0].T


def median_of(colours: Tensor, seen: Tensor) -> Tensor:
    """(P, 3) median colour of each point over the images that see it; NaN if none."""
    known = torch.where(seen[..., None], colours, torch.nan)
    return torch.nanmedian(known, 0).values


def _without_gain(colours: Tensor, seen: Tensor, away: Tensor) -> Tensor:
    """The colours at one exposure, without what the lens takes towards the corners.

    Each image has one factor, its exposure; one falloff is common to all of them.
    (V, P) `away` is where the pixels lie, as of `_squared_away`.
    """
    if not seen.shape[1]:
        return colours
    for _ in range(_GAIN_ROUNDS):
        usual = median_of(colours, seen).clamp(min=_DARK)
        ratio = (colours.clamp(min=_DARK) / usual).log().mean(-1)
        gain = torch.nanmedian(torch.where(seen, ratio, torch.nan), 1).values
        rest = ratio - gain.nan_to_num()[:, None]
        change = gain.nan_to_num()[:, None] + _falloff(rest[seen], away[seen], away)
        colours = colours * (-change).exp()[..., None]
    return colours


def _squared_away(camera: Camera, pixels: Tensor) -> Tensor:
    """(P,) squared distances of pixels from the middle of an image, 1 in its
    corners.
    """
    size = pixels.new_tensor([camera.width, camera.height])
    from_middle = pixels / size * 2 - 1
    return from_middle.square().mean(1).clamp(max=1)


def _falloff(ratios: Tensor, away: Tensor, wanted: Tensor) -> Tensor:
    """The polynomial of the squared distance that passes through the medians of (N,)
    logarithms of ratios at (N,) distances, at those that are wanted; 0 in the middle.
    """
    if len(away) < _RINGS * _LEAST_IMAGES:
        return torch.zeros_like(wanted)
    groups = torch.tensor_split(away.argsort(), _RINGS)
    found = torch.stack([ratios[group].median() for group in groups])
    places = torch.stack([away[group].median() for group in groups])
    powers = torch.stack([torch.ones_like(places), places, places.square()], 1)
    solution = torch.linalg.lstsq(powers.double(), found.double()[:, None]).solution
    first, second = (float(value) for value in solution[1:, 0])
    return first * wanted + second * wanted.square()
