"""Images before any training: do some of a set contradict what the others show of the
same surface?
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.audit.auditing import cameras_in_frame, judged_object, seen_share
from mi_splat.audit.objects import Target, frame_of, targets
from mi_splat.audit.results import Audit
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera, View, cameras_of
from mi_splat.cameras.directions import Point
from mi_splat.cameras.framing import near_plane
from mi_splat.datasets import Dataset
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points, random_points, thinned
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig

# called after each step of the training with its number and the number of all
OnStep = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PictureAudit:
    """Whether images of a set contradict the others; which ones is not said (see
    `UNNAMED` in `audit.files`).
    """

    audit: Audit  # of the surface that the pictures show; no Gaussian has heat
    numbers: Tensor  # (K,) int64, which images were compared


def audit_pictures(
    views: Dataset, *, up: Point | None = None, on_step: OnStep | None = None
) -> PictureAudit:
    """Say whether images of a set contradict what the others show of the same surface.

    A small splat is trained only for the surface; colours are those of the images. What
    is compared, and what gloss explains of it, is as in `audit`. At most 300 images are
    compared, evenly taken.
    """
    if len(views) < LIMITS.least_cameras:
        do = "take more images of the scene, or audit a splat that was trained on them"
        raise InvalidValueError.of(
            "images", f"at least {LIMITS.least_cameras} for training", len(views), do
        )
    longer = max(max(camera.width, camera.height) for camera in views.cameras)
    views = dataclasses.replace(
        views, downscale=views.downscale * max(1, longer // LIMITS.longer_side)
    )
    numbers = (
        torch.linspace(0, len(views) - 1, min(len(views), LIMITS.most_cameras))
        .round()
        .long()
    )
    views = dataclasses.replace(
        views, frames=tuple(views.frames[number] for number in numbers.tolist())
    )
    return compare_pictures(
        views, quick_surface(views, on_step=on_step), numbers=numbers, up=up
    )


def quick_surface(
    views: Dataset, *, steps: int = LIMITS.surface_steps, on_step: OnStep | None = None
) -> GaussianScene:
    """A splat that is good enough to know where the surface is."""
    if views.points is None:
        start = random_points(views, LIMITS.surface_gaussians)
    else:
        cloud = thinned(views.points, LIMITS.surface_gaussians)
        start = from_points(cloud.points, cloud.colours)
    schedule = FitConfig(
        iterations=steps,
        sh_degree_interval=steps // 6,
        lr_sh_divisor=20,
        eval_interval=0,
    )
    config = dataclasses.replace(schedule, strategy=FixedConfig(), lambda_dssim=0.0)
    render = Renderer(
        RenderSettings(
            background=views.background, near=near_plane(start, views.cameras)
        )
    )
    report = None if on_step is None else (lambda line: on_step(line.iteration, steps))
    return fit(views, start, render=render, config=config, on_step=report).scene


def compare_pictures(
    views: Sequence[View],
    surface: GaussianScene,
    *,
    numbers: Tensor,
    up: Point | None = None,
) -> PictureAudit:
    """Compare pictures on a surface that is known."""
    frame = frame_of(surface)
    cameras = cameras_in_frame(frame, cameras_of(views), None)
    pictures = [view.image for view in views]
    standing = targets(frame.scene, None if up is None else frame.own(up))
    objects = [
        dataclasses.replace(target, cells=_cells(target, cameras), surrounds=False)
        for target in standing
    ]
    judgements = [judged_object(frame, target, cameras, pictures) for target in objects]
    judged = [judgement[0] for judgement in judgements if judgement is not None]
    seen = sum(item.pieces for item in judged)
    if seen < LIMITS.least_pieces:
        expected = (
            f"at least {LIMITS.least_pieces} pieces of surface that pictures from two"
            " sides show"
        )
        do = (
            "pass pictures of one scene with cameras that fit, in which an object fills"
            " more pixels"
        )
        raise InvalidValueError.of("pictures", expected, seen, do)
    nothing = torch.zeros(len(surface))
    audit = Audit(
        objects=tuple(judged),
        heat=nothing,
        mask=nothing > 0,
        near=seen_share(frame, [(target, cameras) for target in objects]),
        up=up,
    )
    return PictureAudit(audit=audit, numbers=numbers)


def _cells(target: Target, cameras: Sequence[Camera]) -> int:
    """Pieces of surface along the diameter of an object, so that one shows in a few
    pixels of most images.
    """
    ways = torch.stack([camera.position - target.centre for camera in cameras]).norm(
        dim=1
    )
    focal = torch.tensor([min(camera.fx, camera.fy) for camera in cameras])
    across = float((2 * target.radius * focal / ways.clamp(min=1e-9)).median())
    return min(
        target.cells, max(LIMITS.least_across, round(across / LIMITS.piece_pixels))
    )
