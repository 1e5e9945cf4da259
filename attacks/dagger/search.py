"""The two searches of DAGGER, one loop: over fixed views all at once, and over a few drawn views at each step.

The second is resumable to the bit; some views, no others, judge every few of its steps (Athalye et al., "Synthesizing
Robust Adversarial Examples", ICML 2018).
"""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

from torch import Generator

from attacks.dagger.checkpoint import Checkpoint, KeptSearch, check_point, load_state, save_state
from attacks.dagger.config import Config, DaggerConfig, EotConfig
from attacks.dagger.image_budget import ImagePrice, fitted, stretched
from attacks.dagger.problem import Problem
from attacks.dagger.views import View, ViewDistribution, batch_indices
from attacks.optimisers.settings import SearchSettings
from attacks.search import Evaluation, Hooks, Optimiser, Outcome, Parameters, SearchState, Step, Verdict, pgd
from mi_splat.view_freezing import freeze_views

VALIDATION_SEED_OFFSET = 500_000_000
"""Added to the attack's seed for its validation views."""

OnStep = Callable[[Step], bool | None]
"""Called with every line of the trace as it happens; once it says so, the search ends with the best point so far."""


def search_fixed(problem: Problem, views: Sequence[View], config: DaggerConfig, on_step: OnStep | None) -> Outcome:
    """Search over the pictures of fixed views, jointly or one after the other, which judge every step."""
    budget, generator = config.budget, Generator().manual_seed(config.seed)
    problem, reference = frozen(problem, views, config), problem.subset.parameters(config.attributes)

    def starts() -> Iterator[Parameters]:
        for restart in range(config.restarts):
            yield budget.uniform(reference, generator) if restart or config.random_start else reference

    def search(views: Sequence[View], starts: Iterable[Parameters]) -> Outcome:
        return pgd(
            lambda point: problem.evaluate(point, views, config),
            reference,
            budget,
            steps=config.steps,
            optimiser=_optimiser(config, problem),
            starts=starts,
            early_stop=config.early_stop,
            smallest=config.spec.smallest,
            hooks=Hooks(on_step=on_step),
        )

    first, *others = [[view] for view in views] if config.in_turn else [views]
    outcome = search(first, starts())
    for view in others:
        after = search(view, [outcome.parameters])
        outcome = dataclasses.replace(after, trace=(*outcome.trace, *after.trace))
    return outcome


def frozen(problem: Problem, views: Sequence[View], config: DaggerConfig) -> Problem:
    """The problem with frozen views for a search with this configuration, if it changes SH alone."""
    if config.attributes != ("sh",):
        return problem
    made = freeze_views(
        problem.subset.scene,
        [view.camera for view in views],
        render=problem.render,
        pictures=config.restarts * (config.steps + 1),
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
    """
    clock, reference = time.perf_counter(), problem.subset.parameters(config.attributes)
    device = problem.subset.scene.means.device
    kept = None if checkpoint is None else load_state(checkpoint.path, key=key, device=device)
    if kept is None:
        price = None if config.image_psnr is None else ImagePrice.of(config.image_psnr, steps=config.steps)
        kept = KeptSearch(search=SearchState.at(reference), price=price, seconds=0.0)
    check_point(kept.search, reference, config.steps)
    index, price, seconds = kept.search.optimiser.index, kept.price, kept.seconds

    def evaluate(point: Parameters) -> Evaluation:
        """Loss and gradients over the views of the next step; the price of their pictures' error follows it."""
        nonlocal index, price
        numbers = batch_indices(index, seed=config.seed, batch=config.batch, pool=config.pool)
        batch = [views.view(config.seed, number, keep=config.pool > 0) for number in numbers]
        evaluation, error = problem.estimate(point, batch, config, 0.0 if price is None else price.now)
        index, price = index + 1, price and price.after(error)
        return evaluation

    def keep(search: SearchState) -> None:
        if checkpoint is not None and search.optimiser.index % checkpoint.every == 0:
            spent = seconds + time.perf_counter() - clock
            save_state(KeptSearch(search=search, price=price, seconds=spent), checkpoint.path, key=key)

    judge = _judge(problem, views, config, reference)
    outcome = pgd(
        evaluate,
        reference,
        config.budget,
        steps=config.steps,
        optimiser=_optimiser(config, problem),
        starts=kept.search,
        early_stop=config.stop_at is not None,
        smallest=config.spec.smallest,
        hooks=Hooks(judge=judge, every=config.validate_every, on_step=on_step, on_state=keep),
    )
    return outcome, seconds + time.perf_counter() - clock


def _optimiser(config: Config, problem: Problem) -> Optimiser:
    """The optimiser of a configuration, made for the object."""
    subset, spec = problem.subset, config.spec
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
    problem: Problem, views: ViewDistribution, config: EotConfig, reference: Parameters
) -> Callable[[Parameters], tuple[Parameters, Verdict]]:
    """The judge of a search: validation views, which look at what the image budget makes of a point."""
    validation = views.views(config.seed + VALIDATION_SEED_OFFSET, config.validation)
    limit = None if config.image_psnr is None else ImagePrice.of(config.image_psnr, steps=config.steps).limit
    stop_at = 2.0 if config.stop_at is None else config.stop_at

    def error(point: Parameters) -> float:
        return problem.error(point, validation)

    def verdict_on(point: Parameters) -> tuple[float, Verdict]:
        """The share of views in which every detector is deceived, and what it says of the point."""
        rows = problem.verdicts(point, validation)
        whole, share = config.verdict(rows), sum(all(verdict.success for verdict in row) for row in rows) / len(rows)
        return share, dataclasses.replace(whole, unambiguous=whole.success and share >= stop_at - 1e-9)

    def judge(point: Parameters) -> tuple[Parameters, Verdict]:
        if limit is None:
            return point, verdict_on(point)[1]
        within = fitted(point, reference, limit, error)
        share, verdict = verdict_on(within)
        if within is not point or share == 1:
            return within, verdict
        farther = stretched(point, reference, config.budget, limit, error)
        _, beyond = verdict_on(farther)
        return (farther, beyond) if beyond.score > verdict.score else (within, verdict)

    return judge
