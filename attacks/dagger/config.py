"""How DAGGER attacks, as one value: the API, the flags of the command line and the snapshot in every result.

Light, so that `--help` is fast: torch is imported when the budget is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from attacks.limits import NormName, Radius, Schedule
from attacks.optimisers.registry import OptimiserSpec, optimiser_spec
from mi_splat.attributes import Attribute
from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Count,
    Degree,
    Fraction,
    Metavar,
    PositiveFraction,
    Seed,
    Share,
    Steps,
    above,
    at_least,
    check,
)

if TYPE_CHECKING:
    from attacks.budgets import Budget
    from attacks.search import Verdict

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
        optimiser: How the next point is chosen: pgd, fgsm, momentum, adam, apgd, cw (with a price of the change),
            square and random (without gradients), or the name of another that was registered.
        momentum: Share of the earlier gradients that is kept at each step, in [0, 1); None is the optimiser's own, 0 of
            pgd.
        schedule: How the steps become shorter (pgd, momentum, adam).
        gradient_power: Power of the gradients' absolute values before a step of pgd or momentum, in [0, 1]; below 1,
            small ones count for more (see `attacks.optimisers.descent.momentum`).
        required_views: Fraction of the views in which the attack has to succeed.
        noise_draws: Draws of random noise of the same size, as a control.
        sh_degree: SH degree of the attacked file, if SH may change.
        seed: Seed of everything random.

    Raises:
        InvalidValueError: A value is out of its range, or there are not as many radii as attributes.
    """

    attributes: tuple[Attribute, ...] = ("sh",)
    eps: tuple[Radius, ...] = (5.0,)
    norm: NormName = "l2"
    steps: Steps = 11
    step_factor: Annotated[float, above(0, do="2 is the paper's"), Metavar("FACTOR")] = 2.0
    optimiser: Annotated[str, Metavar("OPTIMISER")] = "pgd"
    momentum: Share | None = None
    schedule: Schedule = "constant"
    gradient_power: Fraction = 1.0
    required_views: PositiveFraction = 1.0
    noise_draws: Count = 5
    sh_degree: Degree | None = 3
    seed: Seed = 0

    def __post_init__(self) -> None:
        check(self)
        optimiser_spec(self.optimiser)
        if not self.attributes:
            raise InvalidValueError.of("attributes", "at least one", "none", "say what may change")
        if len(self.eps) not in (1, len(self.attributes)) or len(set(self.attributes)) != len(self.attributes):
            expected = f"one number for all of {', '.join(self.attributes)}, or one for each"
            raise InvalidValueError.of("eps", expected, self.eps, "name every attribute once")

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
    def spec(self) -> OptimiserSpec:
        """The optimiser."""
        return optimiser_spec(self.optimiser)

    @property
    def budget(self) -> Budget:
        """Radius and norm as one value."""
        from attacks.budgets import Budget

        return Budget(radius=self.radius, norm=self.norm)


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig(Perturbation):
    """How to attack fixed views; see also `Perturbation`. The defaults are those of the paper's text.

    Attributes:
        restarts: Number of runs; the first starts at the clean object, the others at random points of the ball.
        random_start: Start the first run at a random point of the ball, too.
        early_stop: Whether the first unambiguous success ends the search; without, every step of every run is taken.
        required_detectors: Fraction of the detectors, if there are several, that the attack has to deceive.
        alone: Whether the search looks at the object alone, on the renderer's background, as the paper's code does.
            What it finds is judged in the scene all the same.
        in_turn: Whether several cameras are attacked one after the other, each from where the one before has ended, as
            in the paper's code; otherwise all at once.
        ensemble: Loss over several detectors: the mean of theirs, or that of the one that resists most.
        sh_degree: SH degree of the attacked file, if SH may change and the scene has less; coefficients that it lacks
            start at 0. 3 is what 3DGS writes and what the paper attacked; None keeps the scene's own.
        seed: Seed of everything random: starting points and the noise control.
    """

    restarts: Annotated[int, at_least(1)] = 1
    random_start: bool = False
    early_stop: bool = True
    alone: bool = False
    in_turn: bool = False
    required_detectors: PositiveFraction = 1.0
    ensemble: EnsembleLoss = "mean"

    def verdict(self, rows: Sequence[Sequence[Verdict]]) -> Verdict:
        """Success with enough detectors, each in enough views, and the score that so many reach.

        Args:
            rows: For each detector, its verdicts of all views.

        Returns:
            One verdict of all views and detectors.
        """
        from attacks.objectives import joint_verdict

        each = [joint_verdict(verdicts, self.required_views) for verdicts in zip(*rows, strict=True)]
        return joint_verdict(each, self.required_detectors)


@dataclass(frozen=True, slots=True, kw_only=True)
class EotConfig(Perturbation):
    """How to attack a distribution of views (EOT); see also `Perturbation`.

    The defaults were tuned on a few pairs of the example scenes (see docs/dagger-eot.md).

    Attributes:
        step_factor: The first step is eps * step_factor / steps long.
        batch: Views drawn for each step.
        pool: Number of views that they are drawn from; 0 draws new ones at each step.
        validation: Views, no others, that decide which step was best.
        validate_every: Steps between two such decisions.
        stop_at: Fraction of the validation views whose success ends the search; None takes every step.
        required_views: Fraction of the held-out views in which the attack has to succeed.
        held_out: Number of held-out views that judge the result.
        sh_degree: Highest degree of the SH coefficients that may change, if SH may; the file gets it if it has less.
            0 changes a Gaussian's colour by the same from everywhere. None keeps the scene's own.
        image_psnr: PSNR that the pictures keep, dB, over the validation views; None asks for nothing. The search then
            pays for the pictures' squared error (`attacks.dagger.search`); the ball is a second bound.
        seed: Seed of the attack's views, of its validation views, and of the noise.
        judge_seed: Seed of the held-out views; another one.

    Raises:
        InvalidValueError: As in `Perturbation`, or the judge would look at the attack's views.
    """

    eps: tuple[Radius, ...] = (1.0,)
    norm: NormName = "linf"
    steps: Steps = 150
    step_factor: Annotated[float, above(0), Metavar("FACTOR")] = 13.0
    optimiser: Annotated[str, Metavar("OPTIMISER")] = "adam"
    momentum: Share | None = 0.8
    schedule: Schedule = "linear"
    required_views: PositiveFraction = 0.8
    noise_draws: Count = 1
    sh_degree: Degree | None = 1
    batch: Annotated[int, at_least(1, "views")] = 3
    pool: Annotated[int, at_least(0, "views", "0 draws new ones at each step")] = 200
    validation: Annotated[int, at_least(1, "views")] = 12
    validate_every: Steps = 50
    stop_at: PositiveFraction | None = None
    held_out: Annotated[int, at_least(1, "views")] = 60
    judge_seed: Seed = 1000
    image_psnr: Annotated[float, above(0, "dB", "26 is easily seen, 40 hardly")] | None = 26.3

    def __post_init__(self) -> None:
        Perturbation.__post_init__(self)
        if self.judge_seed == self.seed:
            raise InvalidValueError.of("judge_seed", "another seed than the attack's", self.seed, "change one")

    @property
    def required_detectors(self) -> float:
        """Fraction of the detectors that have to be deceived in a view: all."""
        return 1.0

    def verdict(self, rows: Sequence[Sequence[Verdict]]) -> Verdict:
        """Success where every detector is deceived in enough views; the score orders by the number of these views.

        Between equals it orders by the mean of the verdicts' scores.

        Args:
            rows: For each detector, its verdicts of all views.

        Returns:
            One verdict of all views and detectors.
        """
        from attacks.search import Verdict

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
