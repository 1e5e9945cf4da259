"""Cameras around an object or within its room, and what they can see of it."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import Target
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.directions import Point
from mi_splat.cameras.lens import Lens, focal_of
from mi_splat.scene import GaussianScene


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


def camera_towards(target: Target, direction: Tensor) -> Camera:
    """A camera that looks at an object from a (3,) unit vector of the frame."""
    distance = LIMITS.distance * target.radius
    fov = math.radians(LIMITS.fov)
    top = (0.0, 0.0, 1.0) if target.up is None else tuple(target.up.tolist())
    return _camera(target.centre + distance * direction, target, fov, top)


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
    return tuple(camera_towards(target, direction) for direction in directions)


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
