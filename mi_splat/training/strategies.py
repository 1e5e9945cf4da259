"""Where Gaussians are added and removed while a splat is trained: the classic recipe of 3DGS, and MCMC relocation.

Both are functions from the trained tensors to an `Edit`: new tensors, and for each new row the old row whose optimiser
state it inherits. They know nothing of cameras, losses or optimisers. Tensors are those of a splat file: log-scales,
logit opacities, quaternions of any length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from mi_splat.rotation import normalise, to_matrix

Parameters = dict[str, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassicConfig:
    """Clone, split and prune by the gradient of the mean on the screen (Kerbl et al. 2023, section 5.2).

    Attributes:
        densify_from: First iteration at which Gaussians may be added.
        densify_until: No more after this one.
        densify_interval: Iterations between two rounds.
        densify_grad_threshold: Mean gradient of the centre, in half pictures (normalised device coordinates), from
            which a Gaussian is cloned or split.
        percent_dense: Gaussians larger than this share of the scene's extent are split, smaller ones cloned.
        prune_opacity: Gaussians below it are removed.
        prune_scale: Gaussians larger than this share of the extent are removed once opacities have been reset.
        opacity_reset_interval: Iterations between two resets of the opacities to at most 0.01; 0 never does it.
        max_gaussians: No Gaussians are added beyond this number; None sets no limit.
    """

    densify_from: int = 500
    densify_until: int = 15_000
    densify_interval: int = 100
    densify_grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.1
    opacity_reset_interval: int = 3000
    max_gaussians: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MCMCConfig:
    """Relocation of dead Gaussians, with noise that explores (Kheradmand et al. 2024).

    Attributes:
        densify_from: First iteration at which Gaussians are moved.
        densify_until: No more after this one.
        densify_interval: Iterations between two rounds.
        max_gaussians: Largest number of Gaussians.
        growth: Share by which their number grows each round until then.
        dead_opacity: Opacity below which a Gaussian is dead.
        noise_lr: Size of the noise on the means, in units of their learning rate.
        opacity_reg: Weight of the mean opacity in the loss.
        scale_reg: Weight of the mean scale in the loss.
    """

    densify_from: int = 500
    densify_until: int = 25_000
    densify_interval: int = 100
    max_gaussians: int = 100_000
    growth: float = 0.05
    dead_opacity: float = 0.005
    noise_lr: float = 5e5
    opacity_reg: float = 0.01
    scale_reg: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Edit:
    """New tensors and where their rows come from.

    Attributes:
        parameters: The new tensors.
        source: (M,) old row of each new row.
        fresh: (M,) bool, rows whose optimiser state starts anew.
    """

    parameters: Parameters
    source: Tensor
    fresh: Tensor


def classic(
    parameters: Parameters,
    gradient: Tensor,
    *,
    extent: float,
    config: ClassicConfig,
    was_reset: bool,
    generator: Generator,
) -> Edit:
    """One round of clone, split and prune.

    Args:
        parameters: The trained tensors, N rows each.
        gradient: (N,) mean length of the centre's gradient since the last round.
        extent: Size of the scene, world units.
        config: Thresholds.
        was_reset: Whether opacities were ever reset; only then are large Gaussians removed.
        generator: Where the children of a split are drawn from.
    """
    count = len(gradient)
    largest = parameters["scales"].detach().amax(1).exp()
    room = count if config.max_gaussians is None else max(config.max_gaussians - count, 0)
    chosen = gradient >= config.densify_grad_threshold
    if int(chosen.sum()) > room:  # those that need it most come first
        order = torch.argsort(gradient, descending=True, stable=True)[:room]
        chosen = torch.zeros_like(chosen).index_fill_(0, order, True) & chosen
    split = chosen & (largest > config.percent_dense * extent)
    clone = (chosen & ~split).nonzero().flatten()
    parents = split.nonzero().flatten().repeat_interleave(2)
    kept = (~split).nonzero().flatten()
    source = torch.cat([kept, clone, parents])
    fresh = torch.arange(len(source)) >= len(kept)
    grown = {name: value.detach()[source] for name, value in parameters.items()}
    children = slice(len(kept) + len(clone), None)
    _scatter_children(grown, children, generator)
    alive = grown["opacities"].sigmoid() >= config.prune_opacity
    if was_reset:
        alive &= grown["scales"].amax(1).exp() <= config.prune_scale * extent
    return Edit({name: value[alive].contiguous() for name, value in grown.items()}, source[alive], fresh[alive])


def _scatter_children(values: Parameters, rows: slice, generator: Generator) -> None:
    """Draw the children's means from their parent and make them 1.6 times smaller."""
    scales = values["scales"][rows].exp()
    turn = to_matrix(normalise(values["rotations"][rows]))
    draw = torch.randn(scales.shape, generator=generator) * scales
    values["means"][rows] += (turn @ draw[:, :, None])[:, :, 0]
    values["scales"][rows] = (scales / 1.6).log()


def reset_opacities(opacities: Tensor, *, most: float = 0.01) -> Tensor:
    """Logits of opacities of at most `most`."""
    return opacities.detach().clamp(max=math.log(most / (1 - most)))


def relocate(parameters: Parameters, *, config: MCMCConfig, generator: Generator) -> Edit:
    """Move dead Gaussians onto living ones, and add some up to the limit; the picture stays nearly as it is.

    Args:
        parameters: The trained tensors, N rows each.
        config: Thresholds.
        generator: What is drawn: living Gaussians by their opacity.
    """
    opacity = parameters["opacities"].detach().sigmoid()
    count = len(opacity)
    dead = (opacity <= config.dead_opacity).nonzero().flatten()
    new = max(min(int(count * (1 + config.growth)), config.max_gaussians) - count, 0)
    source = torch.arange(count + new)
    fresh = source >= count
    weights = torch.where(opacity > config.dead_opacity, opacity, 0.0)
    if not len(dead) + new or not bool((weights > 0).any()):
        return Edit({k: v.detach() for k, v in parameters.items()}, source[:count], fresh[:count])
    drawn = torch.multinomial(weights, len(dead) + new, replacement=True, generator=generator)
    places = torch.cat([dead, torch.arange(count, count + new)])
    source[places], fresh[places] = drawn, True
    shares = torch.bincount(drawn, minlength=count)[source] + 1
    fresh |= shares > 1
    values = {name: value.detach()[source] for name, value in parameters.items()}
    values["opacities"], values["scales"] = _shared(values["opacities"], values["scales"], shares)
    return Edit(values, source, fresh)


def _shared(logits: Tensor, scales: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and log-scale of `shares` Gaussians in one place that look like one (Kheradmand et al. 2024, eq. 9)."""
    opacity = logits.double().sigmoid().clamp(max=1 - 1e-7)
    n = shares.clamp(max=51)
    split = 1 - (1 - opacity) ** (1 / n)
    total = torch.zeros_like(opacity)
    for i in range(1, int(n.max()) + 1):
        k = torch.arange(i, dtype=torch.float64)
        binomials = torch.tensor([math.comb(i - 1, j) * (-1) ** j for j in range(i)], dtype=torch.float64)
        terms = (binomials / (k + 1).sqrt()) * split[:, None] ** (k + 1)
        total += torch.where(n >= i, terms.sum(1), 0.0)
    factor = torch.where(n > 1, opacity / total, 1.0)
    several = n > 1
    limited = split.clamp(min=0.005, max=1 - 1e-7)
    return (
        torch.where(several, limited.logit(), logits.double()).to(logits.dtype),
        torch.where(several[:, None], scales.double() + factor.log()[:, None], scales.double()).to(scales.dtype),
    )


def explore(parameters: Parameters, *, rate: float, config: MCMCConfig, generator: Generator) -> Tensor:
    """The means after the noise of MCMC: as each Gaussian is shaped, and only for those of little opacity.

    Args:
        parameters: The trained tensors.
        rate: Learning rate of the means.
        config: Size of the noise.
        generator: Source of the noise.
    """
    opacity = parameters["opacities"].detach().sigmoid()
    gate = torch.sigmoid(-100 * (opacity - config.dead_opacity))[:, None]
    scales = parameters["scales"].detach().exp()
    turn = to_matrix(normalise(parameters["rotations"].detach()))
    noise = torch.randn(scales.shape, generator=generator) * gate * (config.noise_lr * rate)
    local = (turn.transpose(1, 2) @ noise[:, :, None])[:, :, 0] * scales**2
    return parameters["means"].detach() + (turn @ local[:, :, None])[:, :, 0]
