"""Checks of the gradient: against central differences, and how much of it is exactly zero."""

from __future__ import annotations

from torch import Generator

from attacks.dagger.sanity.comparisons import NOISE_DRAWS
from attacks.dagger.sanity.finding import Finding
from attacks.dagger.sanity.gradients import Agreement, renderer_alone, soft, whole_chain
from attacks.dagger.sanity.runs import Runs

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
        ensemble = runs.ensemble(seed, render=soft(runs.case.render))
        (problem,), ((view,),) = ensemble.problems, ensemble.views
        clean = problem.subset.parameters(config.attributes)
        drawn = config.budget.uniform(clean, generator)
        point = {key: value + (drawn[key] - value) / 10 for key, value in clean.items()}
        one = differentiate(problem, view, point, count=DIRECTIONS, step=min(config.eps) / 100, generator=generator)
        automatic += one.automatic
        measured += one.measured
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
