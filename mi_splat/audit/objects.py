"""The objects of a splat, in a frame of its own.

The frame turns, moves and grows with the splat, so that a verdict depends neither on
how the file's axes lie, nor on its unit, nor on the order of its rows.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.directions import Point
from mi_splat.errors import InvalidValueError
from mi_splat.maths.neighbours import nearest_neighbours, nearest_of
from mi_splat.maths.quantiles import quantile
from mi_splat.maths.rotation import from_z
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.selection.clusters import NEAREST, TOLERANCE, clusters, find_plane

SOLID = 0.1  # Opacity of a Gaussian that says where things are.
MOST_OBJECTS = 3
# Gaussians that are linked to each other; the others go with the nearest of these.
_MOST_LINKED = 60_000
# Share of the solid Gaussians that the frame is made of: those nearest to their
# middle.
_CROWD = 0.8
_COMPONENTS = 6  # Connected components, from the largest, that may be objects,
_LEAST_SHARE = 0.03  # with this share of the solid Gaussians,
_LEAST_COUNT = 100  # and so many of them.
_FLAT = 0.04  # Thinnest extent of a plane, by its longest.
# Cosine between the normals of a sign and of its ground, from which it is no
# object.
_UPRIGHT = 0.7
# Radius of the ball around an object, by that of what holds nearly all of it.
_OBJECT_MARGIN = 1.15
# A component inside an object is a part of it from this radius,
_PART_RADIUS = 0.4
_PART_SHARE = 0.3  # and up to this share of its Gaussians.
# Times the radius of an object inside it from which an object is its surroundings.
_SURROUNDS = 2.5
# Share of the solid Gaussians, the smallest, that say where the core of a splat is,
_SMALL = 0.2
_DENSE = 0.6  # and share of these that it holds;
# it is judged, too, where objects without a ground are so many times larger.
_LOOSE = 1.8
_GROUND_SAMPLE = 5000  # Points among which a ground is looked for,
_GROUND_REACH = 4.0  # so far around, in radii,
_GROUND_SHARE = 0.15  # with this share of them on it.
_PLANES = 2  # Planes that are tried as ground.
# Of everything that lies on no floor, how much more lies above it than below, by
# heights,
_FLOOR_OVER = 4.0
_FLOOR_NEAR = 0.5  # and how near to it the nearest lies, by the farthest.
_FLOOR_PLANES = 3  # Planes that are tried as the floor.
# Share of what is above it that objects hold; else all of it is one in pieces.
_FLOOR_HELD = 0.5
_TOUCH = 0.4  # Radii that an object may be above its ground,
_ONE_SIDE = 0.95  # share of it that is above the ground,
_UNDER = 0.15  # but for so many radii,
_BEYOND = 1.3  # and radii that a ground reaches from its middle.
# Radius of the core of a splat, by that within which most of its small Gaussians lie.
_WHOLE_MARGIN = 1.2


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
    # whether it is what is around another, such as a sky: cameras stand within, if at
    # all
    surrounds: bool = False

    def above(self, scene: GaussianScene, points: Tensor, gap: float) -> Tensor:
        """(...) bool, which (..., 3) points lie so many radii above its foot; all of
        them where it stands on none.
        """
        if self.up is None:
            return torch.ones(points.shape[:-1], dtype=torch.bool)
        up = self.up.float()
        heights = scene.means[self.rows] @ up
        foot = heights.kthvalue(max(1, len(heights) // 50)).values
        return points @ up > foot + gap * self.radius


def frame_of(scene: GaussianScene) -> Frame:
    """The splat in the frame of its own principal axes."""
    scene = scene.detach().to("cpu", torch.float32)
    red, green, blue = scene.sh[:, 0].numpy().T
    opacities = scene.opacities.numpy()
    # by opacity, and among equal ones by colour: not by the order of the file
    order = torch.from_numpy(np.lexsort((blue, green, red, opacities)))
    scene = scene.select(order)
    points = scene.means[scene.opacities > SOLID].double()
    if not len(points):
        got = f"none of {len(scene):,}"
        do = "pass a splat that shows something"
        raise InvalidValueError.of(
            "scene", f"Gaussians with an opacity above {SOLID:g}", got, do
        )
    centre = points.mean(0)
    for _ in range(3):
        gaps = (points - centre).norm(dim=1)
        near = points[gaps <= quantile(gaps, _CROWD)]
        centre = near.mean(0)
    radius = float((near - centre).norm(dim=1).max())
    if not radius > 0:
        do = "pass a splat of a scene, not of a point"
        raise InvalidValueError.of(
            "scene", "Gaussians at several places", "all at one", do
        )
    offsets = near - centre
    axes = torch.linalg.eigh(offsets.T @ offsets).eigenvectors.T.flip(0)
    # an axis points to where the longer tail of the points is
    skew = (offsets @ axes.T).pow(3).sum(0)
    axes = axes * torch.where(skew < 0, -1.0, 1.0)[:, None].double()
    if torch.linalg.det(axes) < 0:
        axes[2] *= -1
    to_frame = Similarity(
        rotation=axes, translation=-(axes @ centre) / radius, scale=1 / radius
    )
    back = Similarity(rotation=axes.T.contiguous(), translation=centre, scale=radius)
    return Frame(scene=scene.transform(to_frame), order=order, to_world=back)


def targets(scene: GaussianScene, stated_up: Tensor | None = None) -> list[Target]:
    """The objects of a splat: at most `MOST_OBJECTS` components that are no
    ground; else where most of it is.

    Of what is around others, only the largest component is judged, too.
    """
    rows = (scene.opacities > SOLID).nonzero()[:, 0]
    floor = _floor(scene.means[rows].double())
    if floor is not None:
        level = floor.up if stated_up is None else stated_up
        found = [
            dataclasses.replace(target, up=level)
            for target in _standing(scene, rows, floor.over)
        ]
        if found:
            return found
    points = scene.means[rows].double()
    label = _components(scene.select(rows))
    chosen: list[Target] = []
    for number in range(min(_COMPONENTS, int(label.max()) + 1)):
        part = points[label == number]
        if len(part) < max(_LEAST_SHARE * len(points), _LEAST_COUNT):
            continue
        centre = part.median(0).values
        radius = _OBJECT_MARGIN * quantile((part - centre).norm(dim=1), 0.95)
        if any(_is_part(part, centre, radius, larger) for larger in chosen):
            continue
        thin = _normal_of_flat(part)
        ground = _ground_of(chosen)
        if thin is not None and ground is not None and _is_level(thin, ground):
            continue
        up = _up(part, centre, radius, points[label != number])
        # a plane that stands on nothing, or lies on the ground, is no object
        if thin is not None and (up is None or _is_level(thin, up)):
            continue
        chosen.append(
            Target(rows=rows[label == number], centre=centre, radius=radius, up=up)
        )
    chosen = chosen[:MOST_OBJECTS]
    core = _core(rows, points, scene.scales[rows].prod(1))
    is_loose = all(
        target.up is None and core.radius * _LOOSE < target.radius for target in chosen
    )
    if is_loose:
        chosen.append(core)
    chosen = _parted(chosen)
    ground = _ground_of(chosen)
    if ground is None:
        return chosen
    upright = []
    for one in chosen:
        if stated_up is not None:
            upright.append(dataclasses.replace(one, up=stated_up))
        elif one.up is not None and float(one.up @ ground) > _UPRIGHT:
            upright.append(one)
        else:
            upright.append(dataclasses.replace(one, up=ground))
    return upright


class _Floor(NamedTuple):
    """A plane on which everything else stands."""

    up: Tensor  # (3,) float64 unit vector
    over: Tensor  # (N,) bool, which points lie above it


def _floor(points: Tensor) -> _Floor | None:
    """The floor of (N, 3) points; None where the rest lies on both sides of the
    largest planes, or is far from them, as from a roof.
    """
    distances, _ = nearest_neighbours(points, NEAREST)
    if not distances.shape[1]:
        return None
    spacing = distances[:, -1]
    rest = torch.arange(len(points))
    for _ in range(_FLOOR_PLANES):
        least = math.ceil(_GROUND_SHARE * len(points))
        inside = find_plane(points[rest], spacing[rest], least=least)
        if inside is None or bool(inside.all()):
            return None
        on = points[rest[inside]]
        middle = on.mean(0)
        normal: Tensor = torch.linalg.svd(on - middle, full_matrices=False).Vh[2]
        off = torch.ones(len(points), dtype=torch.bool)
        off[rest[inside]] = False
        heights = (points - middle) @ normal
        if float(heights[off].sum()) < 0:
            heights = -heights
            normal = -normal
        over = heights[off].clamp(min=0)
        under = (-heights[off]).clamp(min=0)
        is_below_all = float(over.sum()) > _FLOOR_OVER * float(under.sum())
        over = over[over > 0]
        if is_below_all and len(over):
            nearest = quantile(over, 1 - _ONE_SIDE)
            if nearest < _FLOOR_NEAR * quantile(over, _ONE_SIDE):
                return _Floor(normal, off & (heights > TOLERANCE * spacing))
        rest = rest[~inside]
    return None


def _standing(scene: GaussianScene, rows: Tensor, over: Tensor) -> list[Target]:
    """The objects among those solid Gaussians that lie above a floor, from the
    largest.
    """
    label = _components(scene.select(rows), over.long())
    rows = rows[over]
    label = label[over]
    points = scene.means[rows].double()
    chosen: list[Target] = []
    for number in label.bincount().argsort(descending=True, stable=True)[:_COMPONENTS]:
        part = points[label == number]
        if len(part) < max(_LEAST_SHARE * len(over), _LEAST_COUNT):
            continue
        centre = part.median(0).values
        radius = _OBJECT_MARGIN * quantile((part - centre).norm(dim=1), 0.95)
        if not any(_is_part(part, centre, radius, larger) for larger in chosen):
            own = rows[label == number]
            chosen.append(Target(rows=own, centre=centre, radius=radius, up=None))
    if sum(len(target.rows) for target in chosen) < _FLOOR_HELD * len(points):
        return [_whole(rows, points)]
    return _parted(chosen[:MOST_OBJECTS])


def _whole(rows: Tensor, points: Tensor) -> Target:
    """All that lies above a floor, without what is far from most of it."""
    centre = points.median(0).values
    gaps = (points - centre).norm(dim=1)
    radius = _OBJECT_MARGIN * quantile(gaps, 0.9)
    return Target(rows=rows[gaps <= radius], centre=centre, radius=radius, up=None)


def _ground_of(objects: list[Target]) -> Tensor | None:
    """The direction away from the ground of the first object that stands on one."""
    for target in objects:
        if target.up is not None:
            return target.up
    return None


def _is_level(normal: Tensor, up: Tensor) -> bool:
    """Whether a plane lies as the ground does."""
    return abs(float(normal @ up)) > _UPRIGHT


def _components(scene: GaussianScene, group: Tensor | None = None) -> Tensor:
    """(N,) int64 the connected component of each Gaussian, from the largest."""
    every = math.ceil(len(scene) / _MOST_LINKED)
    if every <= 1:
        return clusters(scene, group=group)
    part = slice(None, None, every)
    label = clusters(scene.select(part), group=None if group is None else group[part])
    nearest = nearest_of(scene.means, every)
    return label[nearest // every]


def _is_part(part: Tensor, centre: Tensor, radius: float, larger: Target) -> bool:
    """Whether a few points lie in an object that is not much larger, and so are seen
    well enough with it.
    """
    is_large = radius > _PART_RADIUS * larger.radius
    is_few = len(part) < _PART_SHARE * len(larger.rows)
    return _holds(larger, centre) and is_large and is_few


def _parted(objects: list[Target]) -> list[Target]:
    """Objects, and the first of what is around another."""
    inner = []
    outer = []
    for one in objects:
        if any(_surrounds(one, other) for other in objects):
            outer.append(dataclasses.replace(one, surrounds=True))
        else:
            inner.append(one)
    return inner + outer[:1]


def _surrounds(target: Target, other: Target) -> bool:
    return target.radius > _SURROUNDS * other.radius and _holds(target, other.centre)


def _holds(target: Target, point: Tensor) -> bool:
    return float((point - target.centre).norm()) < target.radius


def _normal_of_flat(points: Tensor) -> Tensor | None:
    """The normal of a component that is a plane; None if it is none."""
    sample = points[:: max(1, len(points) // _GROUND_SAMPLE)]
    _, extents, axes = torch.linalg.svd(sample - points.mean(0), full_matrices=False)
    if extents[2] >= _FLAT * extents[0]:
        return None
    normal: Tensor = axes[2]
    return normal


def _core(rows: Tensor, points: Tensor, sizes: Tensor) -> Target:
    """Where the smallest Gaussians are: what a training saw best, though ground and fog
    hang together with it.
    """
    small = points[sizes <= quantile(sizes, _SMALL)]
    centre = small.median(0).values
    gaps = (points - centre).norm(dim=1)
    spread = quantile((small - centre).norm(dim=1), _DENSE)
    radius = _WHOLE_MARGIN * spread
    if not radius:  # all of them at one place
        radius = float(gaps.max())
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
    near = around[(around - centre).norm(dim=1) < _GROUND_REACH * radius]
    near = near[:: max(1, len(near) // _GROUND_SAMPLE)]
    for _ in range(_PLANES):
        distances, _ = nearest_neighbours(near, 8)
        if not distances.shape[1]:
            return None
        least = math.ceil(_GROUND_SHARE * len(near)) + 3
        inside = find_plane(near, distances[:, -1], least=least)
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
        offsets = ground - centre
        across = offsets - (offsets @ normal)[:, None] * normal
        over = float((heights > -_UNDER * radius).double().mean())
        is_above = over >= _ONE_SIDE
        touches = quantile(heights, 1 - _ONE_SIDE) < _TOUCH * radius
        # the ground goes on where the object ends
        goes_on = quantile(across.norm(dim=1), 0.9) > _BEYOND * radius
        if is_above and touches and goes_on:
            return normal
    return None
