"""The contracts of an attack's search (`attacks.optimisers.OptimiserSpec`) and of a
poison (`attacks.poisons.base`).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from attacks.optimisers import NORM_NAMES, NormName, OptimiserSpec
from attacks.optimisers.methods import SearchSettings
from attacks.poisons.base import Poisoned, PoisonedViews
from attacks.poisons.specs import Given, PoisonSpec
from attacks.search.budget import Budget
from attacks.search.loop import Evaluation, Memory, Optimiser, Outcome, Verdict, pgd
from attacks.search.parameters import Parameters
from attacks.testing.promises import (
    Contract,
    expect,
    expect_repeatable,
    expect_same,
    expect_text,
)
from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.ledger.job import encoded, is_frozen


def check_poison(
    poison: Any,
    *,
    views: Sequence[View] | None = None,
    config: Any = None,
    given: Given | None = None,
) -> None:
    """Raise unless a poison keeps its contract.

    Args:
        poison: What an entry point brings, a `PoisonSpec`; or a poison, as a function
            of views and a seed.
        views: A set that it changes; None takes six small images of noise.
        config: Settings of a `PoisonSpec`; None takes its defaults.
        given: What its attacker has; a spec that needs something needs this.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"poison {getattr(poison, 'name', type(poison).__name__)}")
    untouched = views or noise_views()
    function = poison
    if isinstance(poison, PoisonSpec):
        with contract.promise("settings"):
            _poison_settings(poison, given)
        with contract.promise("making it"):
            function = poison.make(
                poison.config() if config is None else config, given or Given()
            )
            expect(
                callable(function),
                "a function of views",
                type(function).__name__,
                "return an ImagePoison",
            )
        contract.settle()
    told: list[tuple[int, int]] = []
    kept = [view.image.clone() for view in untouched]
    with contract.promise("the set"):
        done = function(
            untouched, seed=3, on_step=lambda count, total: told.append((count, total))
        )
        _set(done, untouched)
    with contract.promise("changes"):
        _changes(function(untouched, seed=3), untouched)
    with contract.promise("the untouched set"):
        same = all(
            torch.equal(view.image, image)
            for view, image in zip(untouched, kept, strict=True)
        )
        expect(
            same,
            "an untouched set that stays as it is",
            "other images",
            "work on copies",
        )
    with contract.promise("manifest"):
        manifest = function(untouched, seed=3).manifest
        json.dumps(manifest, allow_nan=False)
        expect_text(manifest.get("kind"), "kind")
    with contract.promise("determinism"):
        do = "draw from torch.Generator().manual_seed(seed)"
        expected = "the same images for the same seed"
        expect_repeatable(
            lambda: [view.image for view in function(untouched, seed=3).views],
            expected,
            do,
        )
    with contract.promise("progress"):
        good = bool(told) and told[-1][0] == told[-1][1]
        do = "call on_step(done, wanted) after each image"
        expect(good, "calls of on_step that end with all done", told[-1:] or "none", do)
    contract.settle()


def noise_views() -> list[View]:
    """Six small images of noise, of one point."""
    generator = torch.Generator().manual_seed(0)
    cameras = [
        Camera(
            to_world=look_at((x, -3.0, 1.0), (0.0, 0.0, 0.0)),
            lens=Lens(focal=40.0, size=(32, 24)),
        )
        for x in torch.linspace(-1, 1, 6).tolist()
    ]
    images = [
        (torch.rand(24, 32, 3, generator=generator) * 255).round() / 255
        for _ in cameras
    ]
    return [View(camera, image) for camera, image in zip(cameras, images, strict=True)]


def _poison_settings(spec: PoisonSpec, given: Given | None) -> None:
    expect_text(spec.name, "name")
    good = isinstance(spec.config, type) and dataclasses.is_dataclass(spec.config)
    expect(
        good,
        "a dataclass as config",
        repr(spec.config),
        "write @dataclass(frozen=True, kw_only=True)",
    )
    config = spec.config()
    expect(
        is_frozen(config),
        "a frozen dataclass as config",
        "one that can change",
        "add frozen=True",
    )
    encoded(
        {
            field.name: getattr(config, field.name)
            for field in dataclasses.fields(config)
        }
    )
    needs = ", ".join(spec.needs)
    expect(
        given or not needs,
        "a poison that needs nothing",
        f"one that needs {needs}",
        "pass it as `given`",
    )


def _set(done: Any, given: Sequence[View]) -> None:
    do = "end with attacks.poisons.base.poisoned(views, images, settings)"
    expect(
        isinstance(done, Poisoned) and isinstance(done.views, PoisonedViews),
        "Poisoned",
        type(done).__name__,
        do,
    )
    expect(
        len(done.views) == len(given),
        f"{len(given)} views",
        len(done.views),
        "replace images, add none",
    )
    for number, (before, after) in enumerate(zip(given, done.views, strict=True)):
        expect(
            after.camera is before.camera,
            f"view {number} from its own camera",
            "another camera",
            "leave cameras",
        )
        shape = tuple(after.image.shape)
        expect(
            shape == tuple(before.image.shape),
            f"view {number} of its own size",
            shape,
            "keep sizes",
        )
        low = float(after.image.min())
        high = float(after.image.max())
        expect(
            low >= 0 and high <= 1,
            "sRGB in [0, 1]",
            f"{low:.3g} to {high:.3g}",
            "clip images",
        )


def _changes(done: Poisoned, given: Sequence[View]) -> None:
    pairs = enumerate(zip(given, done.views, strict=True))
    changed = [
        number
        for number, (before, after) in pairs
        if not torch.equal(before.image, after.image)
    ]
    do = "look at the settings: with all defaults it has to change something"
    expect(changed, "an image that is changed", "none", do)
    listed = [change.index for change in done.changes]
    do = "end with attacks.poisons.base.poisoned(views, images, settings)"
    expect(set(changed) <= set(listed), f"changes of the views {changed}", listed, do)


_RADIUS = {"sh": 0.5, "means": 0.3}
_STEPS = 24
_REFERENCE = {"sh": torch.linspace(-1, 1, 24).reshape(8, 3), "means": torch.zeros(8, 3)}
_GOALS = {
    "sh": _REFERENCE["sh"] + 0.6,
    "means": torch.linspace(-0.4, 0.8, 24).reshape(8, 3),
}


def check_attack(spec: Any) -> None:
    """Raise unless an attack keeps its contract.

    It searches a bowl whose lowest point is outside of the budget, in every norm: it
    has to gain, to repeat itself, to keep what it remembers in the memory of its run,
    and to leave the points that it is given as they are.

    Args:
        spec: What an entry point brings.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"attack {getattr(spec, 'name', type(spec).__name__)}")
    with contract.promise("names"):
        expect(
            isinstance(spec, OptimiserSpec),
            "an OptimiserSpec",
            type(spec).__name__,
            "make one",
        )
        expect_text(spec.name, "name")
        expect_text(spec.about, "line about it")
        expect(
            0 <= spec.momentum < 1,
            "a momentum in [0, 1)",
            spec.momentum,
            "give its usual one",
        )
    contract.settle()
    for norm in NORM_NAMES:
        with contract.promise(f"gain in {norm}"):
            outcome = _run(spec, norm)
            first = outcome.trace[0].loss
            best = outcome.best.loss
            got = f"{best:.4g} after {first:.4g} at the start"
            expect(
                best < first,
                "a lower loss within the budget",
                got,
                "step against the gradient",
            )
    with contract.promise("steps"):
        _steps(spec)
    with contract.promise("determinism"):
        do = "draw from settings.generator(memory)"
        expect_repeatable(
            lambda: [_losses(_run(spec, "linf"))],
            "the same losses for the same seed",
            do,
        )
    with contract.promise("memory"):
        _remembers_in_its_memory(spec)
    with contract.promise("no room"):
        still = _run(spec, "linf", radius=dict.fromkeys(_RADIUS, 0.0))
        kept = all(
            torch.equal(still.parameters[name], _REFERENCE[name]) for name in _REFERENCE
        )
        expect(
            kept,
            "no change where the budget is 0",
            "one",
            "step by settings.step or the radius",
        )
    contract.settle()


def _bowl(point: Parameters, *, gradient: bool) -> Evaluation:
    loss = sum(float((point[name] - _GOALS[name]).square().sum()) for name in point)
    if gradient:
        gradients = {name: 2 * (point[name] - _GOALS[name]) for name in point}
    else:
        gradients = {}
    verdict = Verdict(success=False, score=1 / (1 + loss), unambiguous=False)
    return Evaluation(loss=loss, gradients=gradients, verdict=verdict)


def _settings(
    spec: OptimiserSpec, norm: NormName, radius: dict[str, float]
) -> SearchSettings:
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
    optimiser: Optimiser | None = None,
) -> Outcome:
    """A search of the bowl."""
    search = _settings(spec, norm, _RADIUS if radius is None else radius)
    return pgd(
        lambda point: _bowl(point, gradient=spec.gradient),
        _REFERENCE,
        search.ball,
        steps=_STEPS,
        optimiser=optimiser or spec.make(search),
        early_stop=False,
        smallest=spec.smallest,
    )


def _steps(spec: OptimiserSpec) -> None:
    """Each step gives a finite point of the same kind, and changes nothing that it was
    given but its memory.
    """
    update = spec.make(_settings(spec, "linf", _RADIUS))
    memory = Memory()
    point = {name: value.clone() for name, value in _REFERENCE.items()}
    for index in range(3):
        memory.index = index
        here = _bowl(point, gradient=spec.gradient)
        kept = {name: value.clone() for name, value in point.items()}
        gradients = {name: value.clone() for name, value in here.gradients.items()}
        following = update(point, here, memory)
        same = all(torch.equal(point[name], kept[name]) for name in kept)
        same = same and all(
            torch.equal(here.gradients[name], gradients[name]) for name in gradients
        )
        expect(
            same,
            "points and gradients that stay as they are",
            "others",
            "make new tensors",
        )
        if following is None:
            return
        shapes = {name: tuple(value.shape) for name, value in following.items()}
        wanted = {name: tuple(value.shape) for name, value in kept.items()}
        expect(
            shapes == wanted,
            f"a point of {wanted}",
            shapes,
            "give each parameter its next value",
        )
        finite = all(bool(torch.isfinite(value).all()) for value in following.values())
        expect(
            finite,
            "a finite point",
            "NaN or infinity",
            "look at divisions by a size of 0",
        )
        numbers = all(math.isfinite(value) for value in memory.numbers.values())
        expect(
            numbers,
            "finite numbers in the memory",
            "others",
            "leave out what is not known yet",
        )
        point = dict(following)


def _remembers_in_its_memory(spec: OptimiserSpec) -> None:
    """Runs share the function: a second search by the same one is the first again,
    since its memory is new.
    """
    update = spec.make(_settings(spec, "l2", _RADIUS))
    first, second = (_run(spec, "l2", optimiser=update) for _ in range(2))
    do = "keep in the memory all that the next step needs, nothing in the function"
    expected = "the same from a new memory"
    expect_same([_losses(first)], [_losses(second)], atol=0, expected=expected, do=do)


def _losses(outcome: Outcome) -> Tensor:
    return torch.tensor([line.loss for line in outcome.trace])
