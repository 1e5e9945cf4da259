"""What a splat costs a renderer from its worst camera: how many Gaussians lie over each other, counted tile by tile."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from mi_splat.audit.lint.rules import Finding
from mi_splat.audit.surfaces import lattice
from mi_splat.bounds import near_plane_of
from mi_splat.cameras import Camera, look_at
from mi_splat.overdraw import Layers, overdraw
from mi_splat.scene import GaussianScene

SIZE = 1024
"""Pixels along each side of the picture that is counted."""
HEAVY, STOPS = 512.0, 4096.0
"""Mean layers from which a splat is heavy, and from which the rasteriser of mi-splat refuses such a picture."""

_STOPPED, _SLOW = "a renderer stops, or takes seconds", "it is slow"
_DIRECTIONS = 8
_FOV = math.radians(45)
_POINTS = 20_000
_CORE = 0.3
_STOPS_OF_HEAT = (
    (0.0, (0, 0, 0)),
    (0.35, (90, 20, 110)),
    (0.6, (220, 60, 40)),
    (0.8, (250, 180, 40)),
    (1.0, (255, 240, 170)),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overdraw:
    """The worst of the cameras that were tried."""

    camera: Camera  # where from
    layers: Layers  # (rows, columns) Gaussians over each other in each tile of 4 x 4 pixels
    tried: int  # how many cameras were counted

    @property
    def mean(self) -> float:
        """Mean number of layers over the whole picture: the work of a frame."""
        return float(self.layers.mean())

    @property
    def highest(self) -> int:
        """Number of layers in the worst tile."""
        return int(self.layers.max())

    def finding(self) -> Finding | None:
        """What is wrong with it, if anything is."""
        if self.mean < HEAVY:
            return None
        stops = self.mean >= STOPS
        reason = (
            f"From one camera {self.mean:,.0f} Gaussians lie over each other in the mean of a picture of {SIZE} x "
            f"{SIZE} pixels, up to {self.highest:,} at one place: {_STOPPED if stops else _SLOW}."
        )
        return Finding(rule="overdraw", severity="error" if stops else "warning", reason=reason)


def worst_overdraw(scene: GaussianScene) -> Overdraw | None:
    """Count Gaussians over each pixel from all around the splat and its core, as near as shows all of it.

    It ends at the first camera from which the splat stops a renderer.
    """
    if not len(scene):
        return None
    cameras = list(_cameras(scene))
    near = near_plane_of(*_ball(scene.means.double()), cameras)
    worst, tried = None, 0
    for camera, layers in zip(cameras, overdraw(scene, cameras, near=near), strict=True):
        tried += 1
        if worst is None or layers.mean() > worst[1].mean():
            worst = camera, layers
        if layers.mean() >= STOPS:
            break
    assert worst is not None
    return Overdraw(camera=worst[0], layers=worst[1], tried=tried)


def _ball(points: Tensor) -> tuple[list[float], float]:
    middle = (points.amin(0) + points.amax(0)) / 2
    return middle.tolist(), float((points - middle).norm(dim=1).max())


def _cameras(scene: GaussianScene) -> Iterator[Camera]:
    """Around the middle 98 % of the means along each axis; around the half nearest to the median, too, if small."""
    means = scene.means.double()[:: max(1, len(scene) // _POINTS)]
    size = float(scene.scales.amax(1).median())
    ordered = means.sort(0).values
    low, high = ordered[round(0.01 * (len(means) - 1))], ordered[round(0.99 * (len(means) - 1))]
    whole = means[((means >= low) & (means <= high)).all(1)]
    far = (means - means.median(0).values).norm(dim=1)
    core = means[far <= far.median()]
    sets = [whole] if len(whole) else []
    if not sets or _ball(core)[1] < _CORE * _ball(whole)[1]:
        sets.append(core)
    for points in sets:
        yield from _around(points, size)


def _around(points: Tensor, size: float) -> Iterator[Camera]:
    """Cameras that look along the main axes of (M, 3) points and along some others, each as near as shows them all.

    `size` is that of a usual Gaussian, world units.
    """
    middle = torch.tensor(_ball(points)[0], dtype=torch.float64)
    axes = torch.linalg.eigh((points - middle).T @ (points - middle)).eigenvectors.T
    for direction in torch.cat([axes, -axes, lattice(_DIRECTIONS, -80, 80)]):
        along = (points - middle) @ direction
        across = (points - middle - along[:, None] * direction).norm(dim=1)
        distance = float(along.max()) + (float(across.max()) + size) / math.tan(_FOV / 2)
        pose = look_at((middle + distance * direction).tolist(), middle.tolist())
        yield Camera(to_world=pose, focal=SIZE / 2 / math.tan(_FOV / 2), width=SIZE, height=SIZE)


def overdraw_picture(worst: Overdraw) -> NDArray[np.uint8]:
    """(H, W, 3) heat of the layers, on a logarithmic scale up to `STOPS`, with the scale beneath."""
    heat = _heat(np.log1p(worst.layers) / math.log1p(STOPS))
    picture = np.repeat(np.repeat(heat, 3, axis=0), 3, axis=1)
    height, width = picture.shape[:2]
    sheet = Image.new("RGB", (width, height + 70), (255, 255, 255))
    sheet.paste(Image.fromarray(picture), (0, 0))
    bar = _heat(np.tile(np.linspace(0, 1, width - 80), (14, 1)))
    sheet.paste(Image.fromarray(bar), (40, height + 10))
    draw = ImageDraw.Draw(sheet)
    for layers in (1, 8, 64, int(HEAVY), int(STOPS)):
        x = 40 + (width - 80) * math.log1p(layers) / math.log1p(STOPS)
        draw.line([(x, height + 22), (x, height + 28)], fill=(0, 0, 0))
        draw.text((x, height + 40), f"{layers:,}", fill=(0, 0, 0), anchor="mm")
    draw.text((width / 2, height + 58), "Gaussians over each other", fill=(0, 0, 0), anchor="mm")
    return np.asarray(sheet)


def _heat(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(..., 3) black, violet, red, yellow, pale yellow for shares from 0 to 1 and above."""
    stops = [stop for stop, _ in _STOPS_OF_HEAT]
    channels = [np.interp(share, stops, [colour[axis] for _, colour in _STOPS_OF_HEAT]) for axis in range(3)]
    return np.stack(channels, axis=-1).astype(np.uint8)
