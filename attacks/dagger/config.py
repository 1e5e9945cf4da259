"""How DAGGER attacks, as one value: the API, the flags of the command line and the snapshot in every result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from attacks.budgets import Budget, NormName
from mi_splat.errors import InvalidValueError, message

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig:
    """How to attack. The defaults are the paper's.

    Attributes:
        attributes: What may change of the object's Gaussians.
        eps: Radius of the budget for each attribute, in the same order and in the units of the splat file.
        norm: linf, l2 (one ball over the whole object) or l2_per_gaussian (a ball for each).
        steps: Number of steps.
        step_factor: A step is eps * step_factor / steps long.
        restarts: Number of runs; the first starts at the clean splat, the others anywhere in the ball.
        random_start: Start the first run anywhere in the ball, too.
        early_stop: Stop at the first success instead of spending every step.
        required_views: Fraction of the views in which the attack has to succeed.
        noise_draws: Number of draws of the random-noise control.
        sh_degree: SH degree that the attacked file has at least, if SH is attacked at all; coefficients that the scene
            lacks start at 0. 3 is what 3DGS writes and what the paper attacked; the scene's own if None.
        seed: Seed of restarts and noise; with one run the attack itself is deterministic.
    """

    attributes: tuple[Attribute, ...] = ("sh",)
    eps: tuple[float, ...] = (5.0,)
    norm: NormName = "l2"
    steps: int = 11
    step_factor: float = 2.0
    restarts: int = 1
    random_start: bool = False
    early_stop: bool = True
    required_views: float = 1.0
    noise_draws: int = 5
    sh_degree: int | None = 3
    seed: int = 0

    def __post_init__(self) -> None:
        if len(self.attributes) != len(self.eps) or len(set(self.attributes)) != len(self.attributes):
            raise InvalidValueError(
                message(
                    "eps", f"one number for each of {', '.join(self.attributes)}", self.eps, "give each its own radius"
                )
            )
        for name, value, least in (
            ("steps", self.steps, 1),
            ("restarts", self.restarts, 1),
            ("noise_draws", self.noise_draws, 0),
        ):
            if value < least:
                raise InvalidValueError(message(name, f"a number >= {least}", value, "ask for more"))
        if not 0 < self.required_views <= 1:
            raise InvalidValueError(
                message("required_views", "a fraction in (0, 1]", self.required_views, "1 means every view")
            )
        if not (math.isfinite(self.step_factor) and self.step_factor > 0):
            raise InvalidValueError(message("step_factor", "a positive number", self.step_factor, "2 is the paper's"))
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InvalidValueError(message("sh_degree", "0, 1, 2 or 3", self.sh_degree, "3 is what 3DGS writes"))
        _ = self.budget

    @property
    def budget(self) -> Budget:
        """Radius and norm as one value."""
        return Budget(radius=dict(zip(self.attributes, self.eps, strict=True)), norm=self.norm)
