"""How DAGGER attacks, as one value: the API, the flags of the command line and the snapshot in every result.

Light, so that `--help` is fast: torch is imported when the budget is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from attacks.limits import OPTIMISERS, SCHEDULES, NormName, OptimiserName, Schedule, check_limits
from mi_splat.attributes import Attribute
from mi_splat.config_values import check_numbers, several
from mi_splat.errors import InvalidValueError, message

if TYPE_CHECKING:
    from attacks.budgets import Budget
    from attacks.objectives import Verdict

EnsembleLoss = Literal["mean", "max"]
"""How the losses of several detectors become one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Perturbation:
    """What may change, how far, and in how many steps: what every form of the attack has to know.

    Attributes:
        attributes: What of the object's Gaussians may change.
        eps: Radius of the ball in the units of the splat file: one for all attributes, or one for each.
        norm: How the change is measured: one ball over the whole object (linf, l2), or one for each Gaussian.
        steps: Number of steps.
        step_factor: A step is eps * step_factor / steps long.
        noise_draws: Draws of random noise of the same size, as a control.
        sh_degree: SH degree of the attacked file, if SH may change.
        seed: Seed of everything random.

    Raises:
        InvalidValueError: A value is out of its range, or there are not as many radii as attributes.
    """

    attributes: tuple[Attribute, ...] = ("sh",)
    eps: tuple[float, ...] = (5.0,)
    norm: NormName = "l2"
    steps: int = 11
    step_factor: float = 2.0
    noise_draws: int = 5
    sh_degree: int | None = 3
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("attributes", "eps"):
            object.__setattr__(self, name, several(getattr(self, name)))
        check_numbers(self, {"steps": 1, "noise_draws": 0})
        if len(self.eps) not in (1, len(self.attributes)) or len(set(self.attributes)) != len(self.attributes):
            expected = f"one number for all of {', '.join(self.attributes)}, or one for each"
            raise InvalidValueError(message("eps", expected, self.eps, "name every attribute once"))
        if not self.step_factor > 0:
            raise InvalidValueError(message("step_factor", "a positive number", self.step_factor, "2 is the paper's"))
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InvalidValueError(message("sh_degree", "0, 1, 2 or 3", self.sh_degree, "3 is what 3DGS writes"))
        check_limits(self.radius, self.norm)

    @property
    def radius(self) -> dict[str, float]:
        """Radius by attribute."""
        every = self.eps * len(self.attributes) if len(self.eps) == 1 else self.eps
        return dict(zip(self.attributes, every, strict=True))

    @property
    def step(self) -> dict[str, float]:
        """Length of a step by attribute, in the norm."""
        return {name: eps * self.step_factor / self.steps for name, eps in self.radius.items()}

    @property
    def budget(self) -> Budget:
        """Radius and norm as one value."""
        from attacks.budgets import Budget

        return Budget(radius=self.radius, norm=self.norm)


def check_share(config: object, *names: str) -> None:
    """Raise unless fields of a configuration are fractions in (0, 1]."""
    for name in names:
        if not 0 < getattr(config, name) <= 1:
            raise InvalidValueError(message(name, "a fraction in (0, 1]", getattr(config, name), "1 means every view"))


def check_momentum(momentum: float, schedule: str) -> None:
    """Raise unless these are what `attacks.optimisers` knows."""
    if schedule not in SCHEDULES:
        raise InvalidValueError(message("schedule", f"one of {', '.join(SCHEDULES)}", schedule, "choose one"))
    if not 0 <= momentum < 1:
        raise InvalidValueError(message("momentum", "a fraction in [0, 1)", momentum, "0 is none"))


def check_power(power: float) -> None:
    """Raise unless gradients can be raised to a power."""
    if not 0 <= power <= 1:
        do = "1 leaves gradients as they are"
        raise InvalidValueError(message("gradient_power", "a fraction in [0, 1]", power, do))


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig(Perturbation):
    """How to attack. The defaults are those of the paper's text.

    Attributes:
        attributes: What of the object's Gaussians may change.
        eps: Radius of the ball in the units of the splat file: one for all attributes, or one for each.
        norm: How the change is measured: one ball over the whole object (linf, l2), or one for each Gaussian.
        steps: Number of steps.
        step_factor: A step is eps * step_factor / steps long.
        restarts: Number of runs; the first starts at the clean object, the others at random points of the ball.
        random_start: Start the first run at a random point of the ball, too.
        early_stop: Whether the first unambiguous success ends the search; without, every step of every run is taken.
        required_views: Fraction of the views in which the attack has to succeed.
        required_detectors: Fraction of the detectors, if there are several, that the attack has to deceive.
        ensemble: Loss over several detectors: the mean of theirs, or that of the one that resists most.
        momentum: Share of the earlier gradients that is kept at each step, in [0, 1).
        schedule: How the steps become shorter.
        gradient_power: Power of the gradients' absolute values before a step, in [0, 1]; below 1, small ones count for
            more (see `attacks.optimisers.MomentumDescent`).
        noise_draws: Draws of random noise of the same size, as a control.
        sh_degree: SH degree of the attacked file, if SH may change and the scene has less; coefficients that it lacks
            start at 0. 3 is what 3DGS writes and what the paper attacked; None keeps the scene's own.
        seed: Seed of everything random: starting points and the noise control.

    Raises:
        InvalidValueError: A value is out of its range, or there are not as many radii as attributes.
    """

    restarts: int = 1
    random_start: bool = False
    early_stop: bool = True
    required_views: float = 1.0
    required_detectors: float = 1.0
    ensemble: EnsembleLoss = "mean"
    momentum: float = 0.0
    schedule: Schedule = "constant"
    gradient_power: float = 1.0

    def __post_init__(self) -> None:
        Perturbation.__post_init__(self)
        check_numbers(self, {"restarts": 1})
        check_share(self, "required_views", "required_detectors")
        if self.ensemble not in get_args(EnsembleLoss):
            expected = f"one of {', '.join(get_args(EnsembleLoss))}"
            raise InvalidValueError(message("ensemble", expected, self.ensemble, "mean is the usual one"))
        check_momentum(self.momentum, self.schedule)
        check_power(self.gradient_power)

    def verdict(self, rows: Sequence[Sequence[Verdict]]) -> Verdict:
        """Success with enough detectors, each in enough views, and the score that so many reach."""
        from attacks.objectives import joint_verdict

        each = [joint_verdict(verdicts, self.required_views) for verdicts in zip(*rows, strict=True)]
        return joint_verdict(each, self.required_detectors)


@dataclass(frozen=True, slots=True, kw_only=True)
class EotConfig(Perturbation):
    """How to attack a distribution of views (EOT).

    The defaults were tuned on a few pairs of the example scenes (see docs/dagger-eot.md).

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
            pays for the pictures' squared error (`attacks.dagger.image_budget`); the ball is a second bound.
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

    @property
    def required_detectors(self) -> float:
        """Fraction of the detectors that have to be deceived in a view: all."""
        return 1.0

    def verdict(self, rows: Sequence[Sequence[Verdict]]) -> Verdict:
        """Success where every detector is deceived in enough views; the score orders by the number of these views.

        Between equals it orders by the mean of the verdicts' scores.
        """
        from attacks.objectives import Verdict

        successes, unambiguous = (
            sum(all(getattr(verdict, name) for verdict in row) for row in rows) for name in ("success", "unambiguous")
        )
        mean = sum(min(verdict.score for verdict in row) for row in rows) / len(rows)
        return Verdict(
            success=successes / len(rows) >= self.required_views - 1e-9,
            score=(successes + mean) / (len(rows) + 1),
            unambiguous=unambiguous / len(rows) >= self.required_views - 1e-9,
        )


Config = DaggerConfig | EotConfig
"""How fixed views are attacked, or a distribution of them."""
