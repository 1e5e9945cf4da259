"""The contract of an attack's search (`attacks.optimisers.OptimiserSpec`)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from attacks.budgets import Budget
from attacks.optimisers import NORM_NAMES, NormName, OptimiserSpec
from attacks.optimisers.methods import SearchSettings
from attacks.search import Evaluation, Hooks, OptimiserState, Outcome, Parameters, SearchState, Verdict, pgd
from attacks.testing.promises import Contract, expect, expect_repeatable, expect_same, expect_text

_RADIUS, _STEPS = {"sh": 0.5, "means": 0.3}, 24
_REFERENCE = {"sh": torch.linspace(-1, 1, 24).reshape(8, 3), "means": torch.zeros(8, 3)}
_GOALS = {"sh": _REFERENCE["sh"] + 0.6, "means": torch.linspace(-0.4, 0.8, 24).reshape(8, 3)}


def check_attack(spec: Any) -> None:
    """Raise unless an attack keeps its contract.

    It searches a bowl whose lowest point is outside of the budget, in every norm: it has to gain, to repeat itself, to
    go on where it was interrupted, and to leave the points that it is given as they are.

    Args:
        spec: What an entry point brings.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"attack {getattr(spec, 'name', type(spec).__name__)}")
    with contract.promise("names"):
        expect(isinstance(spec, OptimiserSpec), "an OptimiserSpec", type(spec).__name__, "make one")
        expect_text(spec.name, "name")
        expect_text(spec.about, "line about it")
        expect(0 <= spec.momentum < 1, "a momentum in [0, 1)", spec.momentum, "give its usual one")
    contract.settle()
    for norm in NORM_NAMES:
        with contract.promise(f"gain in {norm}"):
            outcome = _run(spec, norm)
            first, best = outcome.trace[0].loss, outcome.best.loss
            got = f"{best:.4g} after {first:.4g} at the start"
            expect(best < first, "a lower loss within the budget", got, "step against the gradient")
    with contract.promise("steps"):
        _steps(spec)
    with contract.promise("determinism"):
        do = "draw from settings.generator(memory)"
        expect_repeatable(lambda: [_losses(_run(spec, "linf"))], "the same losses for the same seed", do)
    with contract.promise("interruption"):
        _goes_on(spec)
    with contract.promise("no room"):
        still = _run(spec, "linf", radius=dict.fromkeys(_RADIUS, 0.0))
        kept = all(torch.equal(still.parameters[name], _REFERENCE[name]) for name in _REFERENCE)
        expect(kept, "no change where the budget is 0", "one", "step by settings.step or the radius")
    contract.settle()


def _bowl(point: Parameters, *, gradient: bool) -> Evaluation:
    loss = sum(float((point[name] - _GOALS[name]).square().sum()) for name in point)
    gradients = {name: 2 * (point[name] - _GOALS[name]) for name in point} if gradient else {}
    verdict = Verdict(success=False, score=1 / (1 + loss), unambiguous=False)
    return Evaluation(loss=loss, gradients=gradients, verdict=verdict)


def _settings(spec: OptimiserSpec, norm: NormName, radius: dict[str, float]) -> SearchSettings:
    return SearchSettings(
        ball=Budget(radius=radius, norm=norm),
        reference=_REFERENCE,
        positions=torch.arange(24.0).reshape(8, 3),
        step={name: 2 * value / _STEPS for name, value in radius.items()},
        steps=_STEPS,
        momentum=spec.momentum,
        seed=3,
    )


def _run(
    spec: OptimiserSpec,
    norm: NormName,
    *,
    radius: dict[str, float] | None = None,
    starts: SearchState | None = None,
    hooks: Hooks | None = None,
) -> Outcome:
    """A search of the bowl."""
    search = _settings(spec, norm, _RADIUS if radius is None else radius)
    return pgd(
        lambda point: _bowl(point, gradient=spec.gradient),
        _REFERENCE,
        search.ball,
        steps=_STEPS,
        optimiser=spec.make(search),
        starts=starts,
        early_stop=False,
        smallest=spec.smallest,
        hooks=hooks,
    )


def _steps(spec: OptimiserSpec) -> None:
    """Each step gives a point of the same kind, counts itself, and changes nothing that it was given."""
    update, memory = spec.make(_settings(spec, "linf", _RADIUS)), OptimiserState(index=0)
    point = {name: value.clone() for name, value in _REFERENCE.items()}
    for _ in range(3):
        here, kept = _bowl(point, gradient=spec.gradient), {name: value.clone() for name, value in point.items()}
        gradients = {name: value.clone() for name, value in here.gradients.items()}
        following, after = update(point, here, memory)
        same = all(torch.equal(point[name], kept[name]) for name in kept)
        same = same and all(torch.equal(here.gradients[name], gradients[name]) for name in gradients)
        expect(same, "points and gradients that stay as they are", "others", "make new tensors")
        if following is None:
            return
        shapes = {name: tuple(value.shape) for name, value in following.items()}
        wanted = {name: tuple(value.shape) for name, value in kept.items()}
        expect(shapes == wanted, f"a point of {wanted}", shapes, "give each parameter its next value")
        finite = all(bool(torch.isfinite(value).all()) for value in following.values())
        expect(finite, "a finite point", "NaN or infinity", "look at divisions by a size of 0")
        expect(
            after.index == memory.index + 1,
            f"a memory of {memory.index + 1} steps",
            after.index,
            "end with memory.after()",
        )
        numbers = all(math.isfinite(value) for value in after.numbers.values())
        expect(numbers, "finite numbers in the memory", "others", "leave out what is not known yet")
        point, memory = dict(following), after


def _goes_on(spec: OptimiserSpec) -> None:
    """A search that is taken up in its middle ends as the whole one does."""
    states: list[SearchState] = []
    whole = _run(spec, "l2", hooks=Hooks(on_state=states.append))
    if len(states) < 2:
        return  # it is over after a step
    middle = states[len(states) // 2]
    copied = {
        name: {key: value.clone() for key, value in kept.items()} for name, kept in middle.optimiser.tensors.items()
    }
    rest = _run(
        spec, "l2", starts=dataclasses.replace(middle, optimiser=dataclasses.replace(middle.optimiser, tensors=copied))
    )
    do = "keep in the memory (OptimiserState) all that the next step needs, nothing in the function"
    expected = "the same rest of a search that was interrupted"
    expect_same([_losses(whole)], [_losses(rest)], atol=0, expected=expected, do=do)


def _losses(outcome: Outcome) -> Tensor:
    return torch.tensor([line.loss for line in outcome.trace])
