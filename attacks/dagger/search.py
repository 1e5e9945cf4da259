"""The search of DAGGER: over all chosen cameras at each step, or over a few views of a
region.

Of a region other views decide which step was best (expectation over transformation,
Athalye et al., "Synthesizing Robust Adversarial Examples", ICML 2018).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from torch import Generator

from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.views import FixedViews
from attacks.objectives.verdicts import overall_verdict
from attacks.optimisers.methods import SearchSettings
from attacks.search.budget import Budget
from attacks.search.loop import (
    Evaluation,
    Hooks,
    Optimiser,
    Outcome,
    Step,
    Verdict,
    pgd,
)
from attacks.search.parameters import Parameters

# A budget in images: an attack may keep their PSNR above a limit.
#
# A ball in the units of a file says little about what one sees: the same radius costs
# few decibels on a hidden Gaussian and many on the bonnet. With a limit on the images
# the attacker pays for their squared error. The price is a Lagrange multiplier, which
# is raised while the images are worse than the limit, and lowered while they are
# better. A point that is worse than the limit is pulled towards the clean object before
# it may become the result; one that is better and does not deceive everywhere may be
# stretched up to the limit. Where the limit is of the object's pixels, every point is
# judged at the limit, so that attacks of one limit change the object by the same.

_DECAY = 0.8
"""Share of the earlier errors in the decaying mean that the price follows."""

_GAIN = 20.0
_LOWEST = 0.02
_HIGHEST = 100.0
"""Change of the price's logarithm over a whole search whose error is e times the limit;
bounds of the price in units of 1 / limit.
"""

_HALVINGS = 7
"""Of the interval in which the factor of a perturbation is looked for."""

_ROUNDING = 1 / (6 * 255**2)
"""Squared error that 8 bits add to the difference of two images: each has 1/12 of a
squared step.
"""

_LOOKS = 6
_AIM = 0.995
_CLOSE = 0.985
"""Factors that are tried of a perturbation that shall be at a limit; shares of the
limit that its error is aimed at, and from which it is there: 0.07 dB.
"""

_FARTHEST = 1.5
"""Largest factor by which a perturbation is stretched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagePrice:
    """What the mean squared error of the images costs the attacker."""

    limit: float  # largest mean squared error wanted, values in [0, 1]
    # the multiplier: the loss is the detectors' plus `weight` times the error
    weight: float
    # change of the weight's logarithm in a step whose error is e times the limit
    gain: float
    # decaying mean of the errors so far; None before the first step
    error: float | None = None

    @classmethod
    def of(cls, config: DaggerConfig) -> ImagePrice | None:
        """The price at the beginning of a search, where an error at the limit costs 1;
        None without a limit.
        """
        if config.object_psnr is not None:
            seen = 10 ** (-config.object_psnr / 10)
            limit = max(seen - _ROUNDING, seen / 2)
        elif config.image_psnr is not None:
            limit = 10 ** (-config.image_psnr / 10)
        else:
            return None
        return cls(limit=limit, weight=1 / limit, gain=_GAIN / config.steps)

    @property
    def now(self) -> float:
        """What an error costs in the next step: more than the weight while errors are
        above the limit.

        The weight alone follows the errors late, so that these would swing about the
        limit.
        """
        return self.weight * max(1.0, (self.error or 0.0) / self.limit)

    def after(self, error: float) -> ImagePrice:
        """The price after a step whose images had a mean squared error."""
        if self.error is None:
            mean = error
        else:
            mean = _DECAY * self.error + (1 - _DECAY) * error
        excess = math.log(mean / self.limit) if mean > 0 else -1.0
        weight = self.weight * math.exp(self.gain * max(-1.0, min(1.0, excess)))
        bounded = max(_LOWEST, min(_HIGHEST, weight * self.limit)) / self.limit
        return dataclasses.replace(self, weight=bounded, error=mean)


def fitted(
    parameters: Parameters,
    reference: Parameters,
    limit: float,
    error: Callable[[Parameters], float],
) -> Parameters:
    """The parameters, or the farthest point on the way to them from the reference whose
    error is within the limit.
    """
    if error(parameters) <= limit:
        return parameters
    low = 0.0
    high = 1.0
    farthest = reference
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        point = _scaled(parameters, reference, middle)
        if error(point) <= limit:
            low = middle
            farthest = point
        else:
            high = middle
    return farthest


def stretched(
    parameters: Parameters,
    reference: Parameters,
    ball: Budget,
    limit: float,
    error: Callable[[Parameters], float],
) -> Parameters:
    """The farthest point beyond parameters on the line from the reference whose error
    is within the limit.
    """
    farther = _scaled(parameters, reference, _FARTHEST)

    def inside(point: Parameters) -> float:
        return error(ball.project(point, reference))

    return ball.project(fitted(farther, reference, limit, inside), reference)


def at_limit(
    parameters: Parameters,
    reference: Parameters,
    ball: Budget,
    limit: float,
    error: Callable[[Parameters], float],
) -> Parameters:
    """The point on the line from the reference through the parameters whose error is
    the limit, or slightly less.

    An error grows about with the square of the change, which gives the next factor.
    """
    factor = 1.0
    point = parameters
    for _ in range(_LOOKS):
        here = error(point)
        if here == 0 or _CLOSE * limit <= here <= limit:
            return point
        factor *= min(3.0, max(0.3, math.sqrt(_AIM * limit / here)))
        point = ball.project(_scaled(parameters, reference, factor), reference)
    return fitted(point, reference, limit, error)


def _scaled(parameters: Parameters, reference: Parameters, factor: float) -> Parameters:
    """The point whose difference from the reference is that of the parameters times a
    factor.
    """
    return {
        name: base + factor * (parameters[name] - base)
        for name, base in reference.items()
    }


OnStep = Callable[[Step], bool | None]
"""Called with every line of the trace as it happens; once it says so, the search ends
with the best point so far.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """What one level of a ladder has led to.

    Attributes:
        object_psnr: PSNR of the object's pixels, dB.
        success: Whether the attack succeeds in enough of the views that decide.
        score: How near it is, in [0, 1].
        steps: Steps that were taken.
    """

    object_psnr: float
    success: bool
    score: float
    steps: int


def climb(
    problem: Problem,
    views: FixedViews,
    config: DaggerConfig,
    on_step: OnStep | None = None,
) -> tuple[Outcome, DaggerConfig, tuple[Level, ...]]:
    """The best point of the first level of a ladder that succeeds, the configuration of
    that level, and what each level has led to; without a ladder the best point of all.
    """
    levels = list[Level]()
    outcome: Outcome | None = None
    for number, at_level in enumerate(config.levels):
        start = None if outcome is None else outcome.parameters
        after = search(problem, views, at_level, on_step, start=start)
        after = _numbered(after, number)
        trace = after.trace if outcome is None else (*outcome.trace, *after.trace)
        outcome = dataclasses.replace(after, trace=trace)
        if config.ladder:
            assert at_level.object_psnr is not None  # as `DaggerConfig.levels` says
            level = Level(
                object_psnr=at_level.object_psnr,
                success=after.best.success,
                score=after.best.score,
                steps=after.trace[-1].index,
            )
            levels.append(level)
        if after.best.success or after.stopped:
            break
    assert outcome is not None  # there is at least one level
    answer = dataclasses.replace(config, object_psnr=at_level.object_psnr)
    return outcome, answer, tuple(levels)


def _numbered(outcome: Outcome, number: int) -> Outcome:
    """The outcome of a level, whose lines of the trace are of a run of its own."""
    if number == 0:
        return outcome
    trace = tuple(dataclasses.replace(line, restart=number) for line in outcome.trace)
    best = dataclasses.replace(outcome.best, restart=number)
    return dataclasses.replace(outcome, trace=trace, best=best)


def search(
    problem: Problem,
    views: FixedViews,
    config: DaggerConfig,
    on_step: OnStep | None = None,
    *,
    start: Parameters | None = None,
) -> Outcome:
    """The best point: where each step takes all views, these decide about it, otherwise
    the validation views do.
    """
    if config.attributes == ("sh",):
        problem = dataclasses.replace(problem, frozen=views.frozen(config))
    if not config.sequential:
        return _searched(problem, views, config, start, on_step)
    outcome: Outcome | None = None
    for view in views.one_by_one(config):
        start = None if outcome is None else outcome.parameters
        after = _searched(problem, view, config, start, on_step)
        if outcome is None:
            outcome = after
        else:
            outcome = dataclasses.replace(after, trace=(*outcome.trace, *after.trace))
    assert outcome is not None  # as `FixedViews` has seen to
    return outcome


def _searched(
    problem: Problem,
    views: FixedViews,
    config: DaggerConfig,
    start: Parameters | None,
    on_step: OnStep | None,
) -> Outcome:
    reference = problem.subset.parameters(config.attributes)
    steps = itertools.count()
    price = ImagePrice.of(config)

    def evaluate(point: Parameters) -> Evaluation:
        """Loss and gradients over the views of the next step; the price of their
        images' error follows it.
        """
        nonlocal price
        batch = views.attacked(next(steps), config)
        costs = 0.0 if price is None else price.now
        here = problem.evaluate(point, batch, config, price=costs, judged=judge is None)
        price = price and price.after(here.error)
        return here

    if config.batch or price is not None:
        judge = _judge(problem, views, config, reference)
    else:
        judge = None
    return pgd(
        evaluate,
        reference,
        config.budget,
        steps=config.steps,
        optimiser=_optimiser(config, problem),
        starts=_starts(config, reference, start),
        early_stop=(
            config.early_stop
            if views.transformations is None
            else config.stop_at is not None
        ),
        smallest=config.spec.smallest,
        hooks=Hooks(
            judge=judge,
            every=config.validate_every,
            start=config.object_psnr is not None,
            on_step=on_step,
        ),
    )


def _starts(
    config: DaggerConfig, reference: Parameters, start: Parameters | None
) -> Iterator[Parameters]:
    """The points at which runs begin."""
    generator = Generator().manual_seed(config.seed)
    if start is not None:
        yield start
        return
    for restart in range(config.restarts):
        yield (
            config.budget.uniform(reference, generator)
            if restart or config.random_start
            else reference
        )


def _optimiser(config: DaggerConfig, problem: Problem) -> Optimiser:
    """The optimiser of a configuration, made for the object."""
    subset = problem.subset
    spec = config.spec
    return spec.make(
        SearchSettings(
            ball=config.budget,
            reference=subset.parameters(config.attributes),
            positions=subset.clean["means"],
            step=config.step,
            steps=config.steps,
            momentum=spec.momentum if config.momentum is None else config.momentum,
            schedule=config.schedule,
            power=config.gradient_power,
            seed=config.seed,
        )
    )


def _judge(
    problem: Problem, views: FixedViews, config: DaggerConfig, reference: Parameters
) -> Callable[[Parameters], tuple[Parameters, Verdict]]:
    """The judge of a search: validation views, which look at what the image budget
    makes of a point.
    """
    validation = views.validation(config)
    drawn = views.transformations is not None
    price = ImagePrice.of(config)
    limit = None if price is None else price.limit
    stop_at = 2.0 if config.stop_at is None else config.stop_at

    def error(point: Parameters) -> float:
        return problem.error(point, validation)

    def verdict_on(point: Parameters) -> tuple[float, Verdict]:
        """The share of views in which every detector is deceived, and what it says of
        the point.
        """
        rows = problem.verdicts(point, validation)
        whole = overall_verdict(rows, config.required_views, drawn=drawn)
        share = sum(all(one.success for one in row) for row in rows) / len(rows)
        enough = whole.success and share >= stop_at - 1e-9
        return share, dataclasses.replace(whole, unambiguous=enough) if drawn else whole

    def judge(point: Parameters) -> tuple[Parameters, Verdict]:
        if limit is None:
            return point, verdict_on(point)[1]
        if problem.on_object:
            scaled = at_limit(point, reference, config.budget, limit, error)
            return scaled, verdict_on(scaled)[1]
        within = fitted(point, reference, limit, error)
        share, verdict = verdict_on(within)
        if within is not point or share == 1:
            return within, verdict
        farther = stretched(point, reference, config.budget, limit, error)
        _, beyond = verdict_on(farther)
        if beyond.score > verdict.score:
            return (farther, beyond)
        return (within, verdict)

    return judge
