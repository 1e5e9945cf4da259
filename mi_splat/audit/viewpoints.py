"""Cameras around an object or within its room, and what they can see of it."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import Frame, Target
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.directions import Point
from mi_splat.cameras.lens import Lens, focal_of
from mi_splat.scene import GaussianScene

SKY = (0.55, 0.7, 0.9)
"""Background of images of an object."""
_IMAGE_SIZE = 128  # Pixels along each side of an image.
_FOV = 45.0  # Degrees.
# degrees above the ground of the lowest and of the highest camera,
_ABOVE_GROUND = (3.0, 87.0)
_ALL_AROUND = (-75.0, 75.0)  # and where an object stands on none
_DISTANCE = 2.6  # Radii from the centre to the cameras.
_NEAR = 0.02  # The near plane, as a share of that distance.
# Standard deviations beyond which a Gaussian shows in no image,
_EXTENT = 4.0
_FAINTEST = 1 / 255  # and opacity up to which it does not.
_REACH = 2.4  # and distance from the centre, in radii.
# Radii from the middle of an object to the nearest camera in a room.
_ROOM_DISTANCE = 1.3
# Half the field of view, by the angle at which the object is seen.
_ROOM_MARGIN = 1.2
_LEAST_ROOM_CAMERAS = 12
_MOST_ROOM_CAMERAS = 120
# Degrees from a given camera, seen from an object, within which cameras look at it,
_GIVEN_NEAR = 6.0
_GIVEN_LATTICE = 1200  # of so many directions all around.


def cameras_within(target: Target, positions: Tensor) -> tuple[Camera, ...]:
    """Cameras at free positions in a room that show an object; none if hardly any
    position is outside of the object.
    """
    away = positions[
        (positions - target.centre).norm(dim=1) > _ROOM_DISTANCE * target.radius
    ]
    if len(away) < _LEAST_ROOM_CAMERAS:
        return ()
    numbers = (
        torch.linspace(0, len(away) - 1, min(_MOST_ROOM_CAMERAS, len(away)))
        .round()
        .long()
    )
    cameras = []
    for position in away[numbers]:
        ahead = functional.normalize(target.centre - position, dim=0)
        half = _ROOM_MARGIN * math.asin(
            target.radius / float((position - target.centre).norm())
        )
        top = torch.eye(3, dtype=torch.float64)[int(ahead.abs().argmin())]
        cameras.append(_camera(position, target, 2 * half, tuple(top.tolist())))
    return tuple(cameras)


def _camera(position: Tensor, target: Target, fov: float, up: Point) -> Camera:
    """A camera that looks at the centre of an object, with a field of view in
    radians.
    """
    size = _IMAGE_SIZE
    pose = look_at(position.tolist(), target.centre.tolist(), up=up)
    return Camera(
        to_world=pose, lens=Lens(focal=focal_of(fov, size), size=(size, size))
    )


def camera_towards(target: Target, direction: Tensor) -> Camera:
    """A camera that looks at an object from a (3,) unit vector of the frame."""
    distance = _DISTANCE * target.radius
    fov = math.radians(_FOV)
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


def views_around(target: Target, count: int) -> list[Camera]:
    """Cameras on a sphere around an object, above its ground if it stands on one."""
    low, high = _ALL_AROUND if target.up is None else _ABOVE_GROUND
    directions = lattice(count, low, high) @ basis(target.up).T
    return [camera_towards(target, direction) for direction in directions]


def cameras_near(target: Target, near: Tensor, most: int) -> list[Camera]:
    """At most so many cameras on a sphere around an object that stand near one of
    (M, 3) directions, below its ground, too.
    """
    directions = lattice(_GIVEN_LATTICE, -90.0, 90.0) @ basis(target.up).T
    apart = (directions @ functional.normalize(near, dim=1).T).amax(1)
    directions = directions[apart > math.cos(math.radians(_GIVEN_NEAR))]
    count = min(len(directions), most)
    numbers = torch.linspace(0, len(directions) - 1, count).round().long()
    return [camera_towards(target, direction) for direction in directions[numbers]]


def in_world(frame: Frame, camera: Camera) -> Camera:
    """A camera of the frame in the world of the file."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = frame.to_world.rotation.double() @ camera.to_world[:3, :3]
    pose[:3, 3] = frame.point(camera.position)
    return dataclasses.replace(camera, to_world=pose)


def near_of(target: Target, cameras: Sequence[Camera]) -> float:
    """The near plane of images of an object from cameras."""
    distances = torch.stack(
        [camera.position - target.centre for camera in cameras]
    ).norm(dim=1)
    return _NEAR * float(distances.median())


def in_sight(scene: GaussianScene, target: Target, cameras: Sequence[Camera]) -> Tensor:
    """(M,) rows of the Gaussians that can show before or on surface that is judged;
    what is behind it is left out.
    """
    eyes = torch.stack([camera.position for camera in cameras]) - target.centre
    reach = max(_REACH * target.radius, float(eyes.norm(dim=1).max()))
    far = (scene.means - target.centre.float()).norm(
        dim=1
    ) - _EXTENT * scene.scales.amax(1)
    rows: Tensor = ((far < reach) & (scene.opacities > _FAINTEST)).nonzero()[:, 0]
    return rows
