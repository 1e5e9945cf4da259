"""Checks of an attack after Carlini et al., "On Evaluating Adversarial Robustness" (2019), each a finding.

Most compare attacks which a sane attack must order in one way (Athalye et al., "Obfuscated Gradients Give a False Sense
of Security", ICML 2018). Scores count up to the one that is a success, since a search that has it may stop. The others
are of the gradient: against central differences, and how much of it is exactly zero.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor

from attacks.dagger.attack import attack, problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.result import Result
from attacks.dagger.views import FixedViews, View, detected
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives import Relabel
from attacks.observe.views import as_saved
from attacks.search import Parameters, Step, Verdict, rank
from attacks.tables import markdown
from mi_splat import provenance
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras import Camera, RenderFn
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD
from mi_splat.scene import GaussianScene, scene_hash

# Gradients against central finite differences: of the renderer alone, and of the whole chain from Gaussians to loss.
#
# The whole chain has steps that are constant for the gradient: the candidates that a detector or an objective
# chooses. So its agreement is measured over directions, by cosine and slope, with a wider tolerance than the
# renderer's.

Attack = Callable[..., Result]
"""The attack that is checked: `attacks.dagger.attack.attack`, or one that takes the same arguments."""


Scored = Result | Verdict
"""What a run has reached: whether it has its aim, and a score."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Case:
    """An attack that is checked."""

    scene: GaussianScene  # the clean splat
    mask: Mask  # the object's Gaussians
    cameras: tuple[Camera, ...]  # one for each seed, from 0; every seed is one attack in one view
    detector: Detector  # the one attacked
    objective: Relabel  # the aim
    render: RenderFn  # the renderer
    config: DaggerConfig  # how to attack; the checks take fractions and multiples of its radii
    surrogate: Detector | None = None  # another one, whose attacks `detector` judges; None leaves that check out


class Runs:
    """The attacks on a case; the same one is made once, and then `on_run` is called.

    Tests of the checks give another attack than the project's to `make`.
    """

    def __init__(self, case: Case, make: Attack = attack, on_run: Callable[[], None] = lambda: None) -> None:
        self.case, self._attack, self._on_run = case, make, on_run
        self._made: dict[tuple[str, DaggerConfig, int], Result] = {}

    @property
    def made(self) -> tuple[tuple[DaggerConfig, Result], ...]:
        """Every attack so far, and what it was asked for."""
        return tuple((config, result) for (_, config, _), result in self._made.items())

    def results(self, scale: float = 1.0, *, detector: Detector | None = None, **changes: Any) -> tuple[Result, ...]:
        """One attack for each seed."""
        attacked = detector or self.case.detector
        return tuple(self._result(seed, scale, attacked, changes) for seed in range(len(self.case.cameras)))

    def _result(self, seed: int, scale: float, detector: Detector, changes: dict[str, Any]) -> Result:
        case, base = self.case, self.case.config
        eps = tuple(scale * radius for radius in base.eps)
        config = dataclasses.replace(base, **{"eps": eps, "seed": seed, "random_start": seed > 0, **changes})
        key = (detector.name, config, seed)
        if key not in self._made:
            self._made[key] = self._attack(
                case.scene, case.mask, [case.cameras[seed]], detector, case.objective, render=case.render, config=config
            )
            self._on_run()
        return self._made[key]

    def mean(self, scored: Sequence[Scored]) -> float:
        """Mean score; what is more than a success needs does not count."""
        enough = self.case.objective.confidence
        return sum(min(result.score, enough) for result in scored) / len(scored)

    def problem(self, seed: int, *, render: RenderFn | None = None) -> tuple[Problem, View]:
        """The detector of the case as an attack differentiates it, and the view of a seed."""
        case = self.case
        views = FixedViews(case.scene, case.mask, case.cameras[seed], render=render or case.render)
        problem = problem_of(views, (case.detector,), case.objective, case.config)
        return problem, views.held_out(case.config)[0]

    def judged(self, results: Sequence[Result]) -> list[Verdict]:
        """What the detector of the case makes of the splats of one attack for each seed."""
        verdicts = []
        for seed, result in enumerate(results):
            problem, view = self.problem(seed)
            (seen,) = detected([self.case.detector], as_saved(result.scene), [view], problem.render).values()
            verdicts.append(problem.objective.verdict(seen.detections, problem.target(view, self.case.detector)))
        return verdicts


CONTRAST = 0.8
"""Contrast of the pictures that are differentiated: no pixel is near the clamp at 0 and 1, which has a kink."""

DIRECTIONS = 6
"""Random directions for each seed."""

Value = Callable[[Parameters], float]
"""A function that is differentiated."""

Differentiated = Callable[[Problem, View, DaggerConfig, Parameters, Generator], tuple[Value, Parameters]]
"""A function and its gradients at a point, of a problem in one view; the generator draws what is random about it."""


def random_directions(gradients: Parameters, count: int, generator: Generator) -> list[Parameters]:
    """Random directions of length 1 that move the Gaussians which matter.

    A Gaussian moves as far as the size of its gradient, every one of its components at random: Gaussians out of sight
    stay, and a component that lacks its gradient moves like the others. Directions without any order would change the
    loss so little that the differences drown in what is not smooth.
    """
    directions = []
    for _ in range(count):
        direction = {}
        for name, gradient in gradients.items():
            rows = gradient.detach().double().reshape(len(gradient), -1).norm(dim=1)
            rows = rows if float(rows.max()) > 0 else torch.ones_like(rows)
            draw = torch.randn(gradient.shape, generator=generator, dtype=torch.float64).to(rows.device)
            direction[name] = rows.reshape(-1, *[1] * (gradient.ndim - 1)) * draw
        size = math.sqrt(sum(float(part.square().sum()) for part in direction.values()))
        directions.append({name: (part / size).to(gradients[name]) for name, part in direction.items()})
    return directions


def agreement(runs: Runs, differentiate: Differentiated) -> tuple[list[float], list[float]]:
    """Directional derivatives by automatic differentiation, and the same by central differences of two widths.

    Over the seeds, at random points a tenth of the radius from the clean object, in pictures of less contrast.
    """
    automatic, measured, config = list[float](), list[float](), runs.case.config

    def soft(scene: GaussianScene, camera: Camera) -> Tensor:
        return 0.5 + CONTRAST * (runs.case.render(scene, camera) - 0.5)

    for seed in range(len(runs.case.cameras)):
        generator = Generator().manual_seed(2000 + seed)
        problem, view = runs.problem(seed, render=soft)
        clean = problem.subset.parameters(config.attributes)
        drawn = config.budget.uniform(clean, generator)
        point = {name: value + (drawn[name] - value) / 10 for name, value in clean.items()}
        value, gradients = differentiate(problem, view, config, point, generator)

        def slope(direction: Parameters, step: float, value: Value = value, point: Parameters = point) -> float:
            ends = ({n: tensor + amount * direction[n] for n, tensor in point.items()} for amount in (step, -step))
            ahead, behind = map(value, ends)
            return (ahead - behind) / (2 * step)

        for direction in random_directions(gradients, DIRECTIONS, generator):
            automatic.append(sum(float((gradients[name] * part).double().sum()) for name, part in direction.items()))
            step = min(config.eps) / 100
            measured.append((slope(direction, step) + slope(direction, 2 * step)) / 2)
    return automatic, measured


def whole_chain(
    problem: Problem, view: View, config: DaggerConfig, point: Parameters, generator: Generator
) -> tuple[Value, Parameters]:
    """As in `Differentiated`: from the object's parameters through renderer and detector to the loss."""
    gradients = problem.evaluate(point, [view], config).gradients
    return lambda parameters: problem.evaluate(parameters, [view], config).loss, gradients


def renderer_alone(
    problem: Problem, view: View, config: DaggerConfig, point: Parameters, generator: Generator
) -> tuple[Value, Parameters]:
    """As in `Differentiated`: to a fixed random weighting of the pixels, blurred so that it adds up."""
    coarse = torch.randn(1, 3, 6, 6, generator=generator)
    size = (view.camera.height, view.camera.width)
    weights = torch.nn.functional.interpolate(coarse, size=size, mode="bilinear")[0].permute(1, 2, 0)

    def weighted(parameters: Parameters) -> Tensor:
        picture = problem.render(problem.subset.scene_with(parameters), view.camera)
        total: Tensor = (weights.to(picture) * picture).sum(dtype=torch.float64)
        return total

    def value(parameters: Parameters) -> float:
        with torch.no_grad():
            return float(weighted(parameters))

    leaves = {name: tensor.detach().requires_grad_(True) for name, tensor in point.items()}
    parts = torch.autograd.grad(weighted(leaves), list(leaves.values()), materialize_grads=True)
    return value, dict(zip(leaves, parts, strict=True))


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

REPORTED_FROM = 0.5
"""Confidence from which the clean object counts as found."""

ZERO_LIMIT = 0.9
"""Share of exactly zero elements of a gradient that is too much; Gaussians out of sight have none in any case."""

RENDERER = (0.99, 0.05)
"""What is asked of the renderer's gradient: the least cosine, and how far the slope may be from 1."""

CHAIN = (0.75, 0.4)
"""The same of the whole chain. Its gradient holds constant which candidates a detector proposes and the loss chooses.

Measured on the shipped scenes: cosines of 0.82 to 0.98 and slopes of 0.82 to 0.93 with `fasterrcnn_small`, which has
proposals, and 0.96 to 0.99 and 1.00 to 1.22 with `yolov8n_small`. A gradient that lacks half of itself has about 0.7.
"""
_LIMITS = "that equal finite differences (cosine >= {:g}, slope within {:g} of 1)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check has measured: one line of the report."""

    check: str  # short name of the check
    claim: str  # what holds of a sane attack
    passed: bool | None  # whether it holds here; None if the check was not made
    figures: str  # what was measured, in words
    meaning: str  # what it means if it does not hold
    values: dict[str, Any]  # what was measured, as JSON can hold it

    @property
    def colour(self) -> str:
        """Green, red, or grey for a check that was not made."""
        return "grey" if self.passed is None else "green" if self.passed else "red"


Measured = tuple[bool | None, str, dict[str, Any]]
"""Whether a claim holds, what was measured in words, and the same as JSON can hold it."""


CHECKS: dict[str, Callable[[Runs], Finding]] = {}
"""Every check by its name, in the order of the report: each makes the attacks that it needs."""


def _check(claim: str, meaning: str) -> Callable[[Callable[[Runs], Measured]], Callable[[Runs], Measured]]:
    """Makes a check of a function that says whether a claim holds, with what it means if it does not."""

    def kept(measure: Callable[[Runs], Measured]) -> Callable[[Runs], Measured]:
        name = measure.__name__.lstrip("_")

        def finding(runs: Runs) -> Finding:
            passed, figures, values = measure(runs)
            return Finding(check=name, claim=claim, passed=passed, figures=figures, meaning=meaning, values=values)

        CHECKS[name] = finding
        return measure

    return kept


@_check(
    "starts where the object is found and the target is not",
    "there is nothing to attack: success and failure say little",
)
def _clean(runs: Runs) -> Measured:
    label = runs.case.objective.label
    views = [view for result in runs.results(noise_draws=NOISE_DRAWS) for view in result.views]
    original = [view.confidence(view.target.original, attacked=False) for view in views]
    wanted = [view.confidence(label, attacked=False) for view in views]
    passed = min(original) >= REPORTED_FROM and max(wanted) < runs.case.objective.confidence
    return passed, f"object at {_list(original)}, {label} at {_list(wanted)}", {"object": original, "target": wanted}


@_check(
    "succeeds more often than random noise that changes the object as much",
    "it is the size of the change that counts, and not the attack",
)
def _noise(runs: Runs) -> Measured:
    attacks = runs.results(noise_draws=NOISE_DRAWS)
    draws, lucky = (sum(result.figures["noise"][name] for result in attacks) for name in ("draws", "successes"))
    count = _count(attacks)
    return (
        count / len(attacks) > lucky / draws,
        f"attack {count}/{len(attacks)}, noise {lucky}/{draws}",
        {"successes": count, "runs": len(attacks), "noise_successes": lucky, "noise_draws": draws},
    )


@_check(
    "succeeds more often in larger balls, never in one of radius 0, always in a large one",
    "the attack ignores its budget, or its search fails before the budget is used up",
)
def _radius(runs: Runs) -> Measured:
    attacks = [runs.results(scale, **_settings(scale)) for scale in SCALES]
    counts, scores, total = list(map(_count, attacks)), list(map(runs.mean, attacks)), len(runs.case.cameras)
    rises = all(
        after >= before - 1 and score >= last - SCORE_SLACK
        for (before, after), (last, score) in zip(itertools.pairwise(counts), itertools.pairwise(scores), strict=True)
    )
    radii = [scale * runs.case.config.eps[0] for scale in SCALES]
    figures = (
        f"eps {eps:g}: {count}/{total} (mean score {score:.2f})"
        for eps, count, score in zip(radii, counts, scores, strict=True)
    )
    values = {"eps": radii, "successes": counts, "scores": scores, "runs": total}
    return rises and counts[0] == 0 and counts[-1] == total, "; ".join(figures), values


def _settings(scale: float) -> dict[str, Any]:
    """The case's own radius shares its runs with the noise control; without a radius one step is as good as many."""
    return {"noise_draws": NOISE_DRAWS if scale == 1 else 0, **({} if scale else {"steps": 1})}


@_check("does at least as well in many steps as in one", "steps are too long or too short, or lead astray")
def _iterative(runs: Runs) -> Measured:
    single = [runs.results(scale, noise_draws=0, steps=1, step_factor=1.0) for scale in COMPARED]
    one_step = [result for results in single for result in results]
    return _compared(runs, (_at_compared(runs), "many steps"), (one_step, "one step"))


def _at_compared(runs: Runs) -> list[Any]:
    """The case's attacks at the radii `COMPARED`."""
    return [result for scale in COMPARED for result in runs.results(scale, **_settings(scale))]


@_check("does at least as well as one on another detector", "gradients are masked: use another loss")
def _white_box(runs: Runs) -> Measured:
    surrogate = runs.case.surrogate
    if surrogate is None:
        return None, "no surrogate", {}
    attacks = runs.results(noise_draws=NOISE_DRAWS)
    moved = runs.judged(runs.results(detector=surrogate, noise_draws=0, early_stop=False))
    return _compared(runs, (attacks, "white box"), (moved, f"attack on {surrogate.name}"))


@_check("does at least as well as random points, for as many looks", "gradients are masked or wrong")
def _random_search(runs: Runs) -> Measured:
    return _without_gradients(runs, "random")


@_check("does at least as well as random blocks of Gaussians, for as many looks", "gradients are masked or wrong")
def _square(runs: Runs) -> Measured:
    return _without_gradients(runs, "square")


def _without_gradients(runs: Runs, optimiser: str) -> Measured:
    """Whether a search that knows the loss alone beats the attack in no run."""
    attacks = _at_compared(runs)
    drawn = [
        result
        for scale in COMPARED
        for result in runs.results(scale, optimiser=optimiser, noise_draws=0, early_stop=False)
    ]
    losses, theirs = ([min(line.loss for line in result.trace) for result in results] for results in (attacks, drawn))
    beaten = sum(
        not result.success and (other.success or low < loss)
        for result, loss, other, low in zip(attacks, losses, drawn, theirs, strict=True)
    )
    total, successes = len(attacks), {"attack": _count(attacks), optimiser: _count(drawn)}
    means = {"attack": sum(losses) / total, optimiser: sum(theirs) / total}
    figures = (
        f"beaten in {beaten} of {total} runs; attack {successes['attack']}/{total} (mean loss {means['attack']:.2f}), "
        f"{optimiser} {successes[optimiser]}/{total} ({means[optimiser]:.2f})"
    )
    return not beaten, figures, {"beaten": beaten, "runs": total, "successes": successes, "loss": means}


@_check(
    "is never worse for going on, and keeps its best point",
    "the search throws away what it had, or the file is not what the search has found",
)
def _more_steps(runs: Runs) -> Measured:
    config, scale = runs.case.config, COMPARED[0]
    half = max(1, config.steps // 2)
    shorter: dict[str, Any] = {"steps": half, "step_factor": config.step_factor * half / config.steps}
    long = runs.results(scale, noise_draws=0, early_stop=False)
    short = runs.results(scale, noise_draws=0, early_stop=False, **shorter)
    worse = sum(_rank(after, after.best) < _rank(after, before.best) for before, after in zip(short, long, strict=True))
    passed_over = sum(
        any(_rank(result, line) > _rank(result, result.best) for line in result.trace) for _, result in runs.made
    )
    apart = max(abs(result.score - result.best.score) for result in (*short, *long))
    return (
        not worse and not passed_over and apart <= SCORE_SLACK,
        f"{worse} of {len(long)} worse after {config.steps} steps than after {half}; {passed_over} of "
        f"{len(runs.made)} attacks passed over a better point; file and search differ by {apart:.3f} in score",
        {"worse": worse, "passed_over": passed_over, "score_difference": apart, "steps": [half, config.steps]},
    )


def _rank(result: Result, line: Step) -> tuple[bool, bool, float, float]:
    """How good a point is to the attack that has looked at it."""
    return rank(line, result.config.spec.smallest)


@_check("always succeeds where no ball binds it", "the loss does not lead to success, whatever the budget")
def _unbounded(runs: Runs) -> Measured:
    config = runs.case.config
    if not config.spec.takes_step:
        return None, f"the steps of {config.optimiser} are as long as its ball", {}
    steps = 4 * config.steps
    free = runs.results(
        UNBOUNDED,
        noise_draws=0,
        steps=steps,
        step_factor=config.step_factor * steps / (config.steps * UNBOUNDED),
        random_start=False,  # a random point of so large a ball is far from everything
    )
    share = max(result.used[name] / radius for result in free for name, radius in result.config.radius.items())
    count, taken = _count(free), [result.best.index for result in free]
    figures = f"{count}/{len(free)} within {steps} steps; it used {share * UNBOUNDED:.1f} times the radius"
    values = {"successes": count, "runs": len(free), "share": share, "steps": taken}
    return count == len(free) and share < 1, figures, values


@_check(  # after the others: it looks at all their attacks
    "stays in its ball and changes no other Gaussian",
    "the attack takes more than it was given, so that its successes are worth nothing",
)
def _budget(runs: Runs) -> Measured:
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
    return (
        share <= 1 + 1e-6 and not strangers,
        f"at most {share:.4f} of the radius in {len(runs.made)} attacks; {strangers} other Gaussians changed",
        {"largest_share": share, "other_gaussians_changed": strangers, "attacks": len(runs.made)},
    )


def _changed(after: torch.Tensor, before: torch.Tensor) -> list[int]:
    rows: list[int] = torch.nonzero((after != before).reshape(len(after), -1).any(-1))[:, 0].tolist()
    return rows


def _agreement(runs: Runs, differentiate: Differentiated, limits: tuple[float, float]) -> Measured:
    """Cosine between derivatives and differences as vectors, and the factor between them by least squares."""
    automatic, measured = agreement(runs, differentiate)
    product = sum(a * b for a, b in zip(automatic, measured, strict=True))
    length, sizes = math.hypot(*automatic), math.hypot(*automatic) * math.hypot(*measured)
    cosine, slope = product / sizes if sizes else 0.0, product / length**2 if length**2 else 0.0
    return (
        cosine >= limits[0] and abs(slope - 1) <= limits[1],
        f"cosine {cosine:.4f}, slope {slope:.3f} over {len(automatic)} directions",
        {"cosine": cosine, "slope": slope, "automatic": automatic, "finite_differences": measured},
    )


@_check(
    f"has gradients of the renderer {_LIMITS.format(*RENDERER)}",
    "the renderer's gradient is wrong: the search is blind or goes astray",
)
def _renderer_gradient(runs: Runs) -> Measured:
    return _agreement(runs, renderer_alone, RENDERER)


@_check(
    f"has gradients from the Gaussians to the loss {_LIMITS.format(*CHAIN)}",
    "the gradient is cut, reversed or wrong somewhere between detector and Gaussians",
)
def _gradient(runs: Runs) -> Measured:
    return _agreement(runs, whole_chain, CHAIN)


@_check("sees the same at the same point twice", "something is random: attack the mean over it (`dagger --region`)")
def _repeatable(runs: Runs) -> Measured:
    config, differences = runs.case.config, list[float]()
    for seed in range(len(runs.case.cameras)):
        problem, view = runs.problem(seed)
        point = problem.subset.parameters(config.attributes)
        once, again = (problem.evaluate(point, [view], config) for _ in range(2))
        differences += [abs(once.loss - again.loss), float(once.verdict != again.verdict)]
    largest = max(differences)
    return not largest, f"two looks at the clean object differ by {largest:g} in loss", {"difference": largest}


@_check(
    f"has gradients of which at most {ZERO_LIMIT:.0%} are exactly zero",
    "most of the object has no gradient: it is out of sight, clamped, or cut off",
)
def _zero_gradients(runs: Runs) -> Measured:
    if not runs.case.config.spec.gradient:
        return None, f"{runs.case.config.optimiser} looks at no gradient", {}
    traces = [result.trace for result in runs.results(noise_draws=NOISE_DRAWS)]
    shares = [line.zero_gradient_fraction for trace in traces for line in trace]
    least, most = min(shares), max(shares)
    return most <= ZERO_LIMIT, f"{least:.1%} to {most:.1%} are exactly zero", {"least": least, "most": most}


def _compared(runs: Runs, better: tuple[Sequence[Scored], str], worse: tuple[Sequence[Scored], str]) -> Measured:
    """Whether one kind of run has no fewer successes and no lower mean score than another, each with its name."""
    told, values, reached = [], {}, []
    for scored, name in (better, worse):
        count, score = _count(scored), runs.mean(scored)
        told.append(f"{name} {count}/{len(scored)} (mean score {score:.2f})")
        values[name] = {"successes": count, "runs": len(scored), "score": score}
        reached.append((count, score))
    (more, higher), (fewer, lower) = reached
    return more >= fewer and higher >= lower - SCORE_SLACK, ", ".join(told), values


def _count(scored: Sequence[Scored]) -> int:
    return sum(result.success for result in scored)


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def write_findings(findings: Sequence[Finding], runs: Runs, folder: Path, **more: Any) -> None:
    """Write sanity.md and result.json into a folder that is there."""
    case, config = runs.case, runs.case.config
    surrogate = None if case.surrogate is None else case.surrogate.name
    conditions = (
        f"{case.detector.name} shall report {case.objective.label} at {case.objective.confidence:g} or more. "
        f"Attack: {config.optimiser}. "
        f"{config.norm} ball of {config.eps[0]:g} over {', '.join(config.attributes)}, {config.steps} steps, "
        f"{len(case.cameras)} seeds, each with its own view. Surrogate: {surrogate or 'none'}. "
        f"{len(runs.made)} attacks were made."
    )
    lines = [(line.colour, line.claim, line.figures, line.meaning) for line in findings]
    table = markdown(("", "a sane attack", "measured", "if not"), lines)
    save_text(f"# Sanity of DAGGER on {case.detector.name}\n\n{conditions}\n\n{table}\n", folder / "sanity.md")
    document = {
        "story": "dagger-sanity",
        "passed": all(finding.passed is not False for finding in findings),
        "checks": [{**dataclasses.asdict(finding), "colour": finding.colour} for finding in findings],
        "detector": case.detector.name,
        "detector_fingerprint": case.detector.fingerprint,
        "surrogate": surrogate,
        "target": case.objective.label,
        "confidence": case.objective.confidence,
        "seeds": len(case.cameras),
        "optimiser": config.optimiser,
        "steps": config.steps,
        "eps": list(config.eps),
        "norm": config.norm,
        "attributes": list(config.attributes),
        "scene_hash": scene_hash(case.scene),
        **provenance.rendered_with(case.render),
        **provenance.origin(),
        **more,
    }
    save_json(document, folder / RECORD)
