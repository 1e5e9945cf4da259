"""The two searches of DAGGER, both PGD: over fixed views all at once, and over a few drawn views at each step.

The second is resumable to the bit; some views, no others, judge every few of its steps (Athalye et al., "Synthesizing
Robust Adversarial Examples", ICML 2018).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence

from torch import Generator

from attacks.dagger.checkpoint import Checkpoint, KeptSearch, check_point, load_state, save_state
from attacks.dagger.config import DaggerConfig, EotConfig
from attacks.dagger.image_budget import ImagePrice, fitted, stretched
from attacks.dagger.problem import Problem
from attacks.dagger.views import View, ViewDistribution, batch_indices
from attacks.optimisers import adam, momentum
from attacks.pgd import Evaluation, Hooks, Judgement, Optimiser, Outcome, Parameters, SearchState, Step, pgd
from mi_splat.view_freezing import freeze_views

VALIDATION_SEED_OFFSET = 500_000_000
"""Added to the attack's seed for its validation views."""

OnStep = Callable[[Step], None]
"""Called with every line of the trace as it happens."""


def search_fixed(problem: Problem, views: Sequence[View], config: DaggerConfig, on_step: OnStep | None) -> Outcome:
    """Search over the pictures of fixed views, which judge every step themselves.

    Args:
        problem: The object, the detectors and the aim.
        views: All that are attacked.
        config: How to attack.
        on_step: Called with every line of the trace as it happens.

    Raises:
        BudgetError: The best point is outside the ball.
    """
    budget, generator = config.budget, Generator().manual_seed(config.seed)
    problem, reference = frozen(problem, views, config), problem.parameters(config.attributes)

    def starts() -> Iterator[Parameters]:
        for restart in range(config.restarts):
            yield budget.uniform(reference, generator) if restart or config.random_start else reference

    return pgd(
        lambda point: problem.evaluate(point, views, config),
        reference,
        budget,
        step=config.step,
        steps=config.steps,
        starts=starts(),
        optimiser=_momentum(config),
        early_stop=config.early_stop,
        hooks=Hooks(on_step=on_step),
    )


def frozen(problem: Problem, views: Sequence[View], config: DaggerConfig) -> Problem:
    """The problem with frozen views for a search with this configuration, if it changes SH alone."""
    if config.attributes != ("sh",):
        return problem
    made = freeze_views(
        problem.subset.scene,
        [view.camera for view in views],
        render=problem.render,
        pictures=len(problem.detectors) * config.restarts * (config.steps + 1),
        rows=problem.subset.rows,
    )
    return dataclasses.replace(problem, frozen=made)


def search_drawn(
    problem: Problem,
    views: ViewDistribution,
    config: EotConfig,
    *,
    key: str = "",
    checkpoint: Checkpoint | None = None,
    on_step: OnStep | None = None,
) -> tuple[Outcome, float]:
    """Search until the last step, or until enough validation views are deceived.

    A search whose checkpoint is there goes on from it, to the bits that it would have found without the break, on the
    same number of torch threads.

    Args:
        problem: Losses and verdicts.
        views: Where views are drawn from.
        config: How to attack.
        key: What tells this attack from others, for the checkpoint.
        checkpoint: Where to keep the search; None for nowhere.
        on_step: Called with every line of the trace as it happens.

    Returns:
        The best point, and the seconds of all runs.

    Raises:
        CheckpointError: The checkpoint is one of another attack.
        BudgetError: The best point is outside the ball.
    """
    clock, reference = time.perf_counter(), problem.parameters(config.attributes)
    kept = None if checkpoint is None else load_state(checkpoint.path, key=key)
    if kept is None:
        price = None if config.image_psnr is None else ImagePrice.of(config.image_psnr, steps=config.steps)
        begun, seconds = None, 0.0
    else:
        check_point(kept.search, reference, config.steps)
        begun, price, seconds = kept.search, kept.price, kept.seconds
    batches = _Batches(problem, views, config, 0 if begun is None else begun.optimiser.index, price)

    def keep(search: SearchState) -> None:
        if checkpoint is not None and search.optimiser.index % checkpoint.every == 0:
            spent = seconds + time.perf_counter() - clock
            save_state(KeptSearch(search=search, price=batches.price, seconds=spent), checkpoint.path, key=key)

    outcome = pgd(
        batches,
        reference,
        config.budget,
        step=config.step,
        steps=config.steps,
        optimiser=_momentum(config) if config.optimiser == "momentum" else _adam(config),
        early_stop=config.stop_at is not None,
        hooks=Hooks(
            judge=_judge(problem, views, config, reference),
            every=config.validate_every,
            on_step=on_step,
            on_state=keep,
        ),
        begun=begun,
    )
    return outcome, seconds + time.perf_counter() - clock


def _momentum(config: DaggerConfig | EotConfig) -> Optimiser:
    return momentum(decay=config.momentum, schedule=config.schedule, steps=config.steps, power=config.gradient_power)


def _adam(config: EotConfig) -> Optimiser:
    return adam(decay=config.momentum, schedule=config.schedule, steps=config.steps)


class _Batches:
    """Loss and gradients over the views of each step in turn; the price of their pictures' error follows it."""

    def __init__(
        self, problem: Problem, views: ViewDistribution, config: EotConfig, first: int, price: ImagePrice | None
    ) -> None:
        self._problem, self._views, self._config = problem, views, config
        self._index, self.price = first, price

    def __call__(self, point: Parameters) -> Evaluation:
        estimate = self._problem.estimate(point, self._batch(), 0.0 if self.price is None else self.price.now)
        self._index += 1
        if self.price is not None:
            self.price = self.price.after(estimate.error)
        return Evaluation(loss=estimate.loss, gradients=estimate.gradients)

    def _batch(self) -> list[View]:
        config = self._config
        numbers = batch_indices(self._index, seed=config.seed, batch=config.batch, pool=config.pool)
        return [self._views.view(config.seed, number, keep=config.pool > 0) for number in numbers]


def _judge(
    problem: Problem, views: ViewDistribution, config: EotConfig, reference: Parameters
) -> Callable[[Parameters], Judgement]:
    """The judge of a search: validation views, which look at what the image budget makes of a point."""
    validation = views.views(config.seed + VALIDATION_SEED_OFFSET, config.validation)
    limit = None if config.image_psnr is None else ImagePrice.of(config.image_psnr, steps=config.steps).limit
    stop_at = 2.0 if config.stop_at is None else config.stop_at

    def error(point: Parameters) -> float:
        return problem.error(point, validation)

    def judged(point: Parameters) -> tuple[float, Judgement]:
        """The share of views in which every detector is deceived, and what it says of the point."""
        rows = problem.verdicts(point, validation)
        whole, share = config.verdict(rows), sum(all(verdict.success for verdict in row) for row in rows) / len(rows)
        ended = whole.success and share >= stop_at - 1e-9
        return share, Judgement(point=point, success=whole.success, score=whole.score, unambiguous=ended)

    def judge(point: Parameters) -> Judgement:
        if limit is None:
            return judged(point)[1]
        within = fitted(point, reference, limit, error)
        share, nearer = judged(within)
        if within is not point or share == 1:
            return nearer
        farther = judged(stretched(point, reference, config.budget, limit, error))[1]
        return farther if farther.score > nearer.score else nearer

    return judge
