"""Pieces of surface, and the colour that each camera sees on each: what all judgements are made of."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.frames import Target
from mi_splat.cameras import Camera, focal_of, look_at
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

SIZE, FOV = 128, 45.0
"""Pixels of a picture to each side, and its field of view in degrees."""
CAMERAS, CAMERAS_ALL_AROUND = 150, 240
"""Cameras above a ground, and those around an object that stands on none."""
LEAST_VIEWS = 8
"""A piece of surface that fewer cameras see is not judged."""
EVERY = 6
"""Of so many cameras one takes part in saying which Gaussians carry a look."""
_EXTENT, _SHOWS = 4.0, 1 / 255
"""Standard deviations beyond which, and opacity up to which a Gaussian shows in no picture."""
_LEAST_PIXELS = 6
"""A voxel that shows in fewer pixels of all pictures together is noise."""
_LOWEST, _HIGHEST = 4.0, 88.0
_DISTANCE, _NEAR = 2.6, 0.02
"""Radii of the object from its centre to the cameras, and the near plane as a share of that."""
_OPAQUE, _FACING, _EDGE, _REACH, AROUND = 0.9, 0.25, 0.06, 2.4, 1.6
"""Least opacity and least cosine to the view of a pixel that counts; jump of depth and distance from the centre, in
radii, from which one does not; radii around the centre in which surface is judged."""
_AGREED = 0.9
"""Length of the mean normal below which cameras disagree about it: that piece is an edge, and not judged."""
_ACROSS = 0.3
"""Cosine between the normals of two neighbours below which both are a rim, as that of a sign: there colours of several
sides mix, and they are not judged. The two sides of a thin board face away from each other, and are."""
_BACKGROUND = (0.55, 0.7, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """What the cameras around an object see.

    Attributes:
        cameras: K of them.
        directions: (K, 3) float64 unit vectors from the centre to the cameras.
        depths: The (H, W) median depth of each picture, infinite where nothing is.
        keys: (S,) int64 voxel and face, of each piece that a camera sees.
        seen_by: (S,) int64 which camera that is.
        sums: (S, 10) over the pixels of the piece: their number, points, normals towards the camera, and colours.
        pixels: Of every `EVERY`-th camera (P,) int64 the pixels that show surface, and (P,) which of the S they show.
    """

    cameras: tuple[Camera, ...]
    directions: Tensor
    depths: tuple[Tensor, ...]
    keys: Tensor
    seen_by: Tensor
    sums: Tensor
    pixels: dict[int, tuple[Tensor, Tensor]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Elements:
    """Pieces of surface: what lies in one voxel and faces along the same axis.

    Attributes:
        moments: (E, K, 5) of each piece and camera: whether it is seen, its mean colour, and the sum of its squares.
        positions: (E, 3).
        normals: (E, 3) unit vectors.
        judged: (E,) bool, no edge, no rim and near the object.
        size: Side of a voxel.
        of_seen: (S,) int64 piece of each that a camera sees; -1 where too few cameras do.
        unseen: Voxels near the object that show in some pictures, but of which no piece is seen by enough cameras.
    """

    moments: Tensor
    positions: Tensor
    normals: Tensor
    judged: Tensor
    size: float
    of_seen: Tensor
    unseen: int


def lattice(count: int, low: float, high: float) -> Tensor:
    """(count, 3) float64 directions spread evenly over a band of elevations in degrees (Fibonacci lattice)."""
    z = torch.linspace(math.sin(math.radians(low)), math.sin(math.radians(high)), count, dtype=torch.float64)
    turn = torch.arange(count, dtype=torch.float64) * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).clamp(min=0).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)


def basis(up: Tensor | None) -> Tensor:
    """(3, 3) float64 rotation whose third column is `up`; that of the frame if there is none."""
    if up is None:
        return torch.eye(3, dtype=torch.float64)
    helper = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = functional.normalize(torch.linalg.cross(up, helper), dim=0)
    return torch.stack([first, torch.linalg.cross(up, first), up], 1)


def cameras_around(target: Target) -> tuple[Camera, ...]:
    """Cameras on a sphere around an object: above its ground, or all around where it stands on none."""
    if target.up is None:
        directions = lattice(CAMERAS_ALL_AROUND, -_HIGHEST, _HIGHEST)
    else:
        directions = lattice(CAMERAS, _LOWEST, _HIGHEST) @ basis(target.up).T
    distance, focal = _DISTANCE * target.radius, focal_of(math.radians(FOV), SIZE)
    top = (0.0, 0.0, 1.0) if target.up is None else target.up.tolist()
    return tuple(
        Camera(
            to_world=look_at((target.centre + distance * direction).tolist(), target.centre.tolist(), up=top),
            focal=focal,
            width=SIZE,
            height=SIZE,
        )
        for direction in directions
    )


def near_of(target: Target, cameras: Sequence[Camera]) -> float:
    """The near plane of pictures of an object from cameras."""
    return _NEAR * float(torch.stack([camera.position - target.centre for camera in cameras]).norm(dim=1).median())


def in_sight(scene: GaussianScene, target: Target, cameras: Sequence[Camera]) -> Tensor:
    """(M,) rows of the Gaussians that can show before or on surface that is judged; what is behind it is left out."""
    eyes = torch.stack([camera.position for camera in cameras]) - target.centre
    reach = max(_REACH * target.radius, float(eyes.norm(dim=1).max()))
    far = (scene.means - target.centre.float()).norm(dim=1) - _EXTENT * scene.scales.amax(1)
    rows: Tensor = ((far < reach) & (scene.opacities > _SHOWS)).nonzero()[:, 0]
    return rows


def sight(
    scene: GaussianScene, target: Target, cameras: Sequence[Camera], pictures: Sequence[Tensor] | None = None
) -> Sight:
    """Look at an object from all cameras."""
    render = Renderer(RenderSettings(background=_BACKGROUND, near=near_of(target, cameras)))
    depths, parts, shown_by, first = [], [], {}, 0
    with torch.no_grad():
        for number, camera in enumerate(cameras):
            outputs = render.outputs(scene, camera)
            depths.append(outputs.median_depth.masked_fill(outputs.alpha <= 0.5, math.inf))
            points, normals, shown = _surface(outputs.median_depth, outputs.alpha, camera, target)
            pixels = shown.flatten().nonzero()[:, 0]
            image = outputs.image if pictures is None else pictures[number]
            values = torch.cat([points, normals, image.clamp(0, 1)], -1).reshape(-1, 9)[pixels]
            keys, seen = torch.unique(_keys(values, target), return_inverse=True)
            sums = _sums(torch.cat([torch.ones(len(pixels), 1), values], 1), seen, len(keys))
            parts.append((keys, torch.full_like(keys, number), sums))
            if number % EVERY == 0:
                shown_by[number] = pixels, seen + first
            first += len(keys)
    keys, seen_by, sums = (torch.cat(values) for values in zip(*parts, strict=True))
    positions = torch.stack([camera.position for camera in cameras])
    return Sight(
        cameras=tuple(cameras),
        directions=functional.normalize(positions - target.centre, dim=1),
        depths=tuple(depths),
        keys=keys,
        seen_by=seen_by,
        sums=sums,
        pixels=shown_by,
    )


def _keys(values: Tensor, target: Target) -> Tensor:
    """(P,) int64 number of the voxel and the face of surface at (P, 6 or more) points and normals."""
    voxel = ((values[:, :3] - target.centre.float()) / _size(target)).floor().long() + 512
    axis = values[:, 3:6].abs().argmax(1)
    face = 2 * axis + (values[:, 3:6].gather(1, axis[:, None])[:, 0] > 0)
    return ((voxel[:, 0] * 1024 + voxel[:, 1]) * 1024 + voxel[:, 2]) * 8 + face


def _size(target: Target) -> float:
    """Side of a voxel."""
    return 2 * target.radius / target.cells


def rays(camera: Camera) -> Tensor:
    """(H, W, 3) float32 rays through the pixels in the world, of length 1 along the optical axis."""
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = torch.stack([x.expand(camera.height, -1), y[:, None].expand(-1, camera.width)], -1)
    local = torch.cat([local, torch.ones_like(local[..., :1])], -1)
    return local @ camera.to_world[:3, :3].float().T


def _surface(depth: Tensor, alpha: Tensor, camera: Camera, target: Target) -> tuple[Tensor, Tensor, Tensor]:
    """(H, W, 3) points and normals of a picture, and (H, W) bool which pixels show surface.

    A normal comes from the depths two pixels to each side; there may be no jump of depth between them.
    """
    eye, centre = camera.position.float(), target.centre.float()
    points = rays(camera) * depth[..., None] + eye
    along, down = torch.zeros_like(points), torch.zeros_like(points)
    along[:, 2:-2] = points[:, 4:] - points[:, :-4]
    down[2:-2] = points[4:] - points[:-4]
    normals = torch.linalg.cross(along, down)
    length = normals.norm(dim=-1)
    normals = normals / length.clamp(min=1e-20)[..., None]
    facing = (normals * functional.normalize(eye - points, dim=-1)).sum(-1)
    normals = normals * facing.sign()[..., None]
    shown = (alpha > _OPAQUE) & (depth > 0) & (length > 0) & (facing.abs() > _FACING)
    shown &= (points - centre).norm(dim=-1) < _REACH * target.radius
    edge = torch.zeros_like(shown)
    for axis in (0, 1):
        for step in (1, 2):
            jump = (depth.roll(step, axis) - depth).abs() > _EDGE * target.radius
            edge |= jump | jump.roll(-step, axis)
    shown &= ~edge
    shown[:2] = shown[-2:] = False
    shown[:, :2] = shown[:, -2:] = False
    return points, normals, shown


def elements(view: Sight, target: Target) -> Elements:
    """The pieces of surface that at least `LEAST_VIEWS` cameras see."""
    count = len(view.cameras)
    pieces, of_seen = torch.unique(view.keys, return_inverse=True)
    sums = _sums(view.sums, of_seen, len(pieces))
    pixels, positions, normals = sums[:, :1], sums[:, 1:4] / sums[:, :1], sums[:, 4:7] / sums[:, :1]
    near = (positions - target.centre.float()).norm(dim=1) < AROUND * target.radius
    kept = torch.bincount(of_seen, minlength=len(pieces)) >= LEAST_VIEWS
    number = torch.where(kept, kept.cumsum(0) - 1, -1)[of_seen]
    kept_pixels = number >= 0
    colours = view.sums[kept_pixels, 7:] / view.sums[kept_pixels, :1]
    moments = torch.zeros(int(kept.sum()) * count, 5)
    moments[number[kept_pixels] * count + view.seen_by[kept_pixels]] = torch.cat(
        [torch.ones(len(colours), 1), colours, colours.square().sum(1, keepdim=True)], 1
    )
    length, kept_normals = normals.norm(dim=1), functional.normalize(normals[kept], dim=1)
    voxels, voxel_of = torch.unique(pieces[near] // 8, return_inverse=True)
    shown = _sums(torch.stack([pixels[near, 0], kept[near].float()], 1), voxel_of, len(voxels))
    return Elements(
        moments=moments.reshape(-1, count, 5),
        positions=positions[kept],
        normals=kept_normals,
        judged=((length > _AGREED) & near)[kept] & ~_rims(pieces[kept], kept_normals),
        size=_size(target),
        of_seen=number,
        unseen=int(((shown[:, 0] >= _LEAST_PIXELS) & (shown[:, 1] == 0)).sum()),
    )


def _rims(keys: Tensor, normals: Tensor) -> Tensor:
    """(E,) bool, pieces that have a neighbour which faces across; sorted keys tell the voxel and face of each."""
    rims, last = torch.zeros(len(keys), dtype=torch.bool), max(len(keys) - 1, 0)
    steps = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
    for step in ((steps[:, 0] * 1024 + steps[:, 1]) * 1024 + steps[:, 2]).tolist():
        for face in range(6):
            wanted = (keys // 8 + step) * 8 + face
            neighbour = torch.searchsorted(keys, wanted).clamp(max=last)
            across = (normals * normals[neighbour]).sum(1).abs() < _ACROSS
            rims |= across & (keys[neighbour] == wanted)
    return rims


def _sums(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """(groups, C) sums of rows."""
    return torch.zeros(groups, values.shape[1]).index_add_(0, group, values)
