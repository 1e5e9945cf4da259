"""The pieces of surface of an object that cameras see."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import Target
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import near_of
from mi_splat.cameras.camera import Camera
from mi_splat.render.renderer import Renderer, RenderSettings, SideOutputs
from mi_splat.scene import GaussianScene

SKY = (0.55, 0.7, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """What the K cameras around an object see."""

    cameras: tuple[Camera, ...]
    directions: Tensor  # (K, 3) float64 unit vectors from the centre to the cameras
    # the (H, W) median depth of each image, infinite where nothing is
    depths: tuple[Tensor, ...]
    # (K,) share of the rays near the object that end in one place or meet nothing: the
    # rest is fog
    clear: Tensor
    keys: Tensor  # (S,) int64 voxel and face, of each piece that a camera sees
    seen_by: Tensor  # (S,) int64 which camera that is
    # (S, 10) over the pixels of the piece: number, points, normals towards the camera,
    # colours
    sums: Tensor
    # of some cameras (P,) pixels that show surface, and which of the S
    pixels: dict[int, tuple[Tensor, Tensor]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Elements:
    """Pieces of surface: what lies in one voxel and faces along the same axis."""

    # (K, E, 5) of each camera and piece: whether it is seen, mean colour, sum of its
    # squares
    moments: Tensor
    positions: Tensor  # (E, 3)
    normals: Tensor  # (E, 3) unit vectors
    judged: Tensor  # (E,) bool, no edge, no rim and near the object
    size: float  # side of a voxel
    # (S,) int64 piece of each that a camera sees; -1 where too few cameras do
    of_seen: Tensor
    # voxels near the object that show somewhere, but no piece of which enough cameras
    # see
    unseen: int


def sight(
    scene: GaussianScene,
    target: Target,
    cameras: Sequence[Camera],
) -> Sight:
    """Look at an object from all cameras."""
    render = Renderer(RenderSettings(background=SKY, near=near_of(target, cameras)))
    depths = []
    clear = []
    parts = []
    shown_by = {}
    first = 0
    with torch.no_grad():
        for number, camera in enumerate(cameras):
            outputs = render.outputs(scene, camera)
            is_empty = outputs.alpha <= 0.5
            depths.append(outputs.median_depth.masked_fill(is_empty, math.inf))
            ahead = rays(camera)
            clear.append(_clear(outputs, ahead, camera, target))
            points, normals, shown = _surface(outputs, ahead, camera, target)
            pixels = shown.flatten().nonzero()[:, 0]
            colours = outputs.image.flatten(0, 1)[pixels].clamp(0, 1)
            geometry = torch.cat([points, normals]).flatten(1)[:, pixels].T
            values = torch.cat([geometry, colours], 1)
            keys, seen = torch.unique(_keys(values, target), return_inverse=True)
            counted = torch.cat([torch.ones(len(pixels), 1), values], 1)
            sums = _sums(counted, seen, len(keys))
            parts.append((keys, torch.full_like(keys, number), sums))
            if number % LIMITS.heat_every == 0:
                shown_by[number] = pixels, seen + first
            first += len(keys)
    keys, seen_by, sums = (torch.cat(values) for values in zip(*parts, strict=True))
    positions = torch.stack([camera.position for camera in cameras])
    return Sight(
        cameras=tuple(cameras),
        directions=functional.normalize(positions - target.centre, dim=1),
        depths=tuple(depths),
        clear=torch.tensor(clear),
        keys=keys,
        seen_by=seen_by,
        sums=sums,
        pixels=shown_by,
    )


def missed_by(
    ahead: Tensor, camera: Camera, target: Target
) -> tuple[Tensor, Tensor, Tensor]:
    """Lengths of (3, H, W) rays, how far along them they pass an object, and by how
    much they miss its centre.
    """
    offset = (target.centre - camera.position).float()
    length = lengths(ahead)
    along = (ahead * offset[:, None, None]).sum(0) / length
    square = offset.square().sum() - along.square()
    return length, along, square.clamp(min=0).sqrt()


def _clear(
    outputs: SideOutputs, ahead: Tensor, camera: Camera, target: Target
) -> float:
    """Share of the rays near an object that end in one place, or meet nothing."""
    length, _, miss = missed_by(ahead, camera, target)
    spread = (outputs.depth - outputs.median_depth).abs() * length
    is_one = spread < LIMITS.one_place * target.radius
    is_solid = outputs.alpha > LIMITS.solid_ray
    is_empty = outputs.alpha < LIMITS.empty_ray
    is_clear = (is_one & is_solid) | is_empty
    return float(is_clear[miss < target.radius].float().mean())


def _keys(values: Tensor, target: Target) -> Tensor:
    """(P,) int64 number of the voxel and the face of surface at (P, 6 or more) points
    and normals.
    """
    offsets = values[:, :3] - target.centre.float()
    x, y, z = ((offsets / _size(target)).floor().long() + 512).unbind(1)
    normals = values[:, 3:6]
    axis = normals.abs().argmax(1)
    face = 2 * axis + (normals.gather(1, axis[:, None])[:, 0] > 0)
    return ((x * 1024 + y) * 1024 + z) * 8 + face


def _size(target: Target) -> float:
    """Side of a voxel."""
    return 2 * target.radius / target.cells


def rays(camera: Camera) -> Tensor:
    """(3, H, W) float32 rays through the pixels in the world, of length 1 along the
    optical axis.
    """
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    across = x.expand(len(y), -1)
    down = y[:, None].expand(-1, len(x))
    local = torch.stack([across, down, torch.ones(len(y), len(x))])
    turn = camera.to_world[:3, :3].float()
    return (turn @ local.flatten(1)).reshape(local.shape)


def lengths(vectors: Tensor) -> Tensor:
    """(H, W) lengths of (3, H, W) vectors; in less time than `norm` takes along the
    first axis.
    """
    return vectors.square().sum(0).sqrt()


def _surface(
    outputs: SideOutputs, ahead: Tensor, camera: Camera, target: Target
) -> tuple[Tensor, Tensor, Tensor]:
    """(3, H, W) points and normals of a picture, and (H, W) bool which pixels show
    surface.
    """
    eye = camera.position.float()[:, None, None]
    centre = target.centre.float()[:, None, None]
    depth = outputs.median_depth
    points = ahead * depth + eye
    # beyond the edge, nothing is shown
    along, down = (points.roll(-2, axis) - points.roll(2, axis) for axis in (2, 1))
    # the cross product
    normals = along.roll(-1, 0) * down.roll(-2, 0) - along.roll(-2, 0) * down.roll(
        -1, 0
    )
    length = lengths(normals)
    normals /= length.clamp(min=1e-20)
    facing = -(normals * ahead).sum(0) / lengths(ahead)
    normals *= facing.sign()
    shown = (
        (outputs.alpha > LIMITS.opaque)
        & (depth > 0)
        & (length > 0)
        & (facing.abs() > LIMITS.facing)
    )
    shown &= lengths(points - centre) < LIMITS.reach * target.radius
    edge = LIMITS.depth_edge * target.radius
    for values, kept in ((depth, shown), (depth.T, shown.T)):
        for step in (1, 2):
            level = (values[step:] - values[:-step]).abs() <= edge
            kept[step:] &= level
            kept[:-step] &= level
    shown[:2] = shown[-2:] = False
    shown[:, :2] = shown[:, -2:] = False
    return points, normals, shown


def elements(view: Sight, target: Target) -> Elements:
    """The pieces of surface that at least `LIMITS.least_views` cameras see."""
    pieces, of_seen = torch.unique(view.keys, return_inverse=True)
    sums = _sums(view.sums, of_seen, len(pieces))
    pixels = sums[:, :1]
    positions = sums[:, 1:4] / pixels
    normals = sums[:, 4:7] / pixels
    gaps = (positions - target.centre.float()).norm(dim=1)
    near = gaps < LIMITS.around * target.radius
    views = torch.bincount(of_seen, minlength=len(pieces))
    kept = views >= LIMITS.least_views
    number = torch.where(kept, kept.cumsum(0) - 1, -1)[of_seen]
    kept_pixels = number >= 0
    colours = view.sums[kept_pixels, 7:] / view.sums[kept_pixels, :1]
    squares = colours.square().sum(1, keepdim=True)
    values = torch.cat([torch.ones(len(colours), 1), colours, squares], 1)
    moments = torch.zeros(len(view.cameras), int(kept.sum()), 5)
    moments[view.seen_by[kept_pixels], number[kept_pixels]] = values
    length = normals.norm(dim=1)
    kept_normals = functional.normalize(normals[kept], dim=1)
    voxels, voxel_of = torch.unique(pieces[near] // 8, return_inverse=True)
    per_piece = torch.stack([pixels[near, 0], kept[near].float()], 1)
    shown = _sums(per_piece, voxel_of, len(voxels))
    is_seen = shown[:, 0] >= LIMITS.least_pixels
    has_piece = shown[:, 1] > 0
    agrees = length > LIMITS.agreed
    return Elements(
        moments=moments,
        positions=positions[kept],
        normals=kept_normals,
        judged=(agrees & near)[kept] & ~_rims(pieces[kept], kept_normals),
        size=_size(target),
        of_seen=number,
        unseen=int((is_seen & ~has_piece).sum()),
    )


def own_surface(
    scene: GaussianScene, pieces: Elements, target: Target, beside: Sequence[Target]
) -> Elements:
    """Pieces of which an object's own are judged: no ground, which dilutes what
    changes, and nothing beside it.
    """
    own = pieces.judged & target.above(scene, pieces.positions, LIMITS.above)
    to_own = _radii_away(pieces.positions, target)
    for other in beside:
        own &= to_own <= _radii_away(pieces.positions, other)
    if int(own.sum()) >= LIMITS.least_pieces:
        return dataclasses.replace(pieces, judged=own)
    return pieces


def _radii_away(positions: Tensor, target: Target) -> Tensor:
    """(E,) distances from the centre of an object, in its radii."""
    gaps: Tensor = (positions - target.centre.float()).norm(dim=1)
    return gaps / target.radius


def _rims(keys: Tensor, normals: Tensor) -> Tensor:
    """(E,) bool, pieces that have a neighbour which faces across; sorted keys tell the
    voxel and face of each.
    """
    rims = torch.zeros(len(keys), dtype=torch.bool)
    last = max(len(keys) - 1, 0)
    steps = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
    for step in ((steps[:, 0] * 1024 + steps[:, 1]) * 1024 + steps[:, 2]).tolist():
        for face in range(6):
            wanted = (keys // 8 + step) * 8 + face
            neighbour = torch.searchsorted(keys, wanted).clamp(max=last)
            across = (normals * normals[neighbour]).sum(1).abs() < LIMITS.across
            rims |= across & (keys[neighbour] == wanted)
    return rims


def _sums(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """(groups, C) sums of rows."""
    return torch.zeros(groups, values.shape[1]).index_add_(0, group, values)
