"""`audit`: looks at every object of a splat from all around, and says from where it
contradicts what all other directions predict.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.audit.held_out import Consensus, HeldOutConfig, Recogniser
from mi_splat.audit.objects import SOLID, Frame, Target, frame_of, targets
from mi_splat.audit.results import Audit, ObjectAudit, vector
from mi_splat.audit.viewpoints import cameras_near, cameras_within, views_around
from mi_splat.cameras.camera import Camera, as_cameras, project_points
from mi_splat.cameras.directions import Point
from mi_splat.cameras.rooms import free_positions
from mi_splat.errors import InvalidValueError
from mi_splat.maths.quantiles import split_of
from mi_splat.scene import GaussianScene, check_scene

# an object and the cameras that look at it, in the frame
Job = tuple[Target, Sequence[Camera]]
LEAST_CAMERAS = 12  # that have to be given,
MOST_CAMERAS = 300  # and that are used of those given
MOST_AROUND = 240  # directions near given ones from which an object is looked at
_AROUND = 1.6  # radii around an object within which a Gaussian is near it
_LEAST_VIEWS = 8  # cameras that have to see such a Gaussian
_NEAR_SAMPLE = 5000  # Gaussians, evenly taken, of which is asked whether they are near


def audit(
    scene: GaussianScene,
    recogniser: Recogniser,
    *,
    cameras: Sequence[Camera] | None = None,
    up: Point | None = None,
    config: HeldOutConfig | None = None,
) -> Audit:
    """Compare what a splat shows from each cone of directions with what the other
    directions predict.

    There are eleven cones above the ground of an object, or 22 all around it.
    Nothing but the splat is used. The answer is the same when the splat is turned,
    moved, resized or shuffled, but for rounding.

    Args:
        scene: The splat, in any frame and unit.
        recogniser: What says whether two images show the same
            (`attacks.audits.recognition.Recognition`).
        cameras: Training cameras in the world: only directions near theirs are
            compared, as elsewhere an honest splat shows fog. In a room nothing is
            compared then.
        up: Direction of the world that is up; without, that of the ground found.
        config: How directions are held out.

    Returns:
        The answer, the cones of each object with their images, and which Gaussians
        carry what contradicts.

    Raises:
        InvalidValueError: If the scene has no object, or there are too few cameras.
    """
    check_scene("scene", scene)
    for camera in cameras or ():
        camera.lens.require_perspective()
    config = HeldOutConfig() if config is None else config
    frame = frame_of(scene)
    if cameras is None:
        jobs = looks_at(frame, up, config)
    else:
        given = cameras_in_frame(frame, cameras)
        jobs = seen_objects(frame, given, up)
    objects = list[ObjectAudit]()
    heat = torch.zeros(len(scene))
    for target, stands in jobs:
        item = _judged(frame, target, stands, len(objects), recogniser, config)
        objects.append(item)
        worst = item.clearest
        if worst is not None:
            predicted = item.consensus.predicted(worst.inside)
            found = item.consensus.departures(
                predicted, worst.inside, peeled=worst.peeled
            )
            heat[item.consensus.rows] = heat[item.consensus.rows].maximum(found)
    return Audit(
        objects=tuple(objects),
        heat=heat,
        mask=heat > split_of(heat[heat > 0]),
        near=_seen_share(frame, jobs),
        missing=recogniser.missing,
        config=config,
        up=up,
    )


def _judged(
    frame: Frame,
    target: Target,
    stands: Sequence[Camera],
    number: int,
    recogniser: Recogniser,
    config: HeldOutConfig,
) -> ObjectAudit:
    spread = torch.linspace(0, len(stands) - 1, min(config.cameras, len(stands)))
    chosen = [stands[index] for index in spread.round().long().tolist()]
    consensus = Consensus(frame, target, chosen, config)
    views, known_as = consensus.compared(number, recogniser)
    return ObjectAudit(
        rows=frame.order[target.rows],
        centre=vector(frame.point(target.centre)),
        radius=target.radius * frame.to_world.scale,
        up=consensus.up,
        known_as=known_as,
        directions=frame.direction(consensus.directions),
        views=tuple(views),
        consensus=consensus,
    )


def looks_at(frame: Frame, up: Point | None, config: HeldOutConfig) -> list[Job]:
    """The objects of a scene with cameras around them, or within their room."""
    objects = [
        target
        for target in targets(frame.scene, None if up is None else frame.own(up))
        if not target.surrounds
    ]
    positions = free_positions(frame.scene)
    if positions is None:
        return [(target, views_around(target, config.cameras)) for target in objects]
    jobs = list[Job]()
    for target in objects:
        within = cameras_within(target, positions)
        if within:
            jobs.append((target, within))
    if not jobs:
        expected = "an object, or a room in which one stands"
        got = "a room with nothing that stands free of its walls"
        raise InvalidValueError.of(
            "scene", expected, got, "pass cameras that stand in it"
        )
    return jobs


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
        if target.surrounds or not ways:
            continue
        around = cameras_near(target, torch.stack(ways), MOST_AROUND)
        if len(around) >= LEAST_CAMERAS:
            jobs.append((target, around))
    return jobs


def _shows(camera: Camera, point: Tensor) -> bool:
    """Whether a point lies in the image of a camera."""
    return bool(_in_images(point[None], [camera])[0])


def _in_images(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """(P,) in how many of the images each of (P, 3) points lies."""
    seen = torch.zeros(len(points))
    for camera in cameras:
        pixels, depth = project_points(points, camera)
        x, y = pixels.T
        in_width = (x >= 0) & (x < camera.width)
        in_height = (y >= 0) & (y < camera.height)
        seen += (depth > 0) & in_width & in_height
    return seen


def cameras_in_frame(frame: Frame, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Cameras of the world in the frame, not too many of them."""
    cameras = as_cameras(cameras)
    if len(cameras) < LEAST_CAMERAS:
        do = "pass those of the training images, or none"
        raise InvalidValueError.of(
            "cameras", f"at least {LEAST_CAMERAS}", len(cameras), do
        )
    count = min(len(cameras), MOST_CAMERAS)
    numbers = torch.linspace(0, len(cameras) - 1, count).round().long().tolist()
    rotation = frame.to_world.rotation.double()
    shift = frame.to_world.translation.double()
    moved = []
    for camera in (cameras[number] for number in numbers):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation.T @ camera.to_world[:3, :3]
        offset = camera.position - shift
        pose[:3, 3] = rotation.T @ offset / frame.to_world.scale
        moved.append(dataclasses.replace(camera, to_world=pose))
    return tuple(moved)


def _seen_share(frame: Frame, jobs: Sequence[Job]) -> float:
    """Share of the solid Gaussians around one of the objects, and in the images of
    enough of its cameras.
    """
    points = frame.scene.means[frame.scene.opacities > SOLID].double()
    points = points[:: math.ceil(len(points) / _NEAR_SAMPLE)]
    near = torch.zeros(len(points), dtype=torch.bool)
    for target, cameras in jobs:
        gaps = (points - target.centre).norm(dim=1)
        is_seen = _in_images(points, cameras) >= _LEAST_VIEWS
        near |= (gaps < _AROUND * target.radius) & is_seen
    return float(near.double().mean())
