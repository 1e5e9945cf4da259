"""A training run as a value: trained tensors, optimiser, random numbers, and where it has got to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator

from mi_splat.errors import MiSplatError, message
from mi_splat.io.parameters import from_raw_parameters, to_raw_parameters
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import Scores
from mi_splat.training.strategies import Edit


class TrainingError(MiSplatError):
    """Training that cannot go on: values that are not finite, or nothing left to train."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """One step as `on_step` hears of it.

    Attributes:
        iteration: Steps done.
        loss: Loss of this one.
        count: Number of Gaussians after it.
        held_out: How true the held-out views are, if they were looked at.
    """

    iteration: int
    loss: float
    count: int
    held_out: Scores | None = None


class TrainState:
    """Everything that the rest of a training run depends on.

    Attributes:
        parameters: Trained tensors as a splat file holds them, SH in two parts: `dc` (N, 1, 3), `rest` (N, K - 1, 3).
        iteration: Steps done.
        generator: Source of everything random.
        queue: Numbers of the views still to come in this pass.
        gradient: (N,) sums of the length of the centres' gradients since the last densification.
        visits: (N,) in how many pictures each Gaussian was visible since then.
        was_reset: Whether opacities were ever reset.
        data: Stands for what it is trained on, so that a run does not go on with something else.
        history: Every evaluation so far, and the last step.
    """

    def __init__(self, start: GaussianScene, config: FitConfig, *, extent: float, seed: int) -> None:
        self.config, self.extent, self.seed, self.data = config, extent, seed, ""
        values = {k: v.detach().clone() for k, v in to_raw_parameters(start.with_degree(config.sh_degree)).items()}
        sh = values.pop("sh")
        values |= {"dc": sh[:, :1].contiguous(), "rest": sh[:, 1:].contiguous()}
        self.parameters = {name: value.float() for name, value in values.items()}
        self.iteration, self.queue, self.was_reset = 0, list[int](), False
        self.history = list[Progress]()
        self.generator = Generator().manual_seed(seed)
        self.gradient, self.visits = torch.zeros(len(start)), torch.zeros(len(start))
        trained = {"dc", "rest"} if "sh" in config.trainable else set[str]()
        trained |= set(config.trainable) & set(self.parameters)
        self.trained = tuple(name for name in self.parameters if name in trained)
        for name in self.trained:
            self.parameters[name].requires_grad_(True)
        groups = [{"params": [self.parameters[name]], "name": name} for name in self.trained]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    @property
    def active(self) -> int:
        """SH degree that is trained now."""
        every = self.config.sh_degree_interval
        return self.config.sh_degree if every == 0 else min(self.config.sh_degree, self.iteration // every)

    def scene(self) -> GaussianScene:
        """The splat as it is now, differentiable, with the SH that is trained so far."""
        p = self.parameters
        rest = p["rest"][:, : (self.active + 1) ** 2 - 1]
        return GaussianScene.unchecked(
            p["means"],
            p["scales"].exp(),
            F.normalize(p["rotations"], dim=1),
            p["opacities"].sigmoid(),
            torch.cat([p["dc"], rest], dim=1),
        )

    def result(self) -> GaussianScene:
        """The splat as it is now, checked."""
        values = {name: value.detach() for name, value in self.parameters.items()}
        sh = torch.cat([values.pop("dc"), values.pop("rest")], dim=1)
        return from_raw_parameters({**values, "sh": sh})

    def rates(self) -> dict[str, float]:
        """Learning rates at this step."""
        config = self.config
        share = min(self.iteration / config.iterations, 1.0)
        means = (
            math.exp((1 - share) * math.log(config.lr_means) + share * math.log(config.lr_means_final)) * self.extent
        )
        rates = {name: float(getattr(config, f"lr_{name}")) for name in ("scales", "rotations", "opacities")}
        return rates | {"means": means, "dc": config.lr_sh, "rest": config.lr_sh / 20}

    def next_view(self, count: int) -> int:
        """Number of the view to look at; all are seen once before any is seen again."""
        if not self.queue:
            self.queue = torch.randperm(count, generator=self.generator).tolist()
        return self.queue.pop()

    def apply(self, edit: Edit) -> None:
        """Exchange the tensors; rows keep their optimiser adam unless they are fresh."""
        if not len(edit.source):
            raise TrainingError(
                message("splat", "Gaussians left after pruning", "none", "lower the rates or start from more of them")
            )
        for group in self.optimiser.param_groups:
            name, old = group["name"], group["params"][0]
            new = edit.parameters[name].detach().clone().requires_grad_(True)
            adam = self.optimiser.state.pop(old, None)
            if adam:
                for key in ("exp_avg", "exp_avg_sq"):
                    moved = adam[key][edit.source]
                    moved[edit.fresh] = 0
                    adam[key] = moved
                self.optimiser.state[new] = adam
            group["params"], self.parameters[name] = [new], new
        self.gradient, self.visits = torch.zeros(len(edit.source)), torch.zeros(len(edit.source))
