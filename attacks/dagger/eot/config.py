"""How DAGGER attacks a distribution of views, as one value; light, so that `--help` is fast."""

from __future__ import annotations

import math
from dataclasses import dataclass

from attacks.dagger.config import Perturbation, check_momentum, check_power, check_share
from attacks.limits import OPTIMISERS, NormName, OptimiserName, Schedule
from mi_splat.config_values import check_numbers
from mi_splat.errors import InvalidValueError, message


@dataclass(frozen=True, slots=True, kw_only=True)
class EotConfig(Perturbation):
    """How to attack. The defaults were tuned on a few pairs of the example scenes (see docs/dagger-eot.md).

    Attributes:
        attributes: What of the object's Gaussians may change.
        eps: Radius of the ball in the units of the splat file: one for all attributes, or one for each.
        norm: How the change is measured: one ball over the whole object (linf, l2), or one for each Gaussian.
        steps: Number of steps.
        step_factor: The first step is eps * step_factor / steps long.
        optimiser: What makes a step of the gradients: their steepest direction with momentum (MI-FGSM), or Adam.
        schedule: How the steps become shorter.
        momentum: Share of the earlier gradients that is kept at each step, in [0, 1).
        gradient_power: Power of the gradients' absolute values before a step with momentum, in [0, 1]; below 1, small
            ones count for more (see `attacks.optimisers.MomentumDescent`).
        batch: Views drawn for each step.
        pool: Number of views that they are drawn from; 0 draws new ones at each step.
        validation: Views, no others, that decide which step was best.
        validate_every: Steps between two such decisions.
        stop_at: Fraction of the validation views whose success ends the search; None takes every step.
        required_views: Fraction of the held-out views in which the attack has to succeed.
        held_out: Number of held-out views that judge the result.
        noise_draws: Draws of random noise of the same size, as a control.
        sh_degree: Highest degree of the SH coefficients that may change, if SH may; the file gets it if it has less.
            0 changes a Gaussian's colour by the same from everywhere. None keeps the scene's own.
        image_psnr: PSNR that the pictures keep, dB, over the validation views; None asks for nothing. The search then
            pays for the pictures' squared error (`attacks.dagger.eot.image_budget`); the ball is a second bound.
        seed: Seed of the attack's views, of its validation views, and of the noise.
        judge_seed: Seed of the held-out views; another one.

    Raises:
        InvalidValueError: A value is out of its range, there are not as many radii as attributes, or the judge would
            look at the attack's views.
    """

    eps: tuple[float, ...] = (1.0,)
    norm: NormName = "linf"
    steps: int = 150
    step_factor: float = 13.0
    noise_draws: int = 1
    sh_degree: int | None = 1
    optimiser: OptimiserName = "adam"
    schedule: Schedule = "linear"
    momentum: float = 0.8
    gradient_power: float = 1.0
    batch: int = 3
    pool: int = 200
    validation: int = 12
    validate_every: int = 50
    stop_at: float | None = None
    required_views: float = 0.8
    held_out: int = 60
    judge_seed: int = 1000
    image_psnr: float | None = 26.3

    def __post_init__(self) -> None:
        Perturbation.__post_init__(self)
        check_numbers(self, {"batch": 1, "pool": 0, "validation": 1, "validate_every": 1, "held_out": 1})
        check_share(self, "required_views", *([] if self.stop_at is None else ["stop_at"]))
        check_momentum(self.momentum, self.schedule)
        check_power(self.gradient_power)
        if self.image_psnr is not None and not 0 < self.image_psnr < math.inf:
            expected = "a number of dB > 0, or None"
            raise InvalidValueError(message("image_psnr", expected, self.image_psnr, "26 is easily seen, 40 hardly"))
        if self.optimiser not in OPTIMISERS:
            expected = f"one of {', '.join(OPTIMISERS)}"
            raise InvalidValueError(message("optimiser", expected, self.optimiser, "choose one"))
        if self.judge_seed == self.seed:
            raise InvalidValueError(message("judge_seed", "another seed than the attack's", self.seed, "change one"))
