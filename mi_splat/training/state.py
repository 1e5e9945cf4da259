"""A training run as a value: trained tensors, optimiser, random numbers, and where it
has got to.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor
from torch.optim.adam import adam

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.parameters import from_raw_parameters, to_raw_parameters
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import Scores
from mi_splat.training.strategies import Edit

MOMENTS = ("exp_avg", "exp_avg_sq", "step")
"""What Adam keeps of each tensor, by torch's names; the first two for each row."""


class Adam:
    """Adam (Kingma and Ba 2015) with the bits of `torch.optim.Adam`, whose first use
    imports torch's compiler.

    Attributes:
        param_groups: Tensors under "params", and their rate under "lr".
        state: What is kept of each tensor that was moved: `MOMENTS`.
    """

    def __init__(
        self, groups: Iterable[dict[str, Any]], *, fused: bool = False
    ) -> None:
        self.param_groups = [{"lr": 0.0, **group} for group in groups]
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._fused = fused

    @torch.no_grad()
    def step(self) -> None:
        """Move every tensor that has a gradient."""
        for group in self.param_groups:
            moved = [tensor for tensor in group["params"] if tensor.grad is not None]
            for tensor in moved:
                if tensor not in self.state:
                    step = torch.zeros(
                        (), device=tensor.device if self._fused else "cpu"
                    )
                    moments = {key: torch.zeros_like(tensor) for key in MOMENTS[:2]}
                    self.state[tensor] = {**moments, "step": step}
            mean, square, steps = (
                [self.state[tensor][key] for tensor in moved] for key in MOMENTS
            )
            gradients = [tensor.grad for tensor in moved]
            rates = {
                "lr": group["lr"],
                "beta1": 0.9,
                "beta2": 0.999,
                "eps": 1e-15,
                "weight_decay": 0.0,
            }
            ways: dict[str, Any] = {
                "foreach": False,
                "fused": self._fused,
                "amsgrad": False,
                "maximize": False,
            }
            adam(moved, gradients, mean, square, [], steps, **rates, **ways)

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.param_groups:
            for tensor in group["params"]:
                tensor.grad = None


class TrainingError(MiSplatError):
    """Training that cannot go on: values that are not finite, or nothing left to
    train.
    """


def check_start(start: GaussianScene, config: FitConfig) -> None:
    """Raise unless a training may begin with these Gaussians."""
    check_scene("start", start)
    if not len(start):
        raise InvalidValueError.of(
            "start", "at least one Gaussian", "none", "capture views first"
        )
    most = config.strategy.max_gaussians
    if config.strategy.adds_gaussians and most is not None and len(start) > most:
        do = "raise max_gaussians, or begin with fewer"
        raise InvalidValueError.of(
            "start",
            f"at most max_gaussians = {most:,} Gaussians",
            f"{len(start):,}",
            do,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """One step as `on_step` hears of it."""

    iteration: int  # steps done
    loss: float  # loss of this one
    count: int  # number of Gaussians after it
    # how true the held-out views are, if they were looked at
    held_out: Scores | None = None


class TrainState:
    """Everything that the rest of a training run depends on."""

    def __init__(
        self, start: GaussianScene, config: FitConfig, *, scene_extent: float, seed: int
    ) -> None:
        self.config = config
        self.scene_extent = scene_extent
        self.seed = seed
        self.data_digest = ""
        self.settings = dict[str, object]()
        values = {
            k: v.detach().clone()
            for k, v in to_raw_parameters(start.with_degree(config.sh_degree)).items()
        }
        sh = values.pop("sh")
        values |= {"sh0": sh[:, :1].contiguous(), "shN": sh[:, 1:].contiguous()}
        self.parameters = {name: value.float() for name, value in values.items()}
        self.iteration, self.view_queue = 0, list[int]()
        self.history = list[Progress]()
        self.generator = Generator().manual_seed(seed)
        self.strategy = config.strategy.build()
        self.strategy_state = _moved(
            self.strategy.initial_state(len(start)), start.means.device
        )
        trained = {"sh0", "shN"} if "sh" in config.trainable else set[str]()
        trained |= set(config.trainable) & set(self.parameters)
        self.trained = tuple(name for name in self.parameters if name in trained)
        for name in self.trained:
            self.parameters[name].requires_grad_(True)
        groups = [
            {"params": [self.parameters[name]], "name": name} for name in self.trained
        ]
        self.optimiser = Adam(groups, fused=True)

    def to(self, device: torch.device) -> None:
        """Move everything that is trained or counted to another device."""
        self.strategy_state = _moved(self.strategy_state, device)
        old = self.parameters
        self.parameters = _moved(self.parameters, device)
        for group in self.optimiser.param_groups:
            name = group["name"]
            group["params"] = [self.parameters[name].requires_grad_(True)]
            adam = self.optimiser.state.pop(old[name], {})
            if adam:
                self.optimiser.state[self.parameters[name]] = _moved(adam, device)

    @property
    def active_sh_degree(self) -> int:
        """SH degree that is trained now."""
        every = self.config.sh_degree_interval
        every = self.config.iterations // 30 if every is None else every
        if every == 0:
            return self.config.sh_degree
        return min(self.config.sh_degree, self.iteration // every)

    def scene(self) -> GaussianScene:
        """The splat as it is now, differentiable, with the SH that is trained so
        far.
        """
        p = self.parameters
        higher = p["shN"][:, : (self.active_sh_degree + 1) ** 2 - 1]
        return GaussianScene.unchecked(
            p["means"],
            p["scales"].exp(),
            F.normalize(p["rotations"], dim=1),
            p["opacities"].sigmoid(),
            torch.cat([p["sh0"], higher], dim=1),
        )

    def result(self) -> GaussianScene:
        """The splat as it is now, checked."""
        values = {name: value.detach() for name, value in self.parameters.items()}
        sh = torch.cat([values.pop("sh0"), values.pop("shN")], dim=1)
        return from_raw_parameters({**values, "sh": sh})

    def learning_rates(self) -> dict[str, float]:
        """Learning rates at this step, by the names of `parameters`; those with a last
        one decay exponentially.
        """
        config = self.config
        progress = min(self.iteration / config.iterations, 1.0)

        def decayed(first: float, last: float) -> float:
            return math.exp(
                (1 - progress) * math.log(first) + progress * math.log(last)
            )

        if config.lr_sh_final is None:
            sh = config.lr_sh
        else:
            sh = decayed(config.lr_sh, config.lr_sh_final)
        return {
            "means": (
                decayed(config.lr_means, config.lr_means_final) * self.scene_extent
            ),
            "scales": config.lr_scales,
            "rotations": config.lr_rotations,
            "opacities": config.lr_opacities,
            "sh0": sh,
            "shN": sh / config.lr_sh_divisor,
        }

    def descend(self) -> None:
        """A step of Adam along the gradients that the trained tensors have, with the
        rates of now.
        """
        rates = self.learning_rates()
        for group in self.optimiser.param_groups:
            group["lr"] = rates[group["name"]]
        self.optimiser.step()

    def next_view(self, count: int) -> int:
        """Number of the view to look at; all are seen once before any is seen again."""
        if not self.view_queue:
            self.view_queue = torch.randperm(count, generator=self.generator).tolist()
        return self.view_queue.pop()

    def apply(self, edit: Edit) -> None:
        """Change the tensors as a strategy says; rows keep the state of Adam that they
        had unless they are fresh.
        """
        if edit.source is None:
            with torch.no_grad():
                for name, value in edit.parameters.items():
                    self.parameters[name].copy_(value)
        else:
            self._exchange(edit.parameters, edit.source, edit.fresh)
        for name in edit.forget:
            adam = self.optimiser.state.get(self.parameters[name], {})
            for key in adam.keys() & MOMENTS[:2]:
                adam[key].zero_()

    def _exchange(
        self, values: dict[str, Tensor], source: Tensor, fresh: Tensor | None
    ) -> None:
        """Give all tensors other rows, and Adam's state with them."""
        if not len(source):
            do = "lower the rates or start from more of them"
            raise TrainingError.of("splat", "Gaussians left after pruning", "none", do)
        old = dict(self.parameters)
        for name in old:
            self.parameters[name] = (
                (values[name] if name in values else old[name][source]).detach().clone()
            )
        for group in self.optimiser.param_groups:
            name = group["name"]
            new = self.parameters[name].requires_grad_(True)
            adam = self.optimiser.state.pop(old[name], None)
            if adam:
                for key in MOMENTS[:2]:
                    adam[key] = adam[key][source]
                    if fresh is not None:
                        adam[key][fresh] = 0
                self.optimiser.state[new] = adam
            group["params"] = [new]


def _moved(tensors: dict[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.detach().to(device) for name, value in tensors.items()}
