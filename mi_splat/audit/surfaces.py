"""The objects of a splat in its own frame, cameras around them, and the pieces of
surface that these see.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera, look_at, orbit_pose
from mi_splat.cameras.directions import UP, Point
from mi_splat.cameras.lens import Lens, focal_of
from mi_splat.errors import InvalidValueError
from mi_splat.maths.neighbours import nearest_neighbours, nearest_of
from mi_splat.maths.rotation import from_z, to_matrix
from mi_splat.maths.sh import even_directions
from mi_splat.render.renderer import Renderer, RenderSettings, SideOutputs
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.selection.clusters import clusters, find_plane

# All happens in a frame that turns, moves and grows with the splat, so that a verdict
# depends neither on how the file's axes lie, nor on its unit, nor on the order of its
# rows.


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """The splat in its own frame."""

    scene: GaussianScene  # the Gaussians, moved, turned, resized and sorted
    order: Tensor  # (N,) row of the file of each of them
    to_world: Similarity  # from the frame to the world of the file

    def direction(self, values: Tensor) -> Tensor:
        """(..., 3) directions of the frame as directions of the world."""
        return values.double() @ self.to_world.rotation.double().T

    def own(self, direction: Point) -> Tensor:
        """(3,) float64 unit vector of the frame along a direction of the world."""
        return (
            from_z(torch.tensor(list(direction), dtype=torch.float64))[:, 2]
            @ self.to_world.rotation.double()
        )

    def point(self, values: Tensor) -> Tensor:
        """(..., 3) points of the frame as points of the world."""
        return (
            self.to_world.scale * self.direction(values)
            + self.to_world.translation.double()
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """An object to look at, in the frame of the splat."""

    rows: Tensor  # (M,) its Gaussians
    centre: Tensor  # (3,) float64
    radius: float  # of a ball that holds nearly all of it
    # (3,) float64 unit vector away from the ground; None if it stands on none
    up: Tensor | None
    cells: int = 48  # pieces of surface along its diameter
    # whether it is what is around another, such as a sky: cameras stand within, if at
    # all
    surrounds: bool = False
    # whether it is the core of something larger, which then is around it and covers it
    core: bool = False

    def above(self, scene: GaussianScene, points: Tensor, gap: float) -> Tensor:
        """(...) bool, which (..., 3) points lie so many radii above its foot; all of
        them where it stands on none.
        """
        if self.up is None:
            return torch.ones(points.shape[:-1], dtype=torch.bool)
        up = self.up.float()
        heights = scene.means[self.rows] @ up
        return (
            points @ up
            > heights.kthvalue(max(1, len(heights) // 50)).values + gap * self.radius
        )


def frame_of(scene: GaussianScene) -> Frame:
    """The splat in the frame of its own principal axes."""
    scene = scene.detach().to("cpu", torch.float32)
    colours = scene.sh[:, 0].numpy()
    order = torch.from_numpy(
        np.lexsort(
            (colours[:, 2], colours[:, 1], colours[:, 0], scene.opacities.numpy())
        )
    )
    scene = scene.select(order)
    points = scene.means[scene.opacities > LIMITS.solid].double()
    if not len(points):
        got = f"none of {len(scene):,}"
        do = "pass a splat that shows something"
        raise InvalidValueError.of(
            "scene", f"Gaussians with an opacity above {LIMITS.solid:g}", got, do
        )
    centre = points.mean(0)
    for _ in range(3):
        gaps = (points - centre).norm(dim=1)
        near = points[gaps <= quantile(gaps, LIMITS.crowd)]
        centre = near.mean(0)
    radius = float((near - centre).norm(dim=1).max())
    if not radius > 0:
        do = "pass a splat of a scene, not of a point"
        raise InvalidValueError.of(
            "scene", "Gaussians at several places", "all at one", do
        )
    axes = torch.linalg.eigh((near - centre).T @ (near - centre)).eigenvectors.T.flip(0)
    skew = ((near - centre) @ axes.T).pow(3).sum(0)
    axes = axes * torch.where(skew < 0, -1.0, 1.0)[:, None].double()
    if torch.linalg.det(axes) < 0:
        axes[2] *= -1
    to_frame = Similarity(
        rotation=axes, translation=-(axes @ centre) / radius, scale=1 / radius
    )
    back = Similarity(rotation=axes.T.contiguous(), translation=centre, scale=radius)
    return Frame(scene=scene.transform(to_frame), order=order, to_world=back)


def targets(scene: GaussianScene, stated_up: Tensor | None = None) -> list[Target]:
    """The objects of a splat: at most `LIMITS.most_objects` components that are no
    ground; else where most of it is.

    Of what is around others, only the largest component is judged, too.
    """
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
    points = scene.means[rows].double()
    label = _components(scene.select(rows))
    chosen: list[Target] = []
    for number in range(min(LIMITS.components, int(label.max()) + 1)):
        part = points[label == number]
        if len(part) < max(LIMITS.least_share * len(points), LIMITS.least_count):
            continue
        centre = part.median(0).values
        radius = LIMITS.object_margin * quantile((part - centre).norm(dim=1), 0.95)
        if any(_is_part(part, centre, radius, larger) for larger in chosen):
            continue
        thin = _normal_of_flat(part)
        ground = next((target.up for target in chosen if target.up is not None), None)
        if (
            thin is not None
            and ground is not None
            and abs(float(thin @ ground)) > LIMITS.upright
        ):
            continue
        up = _up(part, centre, radius, points[label != number])
        if thin is not None and (up is None or abs(float(thin @ up)) > LIMITS.upright):
            continue
        chosen.append(
            Target(rows=rows[label == number], centre=centre, radius=radius, up=up)
        )
    chosen = chosen[: LIMITS.most_objects]
    core = _core(rows, points, scene.scales[rows].prod(1))
    loose = all(
        target.up is None and core.radius * LIMITS.loose < target.radius
        for target in chosen
    )
    chosen = _parted(chosen + [dataclasses.replace(core, core=bool(chosen))] * loose)
    ground = next((target.up for target in chosen if target.up is not None), None)
    if ground is None:
        return chosen
    up = ground if stated_up is None else stated_up
    agree = [
        stated_up is None
        and one.up is not None
        and float(one.up @ ground) > LIMITS.upright
        for one in chosen
    ]
    return [
        one if same else dataclasses.replace(one, up=up)
        for one, same in zip(chosen, agree, strict=True)
    ]


def _components(scene: GaussianScene) -> Tensor:
    """(N,) int64 the connected component of each Gaussian, from the largest."""
    every = math.ceil(len(scene) / LIMITS.most_linked)
    if every <= 1:
        return clusters(scene)
    label = clusters(scene.select(slice(None, None, every)))
    nearest = nearest_of(scene.means, every)
    return label[nearest // every]


def _is_part(part: Tensor, centre: Tensor, radius: float, larger: Target) -> bool:
    """Whether a few points lie in an object that is not much larger, and so are seen
    well enough with it.
    """
    large = radius > LIMITS.part_radius * larger.radius
    return (
        _holds(larger, centre)
        and large
        and len(part) < LIMITS.part_share * len(larger.rows)
    )


def _parted(objects: list[Target]) -> list[Target]:
    """Objects, and the first of what is around another."""
    inner = [
        one for one in objects if not any(_surrounds(one, other) for other in objects)
    ]
    outer = [
        dataclasses.replace(one, surrounds=True) for one in objects if one not in inner
    ]
    return inner + outer[:1]


def _surrounds(target: Target, other: Target) -> bool:
    return target.radius > LIMITS.surrounds * other.radius and _holds(
        target, other.centre
    )


def _holds(target: Target, point: Tensor) -> bool:
    return float((point - target.centre).norm()) < target.radius


def whole(scene: GaussianScene) -> Target:
    """All of a splat as one object."""
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
    points = scene.means[rows].double()
    centre = points.median(0).values
    radius = LIMITS.whole_margin * quantile((points - centre).norm(dim=1), 0.5)
    return Target(rows=rows, centre=centre, radius=radius, up=None)


def quantile(values: Tensor, share: float) -> float:
    """The value below which so large a share of (M,) values lies; of any number of
    them.
    """
    return float(values.kthvalue(min(len(values), 1 + int(share * len(values)))).values)


def _normal_of_flat(points: Tensor) -> Tensor | None:
    """The normal of a component that is a plane; None if it is none."""
    sample = points[:: max(1, len(points) // LIMITS.ground_sample)]
    _, extents, axes = torch.linalg.svd(sample - points.mean(0), full_matrices=False)
    if extents[2] >= LIMITS.flat * extents[0]:
        return None
    normal: Tensor = axes[2]
    return normal


def _core(rows: Tensor, points: Tensor, sizes: Tensor) -> Target:
    """Where the smallest Gaussians are: what a training saw best, though ground and fog
    hang together with it.
    """
    small = points[sizes <= quantile(sizes, LIMITS.small)]
    centre = small.median(0).values
    gaps = (points - centre).norm(dim=1)
    radius = LIMITS.whole_margin * quantile(
        (small - centre).norm(dim=1), LIMITS.dense
    ) or float(gaps.max())
    inside = gaps <= radius
    return Target(
        rows=rows[inside],
        centre=centre,
        radius=radius,
        up=_up(points[inside], centre, radius, points),
    )


def _up(part: Tensor, centre: Tensor, radius: float, around: Tensor) -> Tensor | None:
    """The normal of the ground of an object, on its side of it; None if it stands on
    none of the largest planes.
    """
    near = around[(around - centre).norm(dim=1) < LIMITS.ground_reach * radius]
    near = near[:: max(1, len(near) // LIMITS.ground_sample)]
    for _ in range(LIMITS.planes):
        distances, _ = nearest_neighbours(near, 8)
        if not distances.shape[1]:
            return None
        inside = find_plane(
            near, distances[:, -1], least=math.ceil(LIMITS.ground_share * len(near)) + 3
        )
        if inside is None:
            return None
        ground = near[inside]
        near = near[~inside]
        on = ground.mean(0)
        normal: Tensor = torch.linalg.svd(ground - on, full_matrices=False).Vh[2]
        heights = (part - on) @ normal
        if heights.mean() < 0:
            heights = -heights
            normal = -normal
        across = ground - centre - ((ground - centre) @ normal)[:, None] * normal
        above = (
            float((heights > -LIMITS.under * radius).double().mean()) >= LIMITS.one_side
        )
        touches = quantile(heights, 1 - LIMITS.one_side) < LIMITS.touch * radius
        if (
            above
            and touches
            and quantile(across.norm(dim=1), 0.9) > LIMITS.beyond * radius
        ):
            return normal
    return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Voxels of a scene in its own frame."""

    low: Tensor  # (3,) float64 corner
    size: float  # side of a voxel
    filled: Tensor  # (X, Y, Z) bool, whether something is in each

    def ends(self, points: Tensor, directions: Tensor) -> Tensor:
        """(P, D) bool, whether the rays from (P, 3) points in (D, 3) directions meet
        something in the grid.
        """
        limit = torch.tensor(self.filled.shape)
        met = torch.zeros(len(points), len(directions), dtype=torch.bool)
        # of the rays that are in the grid and met nothing
        start, way = torch.ones_like(met).nonzero().unbind(1)
        for step in range(1, 4 * int(limit.max())):
            cell = (
                (
                    (points[start] + step / 2 * self.size * directions[way] - self.low)
                    / self.size
                )
                .floor()
                .long()
            )
            inside = ((cell >= 0) & (cell < limit)).all(-1)
            start, way, (x, y, z) = start[inside], way[inside], cell[inside].unbind(1)
            ends = self.filled[x, y, z]
            met[start[ends], way[ends]] = True
            start = start[~ends]
            way = way[~ends]
        return met


def grid_of(scene: GaussianScene) -> Grid:
    """The voxels that hold the middle of a solid Gaussian, or a point one standard
    deviation from it along an axis.
    """
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
    solid = scene.select(rows[:: math.ceil(len(rows) / LIMITS.room_gaussians)])
    points = solid.means.double()
    axes = (to_matrix(solid.rotations) * solid.scales[:, None]).double()
    reach = torch.cat(
        [
            points,
            *(
                points + sign * axes[:, :, axis]
                for axis in range(3)
                for sign in (-1, 1)
            ),
        ]
    )
    sides = points.unbind(1)
    low = torch.stack(
        [torch.tensor(quantile(side, LIMITS.room_edge)) for side in sides]
    ).double()
    high = torch.stack(
        [torch.tensor(quantile(side, 1 - LIMITS.room_edge)) for side in sides]
    ).double()
    size = max(float((high - low).max()) / LIMITS.room_voxels, 1e-9)
    low = low - size
    shape = ((high - low) / size).ceil().long() + 1
    filled = torch.zeros(*shape.tolist(), dtype=torch.bool)
    cell = ((reach - low) / size).floor().long()
    x, y, z = cell[((cell >= 0) & (cell < shape)).all(1)].unbind(1)
    filled[x, y, z] = True
    return Grid(low=low, size=size, filled=filled)


def free_positions(scene: GaussianScene) -> Tensor | None:
    """(P, 3) float64 positions inside a room from which it is seen; None where the
    scene is seen from outside.
    """
    grid, free, positions, share = _enclosed(scene)
    within = (
        share >= LIMITS.enclosed_share
        and _between(grid, positions, free) > LIMITS.between
    )
    if within:
        return positions
    return None


AROUND = (30.0, 120.0, 210.0, 300.0)
"""Azimuths from which a room may be shown, degrees."""
_AHEAD = 0.9
"""Cosine of an angle to the middle of a picture, up to which it shows a Gaussian."""


class Inside(NamedTuple):
    """Where a camera may stand in a hollow scene."""

    centre: tuple[float, float, float]  # a free position amid the scene, to look at
    distance: float  # from there to the camera, world units
    azimuth: float  # of the camera, degrees
    is_room: bool  # rather than a hollow box, which has nothing in it


def place_inside(
    scene: GaussianScene,
    azimuths: Sequence[float] = AROUND,
    *,
    elevation: float = 20.0,
    up: Point = UP,
) -> Inside | None:
    """Where to stand in a hollow scene, at the azimuth from which most Gaussians are
    ahead.
    """
    if not bool((scene.opacities > LIMITS.solid).any()):
        return None
    grid, free, positions, share = _enclosed(scene)
    if share < LIMITS.enclosed_share:
        return None
    middle = positions[(positions - positions.mean(0)).norm(dim=1).argmin()]
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    places = []
    for azimuth in azimuths:
        way = (
            turn
            @ orbit_pose((0, 0, 0), azimuth=azimuth, elevation=elevation, distance=1)[
                :3, 3
            ]
        )
        distance = _free_on(grid, free, middle, way)
        ahead = (
            functional.normalize(scene.means.double() - middle - distance * way, dim=1)
            @ -way
        )
        places.append((int((ahead > _AHEAD).sum()), distance, azimuth))
    _, distance, azimuth = max(places)
    x, y, z = middle.tolist()
    return Inside(
        (x, y, z), distance, azimuth, _between(grid, positions, free) > LIMITS.between
    )


def _free_on(grid: Grid, free: Tensor, start: Tensor, way: Tensor) -> float:
    """How far it is from a free position to the last free voxel on a way."""
    steps = torch.arange(4 * max(grid.filled.shape))[:, None] / 2 * grid.size
    cells = ((start + steps * way - grid.low) / grid.size).floor().long()
    kept = cells.clamp(min=0).minimum(torch.tensor(grid.filled.shape) - 1)
    ends = (cells != kept).any(1) | ~free[kept.unbind(1)]
    return float(steps[max(1, int(ends.nonzero()[0]) - 1)])


def _enclosed(scene: GaussianScene) -> tuple[Grid, Tensor, Tensor, float]:
    """The grid of a scene, its free voxels, and of those the middles of enclosed ones
    and their share.
    """
    grid = grid_of(scene)
    free = (
        functional.max_pool3d(grid.filled[None, None].float(), 3, stride=1, padding=1)[
            0, 0
        ]
        == 0
    )
    tried = free.nonzero()
    tried = tried[:: max(1, len(tried) // LIMITS.room_places)]
    positions = grid.low + (tried + 0.5) * grid.size
    ends = grid.ends(positions, torch.from_numpy(even_directions(LIMITS.room_rays)))
    enclosed = ends.double().mean(1) > LIMITS.enclosed
    return (
        grid,
        free,
        positions[enclosed],
        float(enclosed.double().sum() / max(1, len(tried))),
    )


def _between(grid: Grid, positions: Tensor, free: Tensor) -> float:
    """Share of the filled voxels that stand between two free places, along an axis of
    the grid.
    """
    marks = torch.zeros(grid.filled.shape)
    x, y, z = ((positions - grid.low) / grid.size).floor().long().unbind(1)
    marks[x, y, z] = 1
    near = functional.max_pool3d(marks[None, None], 5, stride=1, padding=2)[0, 0] > 0
    near &= free
    among = torch.zeros_like(grid.filled)
    for axis in (0, 1, 2):
        before = near.cumsum(axis) > 0
        after = near.flip(axis).cumsum(axis).flip(axis) > 0
        among |= before & after & grid.filled
    return float(among.sum()) / max(1.0, float(grid.filled.sum()))


def cameras_within(target: Target, positions: Tensor) -> tuple[Camera, ...]:
    """Cameras at free positions in a room that show an object; none if hardly any
    position is outside of the object.
    """
    away = positions[
        (positions - target.centre).norm(dim=1) > LIMITS.room_distance * target.radius
    ]
    if len(away) < LIMITS.least_room_cameras:
        return ()
    numbers = (
        torch.linspace(0, len(away) - 1, min(LIMITS.most_room_cameras, len(away)))
        .round()
        .long()
    )
    cameras = []
    for position in away[numbers]:
        ahead = functional.normalize(target.centre - position, dim=0)
        half = LIMITS.room_margin * math.asin(
            target.radius / float((position - target.centre).norm())
        )
        top = torch.eye(3, dtype=torch.float64)[int(ahead.abs().argmin())]
        cameras.append(_camera(position, target, 2 * half, tuple(top.tolist())))
    return tuple(cameras)


def _camera(position: Tensor, target: Target, fov: float, up: Point) -> Camera:
    """A camera that looks at the centre of an object, with a field of view in
    radians.
    """
    size = LIMITS.image_size
    pose = look_at(position.tolist(), target.centre.tolist(), up=up)
    return Camera(
        to_world=pose, lens=Lens(focal=focal_of(fov, size), size=(size, size))
    )


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


def lattice(count: int, low: float, high: float) -> Tensor:
    """(count, 3) float64 directions spread evenly over a band of elevations in degrees
    (Fibonacci lattice).
    """
    z = torch.linspace(
        math.sin(math.radians(low)),
        math.sin(math.radians(high)),
        count,
        dtype=torch.float64,
    )
    turn = torch.arange(count, dtype=torch.float64) * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).clamp(min=0).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)


def basis(up: Tensor | None) -> Tensor:
    """(3, 3) float64 rotation whose third column is `up`; that of the frame if there is
    none.
    """
    if up is None:
        return torch.eye(3, dtype=torch.float64)
    helper = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = functional.normalize(torch.linalg.cross(up, helper), dim=0)
    return torch.stack([first, torch.linalg.cross(up, first), up], 1)


def cameras_around(target: Target, near: Tensor | None = None) -> tuple[Camera, ...]:
    """Cameras on a sphere around an object, above its ground if it stands on one; half
    as many around surroundings.

    Where (M, 3) directions are given, all stand near one of these, below the ground,
    too.
    """
    count, low = (
        (LIMITS.cameras_all_around, -LIMITS.highest)
        if target.up is None
        else (LIMITS.cameras, LIMITS.lowest)
    )
    count //= 1 + target.surrounds
    directions = lattice(count, low, LIMITS.highest) @ basis(target.up).T
    if near is not None:
        directions = lattice(LIMITS.given_lattice, -90.0, 90.0) @ basis(target.up).T
        apart = (directions @ functional.normalize(near, dim=1).T).amax(1)
        directions = directions[apart > math.cos(math.radians(LIMITS.given_near))]
        directions = directions[
            torch.linspace(0, len(directions) - 1, min(len(directions), count))
            .round()
            .long()
        ]
    distance = LIMITS.distance * target.radius
    fov = math.radians(LIMITS.fov)
    top = (0.0, 0.0, 1.0) if target.up is None else target.up.tolist()
    return tuple(
        _camera(target.centre + distance * direction, target, fov, top)
        for direction in directions
    )


def near_of(target: Target, cameras: Sequence[Camera]) -> float:
    """The near plane of pictures of an object from cameras."""
    distances = torch.stack(
        [camera.position - target.centre for camera in cameras]
    ).norm(dim=1)
    return LIMITS.near * float(distances.median())


def in_sight(scene: GaussianScene, target: Target, cameras: Sequence[Camera]) -> Tensor:
    """(M,) rows of the Gaussians that can show before or on surface that is judged;
    what is behind it is left out.
    """
    eyes = torch.stack([camera.position for camera in cameras]) - target.centre
    reach = max(LIMITS.reach * target.radius, float(eyes.norm(dim=1).max()))
    far = (scene.means - target.centre.float()).norm(
        dim=1
    ) - LIMITS.extent * scene.scales.amax(1)
    rows: Tensor = ((far < reach) & (scene.opacities > LIMITS.faintest)).nonzero()[:, 0]
    return rows


def sight(
    scene: GaussianScene,
    target: Target,
    cameras: Sequence[Camera],
    pictures: Sequence[Tensor] | None = None,
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
            depths.append(
                outputs.median_depth.masked_fill(outputs.alpha <= 0.5, math.inf)
            )
            ahead = rays(camera)
            clear.append(_clear(outputs, ahead, camera, target))
            points, normals, shown = _surface(outputs, ahead, camera, target)
            pixels = shown.flatten().nonzero()[:, 0]
            image = outputs.image if pictures is None else pictures[number]
            colours = image.flatten(0, 1)[pixels].clamp(0, 1)
            values = torch.cat(
                [torch.cat([points, normals]).flatten(1)[:, pixels].T, colours], 1
            )
            keys, seen = torch.unique(_keys(values, target), return_inverse=True)
            sums = _sums(
                torch.cat([torch.ones(len(pixels), 1), values], 1), seen, len(keys)
            )
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
    return length, along, (offset.square().sum() - along.square()).clamp(min=0).sqrt()


def _clear(
    outputs: SideOutputs, ahead: Tensor, camera: Camera, target: Target
) -> float:
    """Share of the rays near an object that end in one place, or meet nothing."""
    length, _, miss = missed_by(ahead, camera, target)
    spread = (outputs.depth - outputs.median_depth).abs() * length
    one = (spread < LIMITS.one_place * target.radius) & (
        outputs.alpha > LIMITS.solid_ray
    )
    return float(
        (one | (outputs.alpha < LIMITS.empty_ray))[miss < target.radius].float().mean()
    )


def _keys(values: Tensor, target: Target) -> Tensor:
    """(P,) int64 number of the voxel and the face of surface at (P, 6 or more) points
    and normals.
    """
    voxel = (
        (values[:, :3] - target.centre.float()) / _size(target)
    ).floor().long() + 512
    axis = values[:, 3:6].abs().argmax(1)
    face = 2 * axis + (values[:, 3:6].gather(1, axis[:, None])[:, 0] > 0)
    return ((voxel[:, 0] * 1024 + voxel[:, 1]) * 1024 + voxel[:, 2]) * 8 + face


def _size(target: Target) -> float:
    """Side of a voxel."""
    return 2 * target.radius / target.cells


def rays(camera: Camera) -> Tensor:
    """(3, H, W) float32 rays through the pixels in the world, of length 1 along the
    optical axis.
    """
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = torch.stack(
        [
            x.expand(len(y), -1),
            y[:, None].expand(-1, len(x)),
            torch.ones(len(y), len(x)),
        ]
    )
    return (camera.to_world[:3, :3].float() @ local.flatten(1)).reshape(local.shape)


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
    for values, kept in ((depth, shown), (depth.T, shown.T)):
        for step in (1, 2):
            level = (
                values[step:] - values[:-step]
            ).abs() <= LIMITS.depth_edge * target.radius
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
    positions = sums[:, 1:4] / sums[:, :1]
    normals = sums[:, 4:7] / sums[:, :1]
    near = (positions - target.centre.float()).norm(
        dim=1
    ) < LIMITS.around * target.radius
    kept = torch.bincount(of_seen, minlength=len(pieces)) >= LIMITS.least_views
    number = torch.where(kept, kept.cumsum(0) - 1, -1)[of_seen]
    kept_pixels = number >= 0
    colours = view.sums[kept_pixels, 7:] / view.sums[kept_pixels, :1]
    values = torch.cat(
        [torch.ones(len(colours), 1), colours, colours.square().sum(1, keepdim=True)], 1
    )
    moments = torch.zeros(len(view.cameras), int(kept.sum()), 5)
    moments[view.seen_by[kept_pixels], number[kept_pixels]] = values
    length = normals.norm(dim=1)
    kept_normals = functional.normalize(normals[kept], dim=1)
    voxels, voxel_of = torch.unique(pieces[near] // 8, return_inverse=True)
    shown = _sums(
        torch.stack([pixels[near, 0], kept[near].float()], 1), voxel_of, len(voxels)
    )
    return Elements(
        moments=moments,
        positions=positions[kept],
        normals=kept_normals,
        judged=((length > LIMITS.agreed) & near)[kept]
        & ~_rims(pieces[kept], kept_normals),
        size=_size(target),
        of_seen=number,
        unseen=int(((shown[:, 0] >= LIMITS.least_pixels) & (shown[:, 1] == 0)).sum()),
    )


def own_surface(
    scene: GaussianScene, pieces: Elements, target: Target, beside: Sequence[Target]
) -> Elements:
    """Pieces of which an object's own are judged: no ground, which dilutes what
    changes, and nothing beside it.
    """
    own = pieces.judged & target.above(scene, pieces.positions, LIMITS.above)
    for other in beside:
        first, second = (
            (pieces.positions - one.centre.float()).norm(dim=1) / one.radius
            for one in (target, other)
        )
        own &= first <= second
    if int(own.sum()) >= LIMITS.least_pieces:
        return dataclasses.replace(pieces, judged=own)
    return pieces


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
