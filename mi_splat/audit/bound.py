"""A copy of a splat whose colours hardly depend on the direction, with a proof.

By the addition theorem of spherical harmonics, the coefficients of a band l depart
from 0 by at most sqrt((2l + 1) / 4 pi) times their norm in any direction. The sum over
the bands above 0 therefore bounds how far a Gaussian's colour departs from that of band
0, and can be computed from a file alone. Nothing is promised of band 0, nor of
geometry.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import MOST_OBJECTS, frame_of, targets
from mi_splat.audit.viewpoints import in_world, views_around
from mi_splat.cameras.camera import Camera, as_cameras
from mi_splat.cameras.framing import near_plane
from mi_splat.errors import InvalidValueError
from mi_splat.maths.metrics import psnr
from mi_splat.maths.sh import colour_to_dc, even_directions, sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.selection.visibility import contributions

CAMERAS = 32  # from which a splat is looked at
SIDE = 96  # pixels of the longer side of their images
SHOWS = 0.02  # share of the most pixels that a Gaussian makes up in an image
LEAST_SHOWS = 3  # images that have to show a Gaussian, or all directions count
ROUNDING = 1e-6  # by which colours are scaled further down, for float32
_CHUNK = 8192


def colour_bound(scene: GaussianScene) -> Tensor:
    """How far the colour of each Gaussian departs from that of its band 0 at most.

    Args:
        scene: The splat.

    Returns:
        (N,) float64 sRGB, the largest of the three channels; 0 without bands above 0.
    """
    sh = scene.sh.detach().cpu().double()
    total = sh.new_zeros(len(sh), 3)
    for degree in range(1, scene.degree + 1):
        band = sh[:, degree**2 : (degree + 1) ** 2]
        total += band.norm(dim=1) * math.sqrt((2 * degree + 1) / (4 * math.pi))
    return total.amax(1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bounded:
    """A bounded copy and what it costs.

    Attributes:
        scene: The copy.
        changed: (N,) bool, Gaussians whose colours are not those of the splat.
        psnr: PSNR in dB of the copy to the splat from each camera, infinite where both
            are the same.
    """

    scene: GaussianScene
    changed: Tensor
    psnr: tuple[float, ...]


def bounded(
    scene: GaussianScene,
    eps: float = 0.05,
    *,
    keep: Tensor | None = None,
    keep_eps: float = math.inf,
    cameras: Sequence[Camera] | None = None,
) -> Bounded:
    """Make no colour depart from a consensus by more than eps in any direction.

    The consensus of a Gaussian is the median of its colours towards the cameras that it
    shows in. Its band 0 becomes the consensus, and all others are scaled down. What is
    within the bound already stays as it is.

    Args:
        scene: The splat.
        eps: Largest departure, sRGB.
        keep: (N,) bool, Gaussians that may depart by `keep_eps`; None is none of them.
        keep_eps: Their largest departure, sRGB.
        cameras: From where it is looked at; None is from around its objects.

    Returns:
        The copy, whose `colour_bound` is at most eps, or `keep_eps`.

    Raises:
        InvalidValueError: eps is not positive, or keep has another shape.
    """
    check_scene("scene", scene)
    if not min(eps, keep_eps) > 0:
        do = "0.05 is hardly seen"
        raise InvalidValueError.of("eps", "more than 0", min(eps, keep_eps), do)
    if keep is not None and (keep.shape != (len(scene),) or keep.dtype != torch.bool):
        got = f"{keep.dtype} {tuple(keep.shape)}"
        raise InvalidValueError.of("keep", f"bool ({len(scene)},)", got, "pass a mask")
    plain = scene.detach().to("cpu", torch.float32)
    around = _small(around_objects(plain) if cameras is None else as_cameras(cameras))
    allowed = torch.full((len(scene),), float(eps), dtype=torch.float64)
    if keep is not None:
        allowed[keep] = float(keep_eps)
    reach = colour_bound(plain)
    changed = reach > allowed
    sh = plain.sh.clone()
    rows = changed.nonzero()[:, 0]
    sh[rows, 0] = colour_to_dc(_consensus(plain, rows, around))
    factor = (1 - ROUNDING) * allowed[rows] / reach[rows]
    sh[rows, 1:] = (sh[rows, 1:].double() * factor[:, None, None]).float()
    copy = plain.replace(sh=sh)
    return Bounded(scene=copy, changed=changed, psnr=_prices(plain, copy, around))


def around_objects(scene: GaussianScene) -> tuple[Camera, ...]:
    """Cameras around the objects of a splat, in the world."""
    frame = frame_of(scene)
    cameras = list[Camera]()
    for target in targets(frame.scene):
        around = views_around(target, CAMERAS)
        cameras += [in_world(frame, camera) for camera in around]
    return tuple(cameras)


def _small(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """At most so many of the cameras that it takes little time, with small images."""
    count = min(len(cameras), CAMERAS * MOST_OBJECTS)
    numbers = torch.linspace(0, len(cameras) - 1, count).round().long().tolist()
    small = []
    for camera in (cameras[number] for number in numbers):
        factor = SIDE / max(camera.width, camera.height)
        width = max(8, round(camera.width * factor))
        height = max(8, round(camera.height * factor))
        small.append(resized(camera, (width, height)))
    return tuple(small)


def _render(scene: GaussianScene, cameras: Sequence[Camera]) -> Renderer:
    return Renderer(RenderSettings(near=near_plane(scene, cameras)))


def _consensus(scene: GaussianScene, rows: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """(M, 3) median colours of some Gaussians over the cameras that show them, or over
    all directions where hardly any does.
    """
    render = _render(scene, cameras)
    pixels = contributions(scene, cameras, render=render, rows=rows)
    shows = pixels > SHOWS * pixels.amax(1, keepdim=True).clamp(min=1e-6)
    eyes = torch.stack([camera.position for camera in cameras]).float()
    everywhere = torch.from_numpy(even_directions()).float()
    medians = [scene.sh.new_zeros(0, 3)]
    for first in range(0, len(rows), _CHUNK):
        part = rows[first : first + _CHUNK]
        seen = shows[first : first + _CHUNK]
        sh = scene.sh[part]
        towards = functional.normalize(scene.means[part, None] - eyes[None], dim=-1)
        shown = _colours(sh, towards)
        usual = _colours(sh, everywhere[None].expand(len(part), -1, -1))
        known = torch.where(seen[..., None], shown, torch.nan)
        median = torch.nanmedian(known, 1).values
        is_few = seen.sum(1, keepdim=True) < LEAST_SHOWS
        medians.append(torch.where(is_few, usual.median(1).values, median))
    return torch.cat(medians)


def _colours(sh: Tensor, directions: Tensor) -> Tensor:
    """(M, D, 3) sRGB of M Gaussians in D directions each."""
    degree = math.isqrt(sh.shape[1]) - 1
    return (sh_basis(directions, degree) @ sh + 0.5).clamp(min=0)


def _prices(
    scene: GaussianScene, copy: GaussianScene, cameras: Sequence[Camera]
) -> tuple[float, ...]:
    """PSNR of a copy to its splat from each camera, dB."""
    render = _render(scene, cameras)
    prices = []
    with torch.no_grad():
        for camera in cameras:
            before = render(scene, camera).clamp(0, 1)
            after = render(copy, camera).clamp(0, 1)
            prices.append(float(psnr(before, after)))
    return tuple(prices)
