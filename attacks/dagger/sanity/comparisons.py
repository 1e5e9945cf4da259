"""Checks that compare attacks which a sane attack must order in one way.

After Athalye et al., "Obfuscated Gradients Give a False Sense of Security" (ICML 2018), and Carlini et al., "On
Evaluating Adversarial Robustness" (2019). Scores count up to the one that is a success, since a search that has it may
stop.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch

from attacks.dagger.sanity.finding import Finding
from attacks.dagger.sanity.runs import Runs, Scored
from attacks.gaussian_subset import GaussianSubset
from attacks.pgd import rank
from mi_splat.scene import ATTRIBUTES

SCALES = (0.0, 1 / 16, 1 / 4, 1.0, 4.0)
"""Radii of the curve, as multiples of the case's."""

COMPARED = (1 / 4, 1.0)
"""Radii at which two attacks are compared: a small one, where not everything succeeds, and the case's."""

SCORE_SLACK = 0.05
"""How much lower a mean score may be and still count as no lower: a search takes its steps in different places."""

UNBOUNDED = 1000.0
"""Multiple of the radius at which the ball does not bind."""

NOISE_DRAWS = 3
"""Draws of random noise for each seed."""

FOUND = 0.5
"""Confidence from which the clean object counts as found."""


def clean(runs: Runs) -> Finding:
    """Before the attack the detector finds the object, at `FOUND` or more, and not the target."""
    label = runs.case.objective.label
    views = [view for result in runs.results(noise_draws=NOISE_DRAWS) for view in result.views]
    found = [view.confidence(view.before.target.original, attacked=False) for view in views]
    wanted = [view.confidence(label, attacked=False) for view in views]
    return Finding(
        name="clean",
        claim="starts where the object is found and the target is not",
        passed=min(found) >= FOUND and max(wanted) < runs.case.objective.confidence,
        figures=f"object at {_list(found)}, {label} at {_list(wanted)}",
        meaning="there is nothing to attack: success and failure say little",
        values={"object": found, "target": wanted},
    )


def budget(runs: Runs) -> Finding:
    """Every attack stays in its ball and leaves other Gaussians alone, measured on the scenes that came of it."""
    case, share, strangers = runs.case, 0.0, 0
    for config, result in runs.made:
        before = GaussianSubset.of(case.scene.with_degree(max(result.scene.degree, case.scene.degree)), case.mask)
        after = GaussianSubset.of(result.scene, case.mask)
        size = config.budget.measure(after.parameters(config.attributes), before.parameters(config.attributes))
        for name, radius in config.radius.items():
            share = max(share, size[name] / radius if radius else 2.0 * (size[name] > 0))
        moved = {
            row for name in ATTRIBUTES for row in _changed(getattr(result.scene, name), getattr(before.scene, name))
        }
        strangers += len(moved - set(after.rows.tolist()))
    return Finding(
        name="budget",
        claim="stays in its ball and changes no other Gaussian",
        passed=share <= 1 + 1e-6 and not strangers,
        figures=f"at most {share:.4f} of the radius in {len(runs.made)} attacks; {strangers} other Gaussians changed",
        meaning="the attack takes more than it was given, so that its successes are worth nothing",
        values={"largest_share": share, "other_gaussians_changed": strangers, "attacks": len(runs.made)},
    )


def _changed(after: torch.Tensor, before: torch.Tensor) -> list[int]:
    rows: list[int] = torch.nonzero((after != before).reshape(len(after), -1).any(-1))[:, 0].tolist()
    return rows


def radius(runs: Runs) -> Finding:
    """Success rises with the radius, from none without one to everything; between neighbours one run may be lost."""
    found = [runs.results(scale, **_settings(scale)) for scale in SCALES]
    counts, scores = [_count(some) for some in found], [runs.mean(some) for some in found]
    rises = all(
        after >= before - 1 and score >= last - SCORE_SLACK
        for (before, after), (last, score) in zip(itertools.pairwise(counts), itertools.pairwise(scores), strict=True)
    )
    total = len(runs.case.cameras)
    radii = [scale * runs.case.config.eps[0] for scale in SCALES]
    return Finding(
        name="radius",
        claim="succeeds more often in larger balls, never in one of radius 0, always in a large one",
        passed=rises and counts[0] == 0 and counts[-1] == total,
        figures="; ".join(
            f"eps {eps:g}: {count}/{total} (mean score {score:.2f})"
            for eps, count, score in zip(radii, counts, scores, strict=True)
        ),
        meaning="the attack ignores its budget, or its search fails before the budget is used up",
        values={"eps": radii, "successes": counts, "scores": scores, "runs": total},
    )


def _settings(scale: float) -> dict[str, Any]:
    """The case's own radius shares its runs with the noise control; without a radius one step is as good as many."""
    return {"noise_draws": NOISE_DRAWS if scale == 1 else 0, **({} if scale else {"steps": 1})}


def iterative(runs: Runs) -> Finding:
    """Many steps reach no less than one step as long as the radius."""
    many = [one for scale in COMPARED for one in runs.results(scale, **_settings(scale))]
    single = [one for scale in COMPARED for one in runs.results(scale, noise_draws=0, steps=1, step_factor=1.0)]
    return _compared(
        runs,
        "iterative",
        (many, "many steps"),
        (single, "one step"),
        claim="does at least as well in many steps as in one",
        meaning="steps are too long or too short, or lead astray",
    )


def white_box(runs: Runs) -> Finding:
    """An attack on the detector reaches no less than one on another detector."""
    name = "white_box"
    claim, meaning = "does at least as well as one on another detector", "gradients are masked: use another loss"
    if runs.case.surrogate is None:
        return Finding(name=name, claim=claim, passed=None, figures="no surrogate", meaning=meaning, values={})
    own = runs.results(noise_draws=NOISE_DRAWS)
    moved = runs.judged(runs.results(detector=runs.case.surrogate, noise_draws=0, early_stop=False))
    other = f"attack on {runs.case.surrogate.name}"
    return _compared(runs, name, (own, "white box"), (moved, other), claim=claim, meaning=meaning)


def random_search(runs: Runs) -> Finding:
    """Gradients are never beaten by random points, for as many looks; where neither succeeds, by the loss."""
    own = [one for scale in COMPARED for one in runs.results(scale, **_settings(scale))]
    drawn = [one for scale in COMPARED for one in runs.random_search(scale)]
    losses = [min(line.loss for line in result.trace) for result in own]
    beaten = sum(
        not result.success and (other.success or other.loss < loss)
        for result, loss, other in zip(own, losses, drawn, strict=True)
    )
    means = [sum(some) / len(own) for some in (losses, [line.loss for line in drawn])]
    return Finding(
        name="random_search",
        claim="does at least as well as a random search that looks as often",
        passed=not beaten,
        figures=f"beaten in {beaten} of {len(own)} runs; with gradients {_count(own)}/{len(own)} (mean loss "
        f"{means[0]:.2f}), random search {_count(drawn)}/{len(drawn)} ({means[1]:.2f})",
        meaning="gradients are masked or wrong",
        values={
            "beaten": beaten,
            "runs": len(own),
            "successes": {"gradient": _count(own), "random_search": _count(drawn)},
            "loss": {"gradient": means[0], "random_search": means[1]},
        },
    )


def noise(runs: Runs) -> Finding:
    """Random noise of the attack's size succeeds less often than the attack."""
    own = runs.results(noise_draws=NOISE_DRAWS)
    draws = sum(len(result.noise.scores) for result in own)
    lucky, count = sum(result.noise.successes for result in own), _count(own)
    return Finding(
        name="noise",
        claim="succeeds more often than random noise of its size",
        passed=count / len(own) > lucky / draws,
        figures=f"attack {count}/{len(own)}, noise {lucky}/{draws}",
        meaning="it is the size of the change that counts, and not the attack",
        values={"successes": count, "runs": len(own), "noise_successes": lucky, "noise_draws": draws},
    )


def more_steps(runs: Runs) -> Finding:
    """A search that goes on after half of its steps keeps the best point, and the scene is that point."""
    config, scale = runs.case.config, COMPARED[0]
    half = max(1, config.steps // 2)
    long = runs.results(scale, noise_draws=0, early_stop=False)
    short = runs.results(
        scale, noise_draws=0, early_stop=False, steps=half, step_factor=config.step_factor * half / config.steps
    )
    worse = sum(rank(after.best) < rank(before.best) for before, after in zip(short, long, strict=True))
    passed_over = sum(any(rank(line) > rank(result.best) for line in result.trace) for _, result in runs.made)
    apart = max(abs(result.score - result.best.score) for result in (*short, *long))
    return Finding(
        name="more_steps",
        claim="is never worse for going on, and keeps its best point",
        passed=not worse and not passed_over and apart <= SCORE_SLACK,
        figures=f"{worse} of {len(long)} worse after {config.steps} steps than after {half}; {passed_over} of "
        f"{len(runs.made)} attacks passed over a better point; file and search differ by {apart:.3f} in score",
        meaning="the search throws away what it had, or the file is not what the search has found",
        values={"worse": worse, "passed_over": passed_over, "score_difference": apart, "steps": [half, config.steps]},
    )


def unbounded(runs: Runs) -> Finding:
    """Without a bound, and with steps as long as before, everything succeeds."""
    config = runs.case.config
    steps = 4 * config.steps
    free = runs.results(
        UNBOUNDED,
        noise_draws=0,
        steps=steps,
        step_factor=config.step_factor * steps / (config.steps * UNBOUNDED),
        random_start=False,  # a random point of so large a ball is far from everything
    )
    share = max(result.used[name] / radius for result in free for name, radius in result.config.radius.items())
    return Finding(
        name="unbounded",
        claim="always succeeds where no ball binds it",
        passed=_count(free) == len(free) and share < 1,
        figures=f"{_count(free)}/{len(free)} within {steps} steps; it used {share * UNBOUNDED:.1f} times the radius",
        meaning="the loss does not lead to success, whatever the budget",
        values={"successes": _count(free), "runs": len(free), "share": share, "steps": [r.best.index for r in free]},
    )


def _compared(
    runs: Runs,
    name: str,
    better: tuple[Sequence[Scored], str],
    worse: tuple[Sequence[Scored], str],
    *,
    claim: str,
    meaning: str,
) -> Finding:
    """Whether one kind of run has no fewer successes and no lower mean score than another.

    Args:
        runs: The attacks.
        name: Name of the check.
        better: Runs that have to be no worse, and what they are called.
        worse: The others.
        claim: As in `Finding`.
        meaning: As in `Finding`.
    """
    pairs = (better, worse)
    (count, other_count), (score, other_score) = ([of(some) for some, _ in pairs] for of in (_count, runs.mean))
    said = [f"{words} {_count(some)}/{len(some)} (mean score {runs.mean(some):.2f})" for some, words in pairs]
    return Finding(
        name=name,
        claim=claim,
        passed=count >= other_count and score >= other_score - SCORE_SLACK,
        figures=", ".join(said),
        meaning=meaning,
        values={
            words: {"successes": _count(some), "runs": len(some), "score": runs.mean(some)} for some, words in pairs
        },
    )


def _count(found: Sequence[Scored]) -> int:
    return sum(one.success for one in found)


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
