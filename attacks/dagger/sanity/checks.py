"""Checks of an attack after Carlini et al., "On Evaluating Adversarial Robustness" (2019), each a finding.

Most compare attacks which a sane attack must order in one way (Athalye et al., "Obfuscated Gradients Give a False Sense
of Security", ICML 2018). Scores count up to the one that is a success, since a search that has it may stop. The others
are of the gradient: against central differences, and how much of it is exactly zero.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Generator

from attacks.dagger.sanity.gradients import Agreement, renderer_alone, soft, whole_chain
from attacks.dagger.sanity.runs import Runs, Scored
from attacks.gaussian_subset import GaussianSubset
from attacks.pgd import rank
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text
from mi_splat.scene import ATTRIBUTES, scene_hash

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

ZERO_LIMIT = 0.9
"""Share of exactly zero elements of a gradient that is too much; Gaussians out of sight have none in any case."""

DIRECTIONS = 6
"""Random directions for each seed."""

RENDERER_COSINE, RENDERER_SLOPE = 0.99, 0.05
"""What is asked of the renderer's gradient: the least cosine, and how far the slope may be from 1."""

CHAIN_COSINE, CHAIN_SLOPE = 0.75, 0.4
"""The same of the whole chain. Its gradient holds constant which candidates a detector proposes and the loss chooses.

Measured on the shipped scenes: cosines of 0.82 to 0.98 and slopes of 0.82 to 0.93 with `fasterrcnn_small`, which has
proposals, and 0.96 to 0.99 and 1.00 to 1.22 with `yolov8n_small`. A gradient that lacks half of itself has about 0.7.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check has found.

    Attributes:
        name: Short name of the check.
        claim: What holds of a sane attack.
        passed: Whether it holds here; None if the check was not made.
        figures: What was measured, in words.
        meaning: What it means if it does not hold.
        values: What was measured, as JSON can hold it.
    """

    name: str
    claim: str
    passed: bool | None
    figures: str
    meaning: str
    values: dict[str, Any]

    @property
    def colour(self) -> str:
        """Green, red, or grey for a check that was not made."""
        return "grey" if self.passed is None else "green" if self.passed else "red"

    def as_dict(self) -> dict[str, Any]:
        """The finding as JSON can hold it."""
        return {
            "check": self.name,
            "colour": self.colour,
            "passed": self.passed,
            "claim": self.claim,
            "figures": self.figures,
            "meaning": self.meaning,
            "values": self.values,
        }


def clean(runs: Runs) -> Finding:
    """Before the attack the detector finds the object, at `FOUND` or more, and not the target."""
    label = runs.case.objective.label
    views = [view for result in runs.results(noise_draws=NOISE_DRAWS) for view in result.views]
    found = [view.confidence(view.target.original, attacked=False) for view in views]
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
    draws = [verdict for result in own for verdict in result.noise]
    lucky, count = _count(draws), _count(own)
    return Finding(
        name="noise",
        claim="succeeds more often than random noise of its size",
        passed=count / len(own) > lucky / len(draws),
        figures=f"attack {count}/{len(own)}, noise {lucky}/{len(draws)}",
        meaning="it is the size of the change that counts, and not the attack",
        values={"successes": count, "runs": len(own), "noise_successes": lucky, "noise_draws": len(draws)},
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


def renderer_gradient(runs: Runs) -> Finding:
    """The renderer's gradient is that of its pictures."""
    return _agreeing(
        runs,
        name="renderer_gradient",
        what="of the renderer",
        limits=(RENDERER_COSINE, RENDERER_SLOPE),
        chain=False,
        meaning="the renderer's gradient is wrong: the search is blind or goes astray",
    )


def gradient(runs: Runs) -> Finding:
    """The gradient from the Gaussians through renderer and detector to the loss is that of the loss."""
    return _agreeing(
        runs,
        name="gradient",
        what="from the Gaussians to the loss",
        limits=(CHAIN_COSINE, CHAIN_SLOPE),
        chain=True,
        meaning="the gradient is cut, reversed or wrong somewhere between detector and Gaussians",
    )


def _agreeing(runs: Runs, *, name: str, what: str, limits: tuple[float, float], chain: bool, meaning: str) -> Finding:
    found = _agreement(runs, chain=chain)
    least, most = limits
    return Finding(
        name=name,
        claim=f"has gradients {what} that equal finite differences (cosine >= {least:g}, slope within {most:g} of 1)",
        passed=found.cosine >= least and abs(found.slope - 1) <= most,
        figures=f"cosine {found.cosine:.4f}, slope {found.slope:.3f} over {len(found.automatic)} directions",
        meaning=meaning,
        values={
            "cosine": found.cosine,
            "slope": found.slope,
            "automatic": list(found.automatic),
            "finite_differences": list(found.measured),
        },
    )


def _agreement(runs: Runs, *, chain: bool) -> Agreement:
    """Over the seeds, at random points a tenth of the radius from the clean object, in pictures of less contrast."""
    automatic: list[float] = []
    measured: list[float] = []
    config = runs.case.config
    differentiate = whole_chain if chain else renderer_alone
    for seed in range(len(runs.case.cameras)):
        generator = Generator().manual_seed(2000 + seed)
        problem, view = runs.problem(seed, render=soft(runs.case.render))
        clean = problem.subset.parameters(config.attributes)
        drawn = config.budget.uniform(clean, generator)
        point = {key: value + (drawn[key] - value) / 10 for key, value in clean.items()}
        step = min(config.eps) / 100
        found = differentiate(problem, view, point, config, count=DIRECTIONS, step=step, generator=generator)
        automatic += found.automatic
        measured += found.measured
    return Agreement(automatic=tuple(automatic), measured=tuple(measured))


def zero_gradients(runs: Runs) -> Finding:
    """Not nearly all elements of the gradients are exactly zero."""
    traces = [result.trace for result in runs.results(noise_draws=NOISE_DRAWS)]
    shares = [line.zero_gradient_fraction for trace in traces for line in trace]
    return Finding(
        name="zero_gradients",
        claim=f"has gradients of which at most {ZERO_LIMIT:.0%} are exactly zero",
        passed=max(shares) <= ZERO_LIMIT,
        figures=f"{min(shares):.1%} to {max(shares):.1%} are exactly zero",
        meaning="most of the object has no gradient: it is out of sight, clamped, or cut off",
        values={"least": min(shares), "most": max(shares)},
    )


Check = Callable[[Runs], Finding]

CHECKS: tuple[Check, ...] = (
    clean,
    noise,
    radius,
    iterative,
    white_box,
    random_search,
    more_steps,
    unbounded,
    budget,  # after the others: it looks at all their attacks
    renderer_gradient,
    gradient,
    zero_gradients,
)
"""Each makes one finding."""


def run_checks(
    runs: Runs, *, checks: Sequence[Check] = CHECKS, on_finding: Callable[[Finding], None] | None = None
) -> list[Finding]:
    """Make every check.

    Args:
        runs: The case and the attacks on it.
        checks: What to check.
        on_finding: Called with each finding as it comes.
    """
    found = []
    for check in checks:
        found.append(check(runs))
        if on_finding is not None:
            on_finding(found[-1])
    return found


def write_findings(findings: list[Finding], runs: Runs, folder: Path, **more: Any) -> list[Path]:
    """Write sanity.md and sanity.json into a folder that is there; returns their paths.

    Args:
        findings: What the checks have found.
        runs: The attacks.
        folder: Where to.
        more: What else the JSON shall hold, for instance names of files.
    """
    case, config = runs.case, runs.case.config
    surrogate = None if case.surrogate is None else case.surrogate.name
    conditions = (
        f"{case.detector.name} shall report {case.objective.label} at {case.objective.confidence:g} or more. "
        f"{config.norm} ball of {config.eps[0]:g} over {', '.join(config.attributes)}, {config.steps} steps, "
        f"{len(case.cameras)} seeds, each with its own view. Surrogate: {surrogate or 'none'}. "
        f"{len(runs.made)} attacks were made."
    )
    paths = [folder / "sanity.md", folder / "sanity.json"]
    save_text(markdown(findings, f"Sanity of DAGGER on {case.detector.name}", conditions), paths[0])
    document = {
        "passed": all(one.passed is not False for one in findings),
        "checks": [one.as_dict() for one in findings],
        "detector": case.detector.name,
        "detector_fingerprint": case.detector.fingerprint,
        "surrogate": surrogate,
        "target": case.objective.label,
        "confidence": case.objective.confidence,
        "seeds": len(case.cameras),
        "steps": config.steps,
        "eps": list(config.eps),
        "norm": config.norm,
        "attributes": list(config.attributes),
        "scene_hash": scene_hash(case.scene),
        **provenance.rendered_with(case.render),
        **provenance.origin(),
        **more,
    }
    save_json(document, paths[1])
    return paths


def markdown(findings: Sequence[Finding], title: str, conditions: str) -> str:
    """The report as a Markdown page.

    Args:
        findings: Its lines.
        title: Heading.
        conditions: What was attacked and how.
    """
    lines = [f"# {title}", "", conditions, "", "| | a sane attack | measured | if not |", "| --- | --- | --- | --- |"]
    lines += [f"| {one.colour} | {one.claim} | {one.figures} | {one.meaning} |" for one in findings]
    return "\n".join([*lines, ""])
