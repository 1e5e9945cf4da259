"""The hooks of a strategy: what the trainer asks it, what it may know, and what it may
answer.

The model is gsplat's `Strategy`; its `initialize_state`, `step_pre_backward` and
`step_post_backward` are here `initial_state`, `before_backward` and `after_step`. A
strategy knows nothing of cameras or optimisers. Tensors are those of a splat file:
log-scales, logit opacities, quaternions of any length, SH as `sh0` and `shN`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # not at run time, so that options can be parsed without torch
    from torch import Generator, Tensor

    from mi_splat.scene import GaussianScene

    Parameters = dict[str, Tensor]
    """`means` (N, 3), `scales` (N, 3), `rotations` (N, 4), `opacities` (N,), `sh0` (N,
    1, 3), `shN` (N, K - 1, 3).
    """
    State = dict[str, Tensor]
    """What a strategy remembers from step to step, by name; checkpoints hold it."""


def normal(like: Tensor, generator: Generator) -> Tensor:
    """Standard normal numbers in the shape of a tensor, drawn where it lies; a GPU's
    follow from a draw on the CPU.
    """
    import torch

    if not like.is_cpu:
        seed = int(torch.randint(1 << 62, (), generator=generator))
        generator = torch.Generator(like.device).manual_seed(seed)
    return torch.randn(like.shape, generator=generator, device=like.device)


class ScreenGradients(Protocol):
    """Statistics of the last backward pass that a renderer may keep; see
    `mi_splat.render.renderer.ScreenGradients`.
    """

    # (N,) length of the gradient of each centre on the screen, in half images
    lengths: Tensor
    visible: Tensor  # (N,) in how many images each Gaussian was visible


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Step:
    """What a strategy may know after a step of the optimiser."""

    parameters: Parameters  # the tensors; they are changed by an `Edit` only
    iteration: int  # steps done
    iterations: int  # steps of the whole training
    scene_extent: float  # size of the scene, world units
    lr_means: float  # learning rate of the means at the next step, world units
    # source of everything random, on the CPU; to be drawn from in a fixed order
    generator: Generator
    screen_gradients: ScreenGradients | None  # of this step, if the renderer keeps them


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Edit:
    """What a strategy changes.

    Attributes:
        parameters: New tensors. With `source`, rows of a tensor that is left out are
            copied from the old ones.
        source: (M,) old row of each new row, whose optimiser state it inherits; None
            keeps the rows that there are.
        fresh: (M,) bool, rows whose optimiser state starts anew; None are none.
        forget: Names of tensors whose optimiser state starts anew in all rows.
    """

    parameters: Parameters
    source: Tensor | None = None
    fresh: Tensor | None = None
    forget: tuple[str, ...] = ()


class Strategy(Protocol):
    """Hooks that the trainer calls; a class that derives from this one overrides those
    that it needs.

    All that a strategy remembers between steps is in the state, which the trainer keeps
    and checkpoints hold: a run that is taken up again makes the bits that it would have
    made.
    """

    def initial_state(self, count: int) -> State:
        """What is remembered before the first step, of so many Gaussians.

        Names, shapes and kinds of numbers stay those for the number of Gaussians that
        there are: a checkpoint with others is refused.
        """
        return {}

    def before_backward(self, loss: Tensor, scene: GaussianScene) -> Tensor:
        """The loss that is descended: the photometric one, a scalar, and what is added
        for the splat of this step.
        """
        return loss

    def after_step(self, step: Step, state: State) -> Edit | None:
        """What to change, None for nothing; the state is changed in place.

        Called after each step of the optimiser but the last, since what is changed last
        is trained no more.
        """
        return None


class FixedStrategy(Strategy):
    """A fixed number of Gaussians, of which only values are trained: all hooks as they
    are.
    """
