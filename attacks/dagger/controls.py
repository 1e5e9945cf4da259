"""Controls of an attack: random changes of the object that change its images as much as the attack does.

Noise of the attack's norm averages out: neighbouring Gaussians change in different directions, so that its images can
be 25 dB closer to the clean ones than those of the attack. A control that could have succeeded changes as much of what
a detector sees. So noise is scaled until the mean squared error over the object's pixels is that of the attack.
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Generator, Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.views import View
from attacks.observe import Control
from attacks.search import Parameters
from mi_splat.scene import GaussianScene

TOLERANCE = 0.1
"""Difference in the object's PSNR at which noise is as large as an attack, dB."""
_TRIALS, _WAVES, _SMOOTH_SH = 16, 8, 4
"""Scales that are tried; plane waves of a smooth field; SH coefficients that it changes (up to degree 1)."""
_FURTHEST = 10.0
"""Most that noise changes logits, log-scales, quaternions and, in world units, means by."""

Draw = tuple[str, int]
"""Name of a control, and index of the draw."""


def control_scenes(
    problem: Problem, attacked: Parameters, config: DaggerConfig, views: Sequence[View]
) -> Iterator[tuple[Draw, GaussianScene]]:
    """Every draw of each control, as the scene that a file would hold."""
    subset, reference = problem.subset, problem.subset.parameters(config.attributes)
    wanted = _object_error(problem, attacked, views) if config.noise_draws and config.controls != ("norm-noise",) else 0
    for control in config.controls:
        generator = Generator().manual_seed(config.seed + 1)  # not the draws of the attack's own starting points
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
    """A random change, as `like`, that agrees between neighbours: plane waves about as long as the object."""
    place = (means - means.mean(0)) / means.std(0).max().clamp(min=1e-9)
    waves, phases = (torch.randn(_WAVES, width, generator=generator) for width in (3, 1))
    amplitudes = torch.randn(_WAVES, *like.shape[1:], generator=generator)
    if like.ndim == 3:
        amplitudes[:, _SMOOTH_SH:] = 0
    field = (place.cpu() @ waves.T + math.pi * phases.T).cos()
    change: Tensor = torch.tensordot(field, amplitudes, dims=1).to(like)
    return change


def _matched(
    problem: Problem, noisy: Parameters, reference: Parameters, views: Sequence[View], wanted: float
) -> Parameters:
    """The noise, scaled until it changes the object's pixels by the error that is wanted."""
    moves = [float((value - reference[name]).abs().max()) for name, value in noisy.items() if name != "sh"]
    most = min((_FURTHEST / move for move in moves if move), default=math.inf)
    scale, below, above = 1.0, None, None
    for _ in range(_TRIALS):
        scaled = {name: reference[name] + scale * (value - reference[name]) for name, value in noisy.items()}
        error = _object_error(problem, scaled, views)
        if not error or not wanted or abs(10 * math.log10(error / wanted)) <= TOLERANCE:
            break
        here = (math.log(scale), math.log(error / wanted))
        below, above = (below, here) if error > wanted else (here, above)
        if below is None or above is None:  # a small change's error grows with the square of the scale
            if scale >= most and error < wanted:
                break
            scale = min(scale * min(max((wanted / error) ** 0.5, 0.1), 10.0), most)
        else:
            share = below[1] / (below[1] - above[1])
            scale = math.exp(below[0] + min(max(share, 0.1), 0.9) * (above[0] - below[0]))
    return scaled


def _object_error(problem: Problem, parameters: Parameters, views: Sequence[View]) -> float:
    """Mean squared error over the pixels that are at least half the object's, as in `image_change`."""
    squares, pixels = 0.0, 0
    for view in views:
        on_object = view.weight >= 0.5
        change = problem.image(parameters, view.camera) - problem.clean(view.camera)
        squares += float(change[on_object].double().square().sum())
        pixels += 3 * int(on_object.sum())
    return squares / pixels
