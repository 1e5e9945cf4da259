"""The strategy of 3D Gaussian Splatting: clone, split and prune (Kerbl et al. 2023,
section 5.2).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import normalise, to_matrix
from mi_splat.training.strategies.base import Edit, Step, Strategy, normal

if TYPE_CHECKING:
    from mi_splat.training.strategies.base import Parameters, State
    from mi_splat.training.strategies.config import ClassicConfig

SPLIT_SCALE = 1.6
"""By which the two children of a split are smaller than their parent."""
RESET_OPACITY = 0.01
"""What opacities are lowered to."""


class ClassicStrategy(Strategy):
    """Rounds of clone, split and prune, and resets of the opacities.

    Its state: `grad2d` (N,), sums of the length of the centres' gradients since the
    last round; `visible_count` (N,), in how many images each Gaussian was visible
    since then; `opacities_were_reset`, one bool.
    """

    def __init__(self, config: ClassicConfig) -> None:
        self.config = config

    def initial_state(self, count: int) -> State:
        """Nothing is counted yet."""
        return {
            **_counters(count),
            "opacities_were_reset": torch.zeros(1, dtype=torch.bool),
        }

    def after_step(self, step: Step, state: State) -> Edit | None:
        """Count; densify and prune, and reset opacities, where it is time."""
        config = self.config
        at = step.iteration
        if step.screen_gradients is None:
            do = "use Renderer(screen_gradients=ScreenGradients())"
            raise InvalidValueError.of(
                "render", "a renderer that keeps screen gradients", "none kept", do
            )
        state["grad2d"] += step.screen_gradients.lengths
        state["visible_count"] += step.screen_gradients.visible
        if config.densify_until is None:
            until = step.iterations // 2
        else:
            until = config.densify_until
        edit = None
        if config.densify_from < at <= until and at % config.densify_interval == 0:
            edit = densify_and_prune(
                step.parameters,
                state["grad2d"] / state["visible_count"].clamp(min=1),
                scene_extent=step.scene_extent,
                config=config,
                prune_large=bool(state["opacities_were_reset"]),
                generator=step.generator,
            )
            state |= _counters(
                len(edit.parameters["means"]), edit.parameters["means"].device
            )
        if (
            config.opacity_reset_interval
            and at % config.opacity_reset_interval == 0
            and at <= until
        ):
            values = step.parameters if edit is None else edit.parameters
            lowered = {"opacities": reset_opacities(values["opacities"])}
            if edit is None:
                edit = Edit(parameters=lowered)
            else:
                edit = replace(edit, parameters=values | lowered)
            edit = replace(edit, forget=("opacities",))
            state["opacities_were_reset"][:] = True
        return edit


def _counters(count: int, device: torch.device | None = None) -> State:
    return {
        name: torch.zeros(count, device=device) for name in ("grad2d", "visible_count")
    }


def densify_and_prune(
    parameters: Parameters,
    grad2d: Tensor,
    *,
    scene_extent: float,
    config: ClassicConfig,
    prune_large: bool,
    generator: Generator,
) -> Edit:
    """One round of clone, split and prune."""
    count = len(grad2d)
    largest = parameters["scales"].detach().amax(1).exp()
    if config.max_gaussians is None:
        room = count
    else:
        room = max(config.max_gaussians - count, 0)
    chosen = grad2d >= config.densify_grad_threshold
    if int(chosen.sum()) > room:  # those that need it most come first
        order = torch.argsort(grad2d, descending=True, stable=True)[:room]
        chosen = torch.zeros_like(chosen).index_fill_(0, order, True) & chosen
    split = chosen & (largest > config.percent_dense * scene_extent)
    clone = (chosen & ~split).nonzero().flatten()
    parents = split.nonzero().flatten().repeat_interleave(2)
    kept = (~split).nonzero().flatten()
    source = torch.cat([kept, clone, parents])
    fresh = torch.arange(len(source), device=source.device) >= len(kept)
    grown = {name: value.detach()[source] for name, value in parameters.items()}
    children = slice(len(kept) + len(clone), None)
    _scatter_children(grown, children, generator)
    alive = grown["opacities"].sigmoid() >= config.prune_opacity
    if prune_large:
        alive &= grown["scales"].amax(1).exp() <= config.prune_scale * scene_extent
    values = {name: value[alive].contiguous() for name, value in grown.items()}
    return Edit(parameters=values, source=source[alive], fresh=fresh[alive])


def _scatter_children(values: Parameters, rows: slice, generator: Generator) -> None:
    """Draw the children's means from their parent and make them smaller."""
    scales = values["scales"][rows].exp()
    turn = to_matrix(normalise(values["rotations"][rows]))
    draw = normal(scales, generator) * scales
    values["means"][rows] += (turn @ draw[:, :, None])[:, :, 0]
    values["scales"][rows] = (scales / SPLIT_SCALE).log()


def reset_opacities(opacities: Tensor) -> Tensor:
    """Logits of opacities of at most `RESET_OPACITY`."""
    return opacities.detach().clamp(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
