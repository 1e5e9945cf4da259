"""Lines in the world, drawn over a picture: where cameras stand and which directions belong to a region."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageDraw
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.directions import Point

NEAREST = 0.01
"""Depth in world units from which a line is drawn."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Lines:
    """Segments of one colour; nothing hides them.

    Attributes:
        segments: (S, 2, 3) float64, world units.
        colour: As CSS writes it.
    """

    segments: Tensor
    colour: str


def frustums(cameras: Sequence[Camera], length: float) -> Tensor:
    """(8 C, 2, 3) edges of the pyramids that cameras see, cut off at a depth of `length` world units."""
    parts = []
    for camera in cameras:
        eye = camera.position
        x = torch.tensor([0.0, camera.width, camera.width, 0.0], dtype=torch.float64)
        y = torch.tensor([0.0, 0.0, camera.height, camera.height], dtype=torch.float64)
        rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones(4)], dim=1)
        corners = eye + length * rays.double() @ camera.to_world[:3, :3].T
        parts.append(torch.stack([eye.expand(4, 3), corners], dim=1))
        parts.append(torch.stack([corners, corners.roll(-1, 0)], dim=1))
    return torch.cat(parts) if parts else torch.zeros(0, 2, 3, dtype=torch.float64)


def arc(centre: Point, radius: float, start: tuple[float, float], end: tuple[float, float]) -> Tensor:
    """(S, 2, 3) segments of at most 3 degrees on a sphere, along a parallel or a meridian."""
    count = max(1, math.ceil(max(abs(b - a) for a, b in zip(start, end, strict=True)) / 3))
    azimuth, elevation = (
        torch.linspace(math.radians(a), math.radians(b), count + 1, dtype=torch.float64)
        for a, b in zip(start, end, strict=True)
    )
    flat = elevation.cos()
    points = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin()], dim=1)
    points = torch.tensor(list(centre), dtype=torch.float64) + radius * points
    return torch.stack([points[:-1], points[1:]], dim=1)


def projected(segments: Tensor, camera: Camera) -> NDArray[np.float64]:
    """(S', 2, 2) pixels of the segments that lie before the camera, cut off where they come too near."""
    pose = camera.to_camera
    local = segments.double() @ pose[:3, :3].T + pose[:3, 3]
    depth = local[..., 2]
    local = local[(depth > NEAREST).any(dim=1)]
    start, end = local[:, 0], local[:, 1]
    across = (NEAREST - start[:, 2]) / torch.where(end[:, 2] == start[:, 2], 1.0, end[:, 2] - start[:, 2])
    cut = start + across[:, None] * (end - start)
    start, end = (torch.where((point[:, 2] < NEAREST)[:, None], cut, point) for point in (start, end))
    both = torch.stack([start, end], dim=1)
    focal = both.new_tensor([camera.fx, camera.fy])
    pixels = both[..., :2] / both[..., 2:] * focal + both.new_tensor([camera.cx, camera.cy])
    return pixels.numpy()


def draw_lines(draw: ImageDraw.ImageDraw, lines: Lines, camera: Camera) -> None:
    """Draw lines into a picture that `camera` took, of the camera's size."""
    limit = 4 * max(camera.width, camera.height)
    width = max(1, round(min(camera.width, camera.height) / 400))
    for (x0, y0), (x1, y1) in projected(lines.segments, camera).tolist():
        if max(abs(x0), abs(y0), abs(x1), abs(y1)) <= limit:  # what is longer passes the camera's very eye
            draw.line((x0, y0, x1, y1), fill=lines.colour, width=width)
