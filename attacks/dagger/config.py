"""How DAGGER attacks, as one value: the API, the flags of the command line and the snapshot in every result.

Light, so that `--help` is fast: torch is imported when the budget is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from attacks.limits import SCHEDULES, NormName, Schedule, check_limits
from mi_splat.attributes import Attribute
from mi_splat.config_values import check_numbers, several
from mi_splat.errors import InvalidValueError, message

if TYPE_CHECKING:
    from attacks.budgets import Budget

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
