"""Relocation of dead Gaussians and noise that explores: 3DGS as Markov chain Monte
Carlo (Kheradmand et al. 2024).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mi_splat.maths.rotation import normalise, to_matrix
from mi_splat.scene import GaussianScene
from mi_splat.training.strategies.base import Edit, Step, Strategy, normal

if TYPE_CHECKING:
    from mi_splat.training.strategies.base import Parameters, State
    from mi_splat.training.strategies.config import MCMCConfig


_MOST_SHARES = 51
"""Shares beyond which binomials of float64 lose the sum, as in the reference
implementation.
"""


class MCMCStrategy(Strategy):
    """Rounds of relocation and growth, noise after each step, and a loss that wants few
    and small Gaussians.
    """

    def __init__(self, config: MCMCConfig) -> None:
        self.config = config

    def before_backward(self, loss: Tensor, scene: GaussianScene) -> Tensor:
        """Add the regularisers of opacity and scale."""
        return (
            loss
            + self.config.opacity_reg * scene.opacities.mean()
            + self.config.scale_reg * scene.scales.mean()
        )

    def after_step(self, step: Step, state: State) -> Edit:
        """Relocate where it is time, and add the noise."""
        config = self.config
        at = step.iteration
        edit = Edit(parameters={})
        if (
            config.densify_from < at <= config.densify_until
            and at % config.densify_interval == 0
        ):
            edit = relocate(step.parameters, config=config, generator=step.generator)
        values = {**step.parameters, **edit.parameters}
        moved = explore(
            values, lr_means=step.lr_means, config=config, generator=step.generator
        )
        return replace(edit, parameters={**edit.parameters, "means": moved})


def relocate(
    parameters: Parameters, *, config: MCMCConfig, generator: Generator
) -> Edit:
    """Move dead Gaussians onto living ones, and add some up to the limit; the image
    stays nearly as it is.
    """
    opacity = parameters["opacities"].detach().sigmoid()
    count = len(opacity)
    dead = (opacity <= config.dead_opacity).nonzero().flatten()
    grown = int(count * (1 + config.growth))
    new = max(
        (grown if config.max_gaussians is None else min(grown, config.max_gaussians))
        - count,
        0,
    )
    source = torch.arange(count + new, device=opacity.device)
    fresh = source >= count
    weights = torch.where(opacity > config.dead_opacity, opacity, 0.0)
    if not len(dead) + new or not bool((weights > 0).any()):
        return Edit(parameters={})
    # On the CPU, where the generator is.
    drawn = torch.multinomial(
        weights.cpu(), len(dead) + new, replacement=True, generator=generator
    ).to(source.device)
    targets = torch.cat([dead, source[count:]])
    source[targets], fresh[targets] = drawn, True
    shares = torch.bincount(drawn, minlength=count)[source] + 1
    fresh |= shares > 1
    values = {name: value.detach()[source] for name, value in parameters.items()}
    values["opacities"], values["scales"] = _shared(
        values["opacities"], values["scales"], shares
    )
    return Edit(parameters=values, source=source, fresh=fresh)


def _shared(logits: Tensor, scales: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and log-scale of `shares` Gaussians in one place that look like one
    (Kheradmand et al. 2024, eq. 9).
    """
    several = (shares > 1).nonzero()[:, 0]
    n = shares[several].clamp(max=_MOST_SHARES)
    opacity = logits[several].double().sigmoid().clamp(max=1 - 1e-7)
    split = 1 - (1 - opacity) ** (1 / n)
    factor = opacity / _series(split, n)
    limited = split.clamp(min=0.005, max=1 - 1e-7)
    shared_scales = scales[several].double() + factor.log()[:, None]
    return (
        logits.index_copy(0, several, limited.logit().to(logits.dtype)),
        scales.index_copy(0, several, shared_scales.to(scales.dtype)),
    )


def _series(split: Tensor, n: Tensor) -> Tensor:
    """The double sum of eq. 9, by which opacities are divided, of (M,) opacities of a
    share and (M,) their numbers.
    """
    total = torch.zeros_like(split)
    most = int(n.max()) if len(n) else 0
    for i in range(1, most + 1):
        reached = (n >= i).nonzero()[:, 0]
        k = torch.arange(1, i + 1, dtype=torch.float64, device=split.device)
        binomials = split.new_tensor(
            [math.comb(i - 1, j) * (-1) ** j for j in range(i)]
        )
        terms = (binomials / k.sqrt()) * split[reached, None] ** k
        total.index_add_(0, reached, terms.sum(1))
    return total


def explore(
    parameters: Parameters, *, lr_means: float, config: MCMCConfig, generator: Generator
) -> Tensor:
    """The means after the noise of MCMC: as each Gaussian is shaped, and only for those
    of little opacity.
    """
    opacity = parameters["opacities"].detach().sigmoid()
    gate = torch.sigmoid(-100 * (opacity - config.dead_opacity))[:, None]
    scales = parameters["scales"].detach().exp()
    turn = to_matrix(normalise(parameters["rotations"].detach()))
    noise = normal(scales, generator) * gate * (config.noise_lr * lr_means)
    local = (turn.transpose(1, 2) @ noise[:, :, None])[:, :, 0] * scales**2
    return parameters["means"].detach() + (turn @ local[:, :, None])[:, :, 0]
