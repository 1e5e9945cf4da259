"""`audit`: looks at every object of a splat from all around, and says what changes with
the direction of view.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.audit.evidence import (
    cover_heat,
    cover_of,
    edit_of,
    heat_of,
    is_roofed,
    pair_of,
    split_of,
)
from mi_splat.audit.explanations import (
    Explanation,
    angles_between,
    explain,
    piece_scores,
    reachable,
    region_of,
    support_of,
)
from mi_splat.audit.objects import Frame, Target, frame_of, targets, whole
from mi_splat.audit.results import (
    Audit,
    Look,
    ObjectAudit,
    Pair,
    Scores,
    Vector,
    vector,
)
from mi_splat.audit.surfaces import Elements, Sight, elements, own_surface, sight
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import cameras_around, cameras_within, in_sight
from mi_splat.cameras.camera import Camera, as_cameras, project_points
from mi_splat.cameras.directions import Point
from mi_splat.cameras.rooms import free_positions
from mi_splat.errors import InvalidValueError
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene, check_scene

# an object and the cameras that look at it, in the frame
Job = tuple[Target, tuple[Camera, ...]]


def audit(
    scene: GaussianScene,
    *,
    cameras: Sequence[Camera] | None = None,
    up: Point | None = None,
) -> Audit:
    """Say whether a splat shows something from some directions only, from where, and
    which Gaussians carry it.

    Nothing but the splat is used. The verdict is the same when the splat is turned,
    moved, resized or shuffled, but for rounding. With the `cameras` of the training
    images, in the world, only what shows near these counts, and fog, which no training
    left there, does not.
    """
    check_scene("scene", scene)
    for camera in cameras or ():
        camera.lens.require_perspective()
    frame = frame_of(scene)
    given = cameras is not None
    objects = []
    heats = []
    jobs, in_room = (
        looks_at(frame, up)
        if cameras is None
        else (_seen_from(frame, cameras, up), False)
    )
    for target, around in jobs:
        beside = [
            other for other, _ in jobs if other is not target and not other.surrounds
        ]
        judged = judged_object(
            frame, target, around, beside=beside, in_room=in_room, given=given
        )
        if judged is not None:
            objects.append(judged[0])
            heats.append(judged[1])
    pieces = sum(item.pieces for item in objects)
    if pieces < LIMITS.least_pieces:
        expected = (
            f"at least {LIMITS.least_pieces} pieces of surface that cameras on two"
            " sides see"
        )
        if cameras is None:
            do = "pass a splat of something solid"
        else:
            do = "pass cameras that see more of it"
        raise InvalidValueError.of(
            "scene" if cameras is None else "cameras", expected, pieces, do
        )
    heat = torch.stack(heats).amax(0)
    mask = torch.zeros(len(scene), dtype=torch.bool)
    if any(item.verdict != "nothing found" for item in objects):
        mask[frame.order] = heat > split_of(heat[heat > 0])
    unsorted = torch.zeros(len(scene))
    unsorted[frame.order] = heat
    return Audit(
        objects=tuple(objects),
        heat=unsorted,
        mask=mask,
        near=seen_share(frame, jobs),
        up=up,
    )


def looks_at(frame: Frame, up: Point | None) -> tuple[list[Job], bool]:
    """The objects of a scene with cameras around them, and whether it is a room, inside
    which they then stand.
    """
    objects = targets(frame.scene, None if up is None else frame.own(up))
    positions = free_positions(frame.scene)
    if positions is None:
        return [(target, cameras_around(target)) for target in objects], False
    jobs = [
        (target, cameras)
        for target in objects
        if (cameras := cameras_within(target, positions))
    ]
    if not jobs:
        expected = "an object, or a room in which one stands"
        got = "a room with nothing that stands free of its walls"
        raise InvalidValueError.of(
            "scene", expected, got, "pass cameras that stand in it"
        )
    return jobs, True


def _seen_from(frame: Frame, cameras: Sequence[Camera], up: Point | None) -> list[Job]:
    """The objects that cameras see; the whole scene, from themselves, if there is none
    or in a room.
    """
    given = cameras_in_frame(frame, cameras, LIMITS.given_size)
    return seen_objects(frame, given, up) or [(whole(frame.scene), given)]


def seen_objects(frame: Frame, given: Sequence[Camera], up: Point | None) -> list[Job]:
    """The objects that cameras of the frame see, with others at one distance near their
    directions; none in a room.
    """
    jobs = list[Job]()
    if free_positions(frame.scene) is not None:
        return jobs
    for target in targets(frame.scene, None if up is None else frame.own(up)):
        ways = [
            camera.position - target.centre
            for camera in given
            if _shows(camera, target.centre)
        ]
        around = cameras_around(target, torch.stack(ways)) if ways else ()
        if len(around) >= LIMITS.least_cameras:
            jobs.append((target, around))
    return jobs


def _shows(camera: Camera, point: Tensor) -> bool:
    """Whether a point lies in the picture of a camera."""
    pixels, depth = project_points(point[None], camera)
    x, y = pixels[0].tolist()
    return float(depth) > 0 and 0 <= x < camera.width and 0 <= y < camera.height


def cameras_in_frame(
    frame: Frame, cameras: Sequence[Camera], longer_side: int
) -> tuple[Camera, ...]:
    """Cameras of the world in the frame, not too many of them, and small."""
    cameras = as_cameras(cameras)
    if len(cameras) < LIMITS.least_cameras:
        do = "pass those of the training pictures, or none"
        raise InvalidValueError.of(
            "cameras", f"at least {LIMITS.least_cameras}", len(cameras), do
        )
    numbers = (
        torch.linspace(0, len(cameras) - 1, min(len(cameras), LIMITS.most_cameras))
        .round()
        .long()
        .tolist()
    )
    rotation = frame.to_world.rotation.double()
    world = frame.to_world
    moved = []
    for camera in (cameras[number] for number in numbers):
        factor = longer_side / max(camera.width, camera.height)
        size = (
            max(8, round(camera.width * factor)),
            max(8, round(camera.height * factor)),
        )
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation.T @ camera.to_world[:3, :3]
        pose[:3, 3] = (
            rotation.T @ (camera.position - world.translation.double()) / world.scale
        )
        moved.append(dataclasses.replace(resized(camera, size), to_world=pose))
    return tuple(moved)


def judged_object(
    frame: Frame,
    target: Target,
    cameras: tuple[Camera, ...],
    *,
    beside: Sequence[Target] = (),
    in_room: bool = False,
    given: bool = False,
) -> tuple[ObjectAudit, Tensor] | None:
    """Judge one object, and say in (N,) heat which Gaussians of the frame carry what
    was found.

    `given` says that training cameras stood where the cameras are, so that nothing
    there is invented.
    """
    rows = in_sight(frame.scene, target, cameras)
    scene = frame.scene.select(rows)
    view = sight(scene, target, cameras)
    pieces = elements(view, target)
    full = not target.surrounds
    pieces = own_surface(frame.scene, pieces, target, beside) if full else pieces
    if not bool(pieces.judged.any()):
        return None
    threshold = LIMITS.net
    surface_looks = looks_of(pieces, view, LIMITS.suspicion * threshold)
    able = pieces.judged & reachable(pieces, view)
    looks = [
        _look(frame, view, look, threshold, judged=able, given=given)
        for look in surface_looks
    ]
    shown = zip(surface_looks, looks, strict=True)
    by_piece = torch.stack(
        [piece_scores(found.pieces, look.shown) for found, look in shown]
    ).amax(0)
    area = (pieces.size * frame.to_world.scale) ** 2
    occluder, covered = (
        cover_of(frame.scene, view, target) if full and not target.core else (None, {})
    )
    judged = ObjectAudit(
        rows=frame.order[target.rows],
        centre=vector(frame.point(target.centre)),
        radius=target.radius * frame.to_world.scale,
        up=None if target.up is None else vector(frame.direction(target.up)),
        directions=frame.direction(view.directions),
        pieces=int(able.sum()),
        area=int(able.sum()) * area,
        uncontradicted=(pieces.unseen + int((pieces.judged & ~able).sum())) * area,
        cameras=tuple(in_world(frame, camera) for camera in cameras),
        looks=tuple(
            sorted(looks, key=lambda look: -(look.evidence if given else look.net))
        ),
        occluder=occluder
        and dataclasses.replace(occluder, axis=_turned(frame, occluder.axis)),
        edit=edit_of(frame, target) if full else None,
        in_room=in_room or target.surrounds,
        plain=not bool(frame.scene.sh[:, 1:].any()),
        roofed=full and not in_room and is_roofed(frame.scene, target),
    )
    heat = torch.zeros(len(frame.scene))
    if judged.look.evidence >= LIMITS.suspicion:
        heat[rows] = heat_of(scene, pieces, view, by_piece, target, judged.looks)
    if judged.covered:
        heat[rows] = torch.maximum(heat[rows], cover_heat(scene, view, covered, target))
    return judged, heat


def _look(
    frame: Frame,
    view: Sight,
    look: Explanation,
    threshold: float,
    *,
    judged: Tensor,
    given: bool,
) -> Look:
    """A look in the world: without fog the tail of its profile, if the narrower side is
    not the one it is skewed to.
    """
    region = region_of(view.directions, look.amounts, look.shown)
    by_piece = piece_scores(look.pieces, look.shown)
    cameras, change = pair_of(look.pieces, view, by_piece, look.shown) or ((), 0.0)
    pair = [in_world(frame, view.cameras[number]) for number in cameras]
    lost, air = (0.0, 1.0) if given else support_of(look.pieces, view, look.shown)
    stated = Look(
        region=dataclasses.replace(region, axis=_turned(frame, region.axis)),
        shown=look.shown,
        amounts=look.amounts,
        **{
            field.name: getattr(look, field.name)
            for field in dataclasses.fields(Scores)
        },
        threshold=threshold,
        lost=lost,
        air=air,
        changed=min(
            1.0, int((by_piece > LIMITS.changed).sum()) / max(1, int(judged.sum()))
        ),
        given=given,
        pair=(
            Pair(inside=pair[0], outside=pair[1], change=change, numbers=cameras)
            if cameras
            else None
        ),
    )
    if look.tail is None or stated.support < LIMITS.supported:
        return stated
    tail = _look(frame, view, look.tail, threshold, judged=judged, given=given)
    return dataclasses.replace(tail, lost=lost, air=air, changed=stated.changed)


def _turned(frame: Frame, axis: Vector) -> Vector:
    """A direction of the frame as one of the world."""
    return vector(frame.direction(torch.tensor(axis, dtype=torch.float64)))


def in_world(frame: Frame, camera: Camera) -> Camera:
    """A camera of the frame in the world of the file."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = frame.to_world.rotation.double() @ camera.to_world[:3, :3]
    pose[:3, 3] = frame.point(camera.position)
    return dataclasses.replace(camera, to_world=pose)


def seen_share(frame: Frame, jobs: list[Job]) -> float:
    """Share of the solid Gaussians around one of the objects, and in the pictures of
    enough of its cameras.
    """
    points = frame.scene.means[frame.scene.opacities > LIMITS.solid].double()
    points = points[:: math.ceil(len(points) / LIMITS.near_sample)]
    near = torch.zeros(len(points), dtype=torch.bool)
    for target, cameras in jobs:
        seen = torch.zeros(len(points))
        for camera in cameras:
            pixels, depth = project_points(points, camera)
            x, y = pixels.T
            seen += (
                (depth > 0)
                & (x >= 0)
                & (x < camera.width)
                & (y >= 0)
                & (y < camera.height)
            )
        near |= (
            (points - target.centre).norm(dim=1) < LIMITS.around * target.radius
        ) & (seen >= LIMITS.least_views)
    return float(near.double().mean())


def looks_of(pieces: Elements, view: Sight, threshold: float) -> list[Explanation]:
    """The looks of an object: the one that explains most, then those that are left
    without its cameras.
    """
    looks: list[Explanation] = []
    kept = torch.ones(len(view.cameras), dtype=torch.bool)
    while len(looks) < LIMITS.most_looks and int(
        kept.sum()
    ) >= LIMITS.cameras_left * len(kept):
        look = explain(part, view, kept) if (part := _seen_by(pieces, kept)) else None
        if look is None or (
            looks and look.net < max(threshold, LIMITS.another_look * looks[0].net)
        ):
            break
        looks.append(look)
        if look.net < threshold or not bool(look.shown.any()):
            break
        kept = kept & (
            angles_between(view.directions, view.directions[look.shown]).amin(1)
            > LIMITS.look_edge
        )
    return looks


def _seen_by(pieces: Elements, kept: Tensor) -> Elements | None:
    """What (K,) kept cameras see of surface; None if that is too little."""
    if bool(kept.all()):
        return pieces
    moments = pieces.moments * kept.float()[:, None, None]
    judged = pieces.judged & (moments[..., 0].sum(0) >= LIMITS.least_views)
    if bool(judged.any()):
        return dataclasses.replace(pieces, moments=moments, judged=judged)
    return None
