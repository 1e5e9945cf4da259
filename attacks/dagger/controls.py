"""Controls of an attack: random changes of the object that change its images as much as
the attack does.

Noise of the attack's norm averages out: neighbouring Gaussians change in different
directions, so that its images can be 25 dB closer to the clean ones than those of the
attack. A control that could have succeeded changes as much of what a detector sees. So
noise is scaled until the mean squared error over the object's pixels is that of the
attack.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.views import View
from attacks.observe import Control
from attacks.search.parameters import Parameters
from mi_splat.scene import GaussianScene

TOLERANCE = 0.1
"""Difference in the object's PSNR at which noise is as large as an attack, dB."""
_NEAR = TOLERANCE * math.log(10) / 10
_KNOWN = 5 * _NEAR
"""Gap over which a slope that was measured leads to within `TOLERANCE`: it is known to
a fifth.
"""
_TRIALS = 16
_FEW = 6
"""Scales that are tried; views on which a scale is estimated, where there are many
more.
"""
_FLATTEST = 0.2
_STEEPEST = 4.0
_LARGEST_STEP = math.log(10)
"""Bounds of how the logarithm of an error grows with that of the scale, and of a step
of the latter.
"""
_WAVES = 8
_SMOOTH_SH = 4
"""Plane waves of a smooth field; SH coefficients that it changes (up to degree 1)."""
_FURTHEST = 10.0
"""Most that noise changes logits, log-scales, quaternions and, in world units, means
by.
"""
_FURTHEST_SH = 1e6
"""The same of SH coefficients: more takes no colour further than white, and a scene
holds no more than 1e9.
"""

Error = tuple[float, int]
"""Sum of the squared differences over an object's pixels in a view, and their
number.
"""

Gap = Callable[[float], float | None]
"""Logarithm of the error over the wanted one at a scale; None where one of them is
zero.
"""

Draw = tuple[str, int]
"""Name of a control, and index of the draw."""


def control_scenes(
    problem: Problem, attacked: Parameters, config: DaggerConfig, views: Sequence[View]
) -> Iterator[tuple[Draw, GaussianScene]]:
    """Every draw of each control, as the scene that a file would hold."""
    subset, reference = problem.subset, problem.subset.parameters(config.attributes)
    has_matched = config.noise_draws and config.controls != ("norm-noise",)
    wanted = _object_errors(problem, attacked, views) if has_matched else []
    for control in config.controls:
        # not the draws of the attack's own starting points
        generator = Generator().manual_seed(config.seed + 1)
        for draw in range(config.noise_draws):
            noisy = _noise(control, problem, attacked, reference, config, generator)
            if control != "norm-noise":
                noisy = _matched(problem, noisy, reference, views, wanted)
            yield (control, draw), subset.applied(noisy)


def _noise(
    control: Control,
    problem: Problem,
    attacked: Parameters,
    reference: Parameters,
    config: DaggerConfig,
    generator: Generator,
) -> Parameters:
    """The object with noise of the norm of the attack."""
    if control != "smooth-noise":
        return config.budget.noise(attacked, reference, generator)
    means = problem.subset.scene.means[problem.subset.rows].detach()
    moved = {}
    for name, value in attacked.items():
        field = _smooth_field(means, reference[name], generator)
        size = (value - reference[name]).detach().norm() / field.norm().clamp(min=1e-30)
        moved[name] = reference[name] + size * field
    return moved


def _smooth_field(means: Tensor, like: Tensor, generator: Generator) -> Tensor:
    """A random change, as `like`, that agrees between neighbours: plane waves about as
    long as the object.
    """
    place = (means - means.mean(0)) / means.std(0).max().clamp(min=1e-9)
    waves, phases = (
        torch.randn(_WAVES, width, generator=generator) for width in (3, 1)
    )
    amplitudes = torch.randn(_WAVES, *like.shape[1:], generator=generator)
    if like.ndim == 3:
        amplitudes[:, _SMOOTH_SH:] = 0
    field = (place.cpu() @ waves.T + math.pi * phases.T).cos()
    change: Tensor = torch.tensordot(field, amplitudes, dims=1).to(like)
    return change


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleEstimate:
    """Where the error is expected to be the wanted one, and how its logarithm grows
    with that of the scale.
    """

    scale: float = 1.0
    slope: float = 2.0
    is_measured: bool = False  # whether the slope is that of two looks


def _matched(
    problem: Problem,
    noisy: Parameters,
    reference: Parameters,
    views: Sequence[View],
    wanted: Sequence[Error],
) -> Parameters:
    """The noise, scaled until it changes the object's pixels by the error that is
    wanted.

    A small change's error grows with the square of its scale, so the first estimate is
    linear in the logarithms. It is made better on a few of the views, and then on all,
    of which one look is usual: near the aim the slope is known well enough to go the
    rest of the way without another one.
    """

    def scaled(scale: float) -> Parameters:
        return {
            name: reference[name] + scale * (value - reference[name])
            for name, value in noisy.items()
        }

    def gap_on(some: slice) -> Gap:
        aim = _mean(wanted[some])

        def gap(scale: float) -> float | None:
            error = _mean(_object_errors(problem, scaled(scale), views[some]))
            if error and aim:
                return math.log(error / aim)
            return None

        return gap

    moves = {
        name: float((value - reference[name]).abs().max())
        for name, value in noisy.items()
    }
    furthest = {name: _FURTHEST_SH if name == "sh" else _FURTHEST for name in moves}
    most = min(
        (furthest[name] / move for name, move in moves.items() if move),
        default=math.inf,
    )
    estimate = ScaleEstimate()
    if len(views) > 2 * _FEW:
        estimate = _crossing(
            gap_on(slice(None, None, len(views) // _FEW)), estimate, most
        )
    return scaled(_crossing(gap_on(slice(None)), estimate, most).scale)


def _crossing(gap: Gap, estimate: ScaleEstimate, most: float) -> ScaleEstimate:
    """The scale, at most so large, at which the gap vanishes, by secants; the last one
    that was looked at.
    """
    scale = min(estimate.scale, most)
    slope = estimate.slope
    is_measured = estimate.is_measured
    # logarithms of scales that are too small, too large
    low = -math.inf
    high = math.inf
    before: tuple[float, float] | None = None
    for _ in range(_TRIALS):
        here = gap(scale)
        if here is None or (scale >= most and here < 0):
            break
        place = math.log(scale)
        if before is not None and place != before[0]:
            slope = min(
                max((here - before[1]) / (place - before[0]), _FLATTEST), _STEEPEST
            )
            is_measured = True
        if abs(here) <= _NEAR:
            break
        low, high = (place, high) if here < 0 else (low, place)
        before = (place, here)
        step = min(max(-here / slope, -_LARGEST_STEP), _LARGEST_STEP)
        following = place + step
        if not low < following < high:
            following = (low + high) / 2
        scale = min(math.exp(following), most)
        if is_measured and abs(here) <= _KNOWN:
            break
    return ScaleEstimate(scale=scale, slope=slope, is_measured=is_measured)


def _object_errors(
    problem: Problem, parameters: Parameters, views: Sequence[View]
) -> list[Error]:
    """Over the pixels that are at least half the object's, as in `image_change`."""
    errors: list[Error] = []
    for view in views:
        change = problem.image(parameters, view.camera) - problem.clean(view.camera)
        squares = float(change[view.on_object].double().square().sum())
        errors.append((squares, 3 * int(view.on_object.sum())))
    return errors


def _mean(errors: Sequence[Error]) -> float:
    """Mean squared error; 0 without pixels."""
    pixels = sum(count for _, count in errors)
    if pixels:
        return sum(squares for squares, _ in errors) / pixels
    return 0.0
