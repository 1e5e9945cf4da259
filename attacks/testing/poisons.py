"""The contract of a poison (`attacks.poisons.base.PicturePoison`)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import torch

from attacks.poisons.base import Poisoned, PoisonedViews
from attacks.poisons.specs import Given, PoisonSpec
from attacks.testing.promises import Contract, expect, expect_repeatable, expect_text
from mi_splat.cameras import Camera, View, look_at
from mi_splat.ledger.job import encoded, is_frozen


def check_poison(poison: Any, *, views: Sequence[View] | None = None) -> None:
    """Raise unless a poison keeps its contract.

    Args:
        poison: What an entry point brings, a `PoisonSpec` whose poison needs no splat; or a poison, as a function of
            views and a seed.
        views: A set that it changes; None takes six small pictures of noise.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract, given = Contract(f"poison {getattr(poison, 'name', type(poison).__name__)}"), views or _views()
    function = poison
    if isinstance(poison, PoisonSpec):
        with contract.promise("settings"):
            _settings(poison)
        with contract.promise("making it"):
            function = poison.make(poison.config(), Given())
            expect(callable(function), "a function of views", type(function).__name__, "return a PicturePoison")
        contract.settle()
    told: list[tuple[int, int]] = []
    kept = [view.image.clone() for view in given]
    with contract.promise("the set"):
        done = function(given, seed=3, on_step=lambda count, total: told.append((count, total)))
        _set(done, given)
    with contract.promise("changes"):
        _changes(function(given, seed=3), given)
    with contract.promise("the untouched set"):
        same = all(torch.equal(view.image, image) for view, image in zip(given, kept, strict=True))
        expect(same, "an untouched set that stays as it is", "other pictures", "work on copies")
    with contract.promise("manifest"):
        manifest = function(given, seed=3).manifest
        json.dumps(manifest, allow_nan=False)
        expect_text(manifest.get("kind"), "kind")
    with contract.promise("determinism"):
        do = "draw from torch.Generator().manual_seed(seed)"
        expected = "the same pictures for the same seed"
        expect_repeatable(lambda: [view.image for view in function(given, seed=3).views], expected, do)
    with contract.promise("progress"):
        good = bool(told) and told[-1][0] == told[-1][1]
        do = "call on_step(done, wanted) after each picture"
        expect(good, "calls of on_step that end with all done", told[-1:] or "none", do)
    contract.settle()


def _views() -> list[View]:
    generator = torch.Generator().manual_seed(0)
    cameras = [
        Camera(to_world=look_at((x, -3.0, 1.0), (0.0, 0.0, 0.0)), focal=40.0, width=32, height=24)
        for x in torch.linspace(-1, 1, 6).tolist()
    ]
    images = [(torch.rand(24, 32, 3, generator=generator) * 255).round() / 255 for _ in cameras]
    return [View(camera, image) for camera, image in zip(cameras, images, strict=True)]


def _settings(spec: PoisonSpec) -> None:
    expect_text(spec.name, "name")
    good = isinstance(spec.config, type) and dataclasses.is_dataclass(spec.config)
    expect(good, "a dataclass as config", repr(spec.config), "write @dataclass(frozen=True, kw_only=True)")
    config = spec.config()
    expect(is_frozen(config), "a frozen dataclass as config", "one that can change", "add frozen=True")
    encoded({field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
    expect(not spec.needs, "a poison that needs no splat", "one that does", "check the poison itself")


def _set(done: Any, given: Sequence[View]) -> None:
    do = "end with attacks.poisons.base.poisoned(views, pictures, settings)"
    expect(isinstance(done, Poisoned) and isinstance(done.views, PoisonedViews), "Poisoned", type(done).__name__, do)
    expect(len(done.views) == len(given), f"{len(given)} views", len(done.views), "replace pictures, add none")
    for number, (before, after) in enumerate(zip(given, done.views, strict=True)):
        expect(after.camera is before.camera, f"view {number} from its own camera", "another camera", "leave cameras")
        shape = tuple(after.image.shape)
        expect(shape == tuple(before.image.shape), f"view {number} of its own size", shape, "keep sizes")
        low, high = float(after.image.min()), float(after.image.max())
        expect(low >= 0 and high <= 1, "sRGB in [0, 1]", f"{low:.3g} to {high:.3g}", "clip pictures")


def _changes(done: Poisoned, given: Sequence[View]) -> None:
    pairs = enumerate(zip(given, done.views, strict=True))
    changed = [number for number, (before, after) in pairs if not torch.equal(before.image, after.image)]
    do = "look at the settings: with all defaults it has to change something"
    expect(changed, "a picture that is changed", "none", do)
    listed = [change.index for change in done.changes]
    do = "end with attacks.poisons.base.poisoned(views, pictures, settings)"
    expect(set(changed) <= set(listed), f"changes of the views {changed}", listed, do)
