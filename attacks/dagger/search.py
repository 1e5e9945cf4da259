"""The search for a perturbation that holds over a distribution of views: PGD on mini-batches, resumable to the bit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from attacks.dagger.eot.checkpoint import SearchState, check_point, load_state, save_state
from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.image_budget import ImagePrice, fitted, stretched
from attacks.dagger.eot.problem import EotProblem, joined
from attacks.dagger.eot.views import DrawnView, ViewDistribution, batch_indices
from attacks.optimisers import START, AdamDescent, MomentumDescent
from attacks.pgd import Ball, Evaluation, Parameters, Step, Update, pgd, rank

NOT_JUDGED = -1.0
"""Score of a step that the validation views did not look at."""

VALIDATION_SEED_OFFSET = 500_000_000
"""Added to the attack's seed for its validation views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """Where a search is kept while it runs.

    Attributes:
        path: The file; removed when the search has ended.
        every: Steps between two writings.
    """

    path: Path
    every: int = 10


def search(
    problem: EotProblem,
    views: ViewDistribution,
    config: EotConfig,
    *,
    key: str = "",
    checkpoint: Checkpoint | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> SearchState:
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
        The state at the end; its `best` is the outcome.

    Raises:
        CheckpointError: The checkpoint is one of another attack.
        BudgetError: The best point is outside the ball.
    """
    reference, budget = problem.reference(config.attributes, config.sh_degree), config.budget
    begun = None if checkpoint is None else load_state(checkpoint.path, key=key)
    if begun is not None:
        check_point(begun, reference, config.steps)
    else:
        price = None if config.image_psnr is None else ImagePrice.of(config.image_psnr, steps=config.steps)
        begun = SearchState(
            point=reference, optimiser=START, best=reference, best_line=None, price=price, trace=(), seconds=0.0
        )
    update = _update(config, begun)
    run = _Run(problem, views, config, begun, update, on_step)
    if checkpoint is not None:
        run.keep(checkpoint, key)

    def same_memory(ball: Ball, step: object) -> Update:
        return update

    pgd(
        run.evaluate,
        reference,
        budget,
        step=config.step,
        steps=config.steps - begun.optimiser.index,
        starts=[begun.point],
        optimiser=same_memory,
        early_stop=config.stop_at is not None,
        on_step=run.note,
    )
    budget.check(run.best, reference)
    return run.state()


def _update(config: EotConfig, begun: SearchState) -> MomentumDescent | AdamDescent:
    """What makes the steps, with the memory of the state."""
    if config.optimiser == "adam":
        return AdamDescent(
            config.step, decay=config.momentum, schedule=config.schedule, steps=config.steps, state=begun.optimiser
        )
    return MomentumDescent(
        config.budget,
        config.step,
        decay=config.momentum,
        schedule=config.schedule,
        steps=config.steps,
        power=config.gradient_power,
        state=begun.optimiser,
    )


class _Run:
    """What a search has found so far, and what `pgd` asks of it."""

    def __init__(
        self,
        problem: EotProblem,
        views: ViewDistribution,
        config: EotConfig,
        begun: SearchState,
        update: MomentumDescent | AdamDescent,
        on_step: Callable[[Step], None] | None,
    ) -> None:
        self._problem, self._views, self._config = problem, views, config
        self._update, self._on_step = update, on_step
        self._checkpoint: Checkpoint | None = None
        self._key = ""
        self._first, self._earlier, self._clock = begun.optimiser.index, begun.seconds, time.perf_counter()
        self._trace, self.best, self._best_line = list(begun.trace), begun.best, begun.best_line
        self._point = self._judged = begun.point
        self._price = begun.price
        self._validation = views.views(config.seed + VALIDATION_SEED_OFFSET, config.validation)

    def keep(self, checkpoint: Checkpoint, key: str) -> None:
        """Write the search from now on."""
        self._checkpoint, self._key = checkpoint, key

    def state(self) -> SearchState:
        """The search as it stands."""
        return SearchState(
            point=self._point,
            optimiser=self._update.state,
            best=self.best,
            best_line=self._best_line,
            price=self._price,
            trace=tuple(self._trace),
            seconds=self._earlier + time.perf_counter() - self._clock,
        )

    def evaluate(self, point: Parameters) -> Evaluation:
        """Loss and gradients over the step's views; the verdict where the step is one of those that are judged."""
        self._point, config = point, self._config
        index = self._update.state.index
        kept = self._checkpoint
        if kept is not None and index > self._first and index % kept.every == 0:
            save_state(self.state(), kept.path, key=self._key)
        found = self._problem.loss(point, self._batch(index), 0.0 if self._price is None else self._price.now)
        if self._price is not None:
            self._price = self._price.after(found.error)
        loss, gradients = found.loss, found.gradients
        if (index == 0 or index % config.validate_every) and index != config.steps:
            return Evaluation(loss=loss, gradients=gradients, success=False, score=NOT_JUDGED, unambiguous=False)
        successes, score, self._judged = self._judge(point)
        share = successes / len(self._validation)
        enough = config.stop_at is not None and share >= config.stop_at - 1e-9
        success = share >= config.required_views - 1e-9
        return Evaluation(loss=loss, gradients=gradients, success=success, score=score, unambiguous=success and enough)

    def note(self, line: Step) -> None:
        """A line of the trace, numbered from the beginning of the search."""
        numbered = Step(
            index=self._first + line.index,
            loss=line.loss,
            score=line.score,
            success=line.success,
            unambiguous=line.unambiguous,
            zero_gradient_fraction=line.zero_gradient_fraction,
        )
        self._trace.append(numbered)
        judged = line.score != NOT_JUDGED
        if judged and (self._best_line is None or rank(numbered) > rank(self._best_line)):
            self.best, self._best_line = self._judged, numbered
        if self._on_step is not None:
            self._on_step(numbered)

    def _judge(self, point: Parameters) -> tuple[int, float, Parameters]:
        """Validation views that are deceived, the score, and the point judged: what the image budget makes of it."""

        def judged(one: Parameters) -> tuple[int, float, Parameters]:
            return (*joined(self._problem.verdicts(one, self._validation)), one)

        if self._price is None:
            return judged(point)

        def error(one: Parameters) -> float:
            return self._problem.error(one, self._validation)

        reference = self._problem.reference(self._config.attributes, self._config.sh_degree)
        within = fitted(point, reference, self._price.limit, error)
        found = judged(within)
        if within is not point or found[0] == len(self._validation):
            return found
        farther = judged(stretched(point, reference, self._config.budget, self._price.limit, error))
        return farther if farther[1] > found[1] else found

    def _batch(self, index: int) -> Sequence[DrawnView]:
        """The views of a step."""
        config = self._config
        numbers = batch_indices(index, seed=config.seed, batch=config.batch, pool=config.pool)
        return [self._views.view(config.seed, number, keep=config.pool > 0) for number in numbers]
