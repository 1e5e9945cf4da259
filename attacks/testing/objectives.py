"""The contract of an objective (`attacks.objectives.Objective`)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.objectives import Target
from attacks.search import Verdict
from attacks.testing.promises import Contract, expect, expect_repeatable, expect_text

_BOX = (20.0, 10.0, 70.0, 50.0)
_COUNT, _STEPS, _RATE = 12, 400, 0.1
"""Candidates around the object, steps that follow the loss, and their length."""


def check_objective(objective: Any, *, original: str = "car") -> None:
    """Raise unless an objective keeps its contract.

    A made-up detector sees an object; the loss then moves its candidates freely, as no attack could. What counts has
    to come nearer by that, or an attack would follow a loss that leads elsewhere.

    Args:
        objective: The objective.
        original: What the object is, which a verdict may ask for.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"objective {getattr(objective, 'name', type(objective).__name__)}")
    with contract.promise("names"):
        expect_text(getattr(objective, "name", None), "name")
        label = getattr(objective, "label", 0)
        expect(label is None or (isinstance(label, str) and label), "a label, or None", repr(label), "name a class")
    target = _target(getattr(objective, "label", None), original)
    start = _start(target)
    with contract.promise("loss"):
        loss = objective(_candidates(start), target)
        is_number = isinstance(loss, Tensor) and loss.ndim == 0
        got = f"shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
        expect(is_number, "a tensor without axes", got, "end it with .sum() or .mean()")
        expect(bool(torch.isfinite(loss)), "a finite loss", float(loss), "clamp before a logarithm")
    with contract.promise("gradients"):
        gradients = _gradients(objective, start, target)
        finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
        expect(finite, "finite gradients", "NaN or infinity", "clamp before a logarithm or a root")
        do = "leave out .detach(), comparisons and rounding on the way from scores and boxes to the loss"
        expect(any(bool(gradient.any()) for gradient in gradients), "a gradient in scores or boxes", "zeros", do)
    with contract.promise("no candidates"):
        nothing = [torch.zeros(0, len(target.classes)), torch.zeros(0, len(target.classes), 4)]
        gradients = _gradients(objective, nothing, target)
        loss = objective(_candidates(nothing), target)
        do = "return candidates.scores.sum() * 0.0 where nothing is considered"
        expect(bool(torch.isfinite(loss)), "a finite loss where nothing is considered", float(loss), do)
    with contract.promise("verdict"):
        for seen in (_reported(start, target), Detections(torch.zeros(0, 4), torch.zeros(0), ())):
            _verdict(objective, seen, target)
    with contract.promise("determinism"):
        losses = "the same loss in a second look"
        expect_repeatable(lambda: [objective(_candidates(start), target)], losses, "draw nothing in it")
    with contract.promise("loss and success"):
        before = _verdict(objective, _reported(start, target), target)
        end, fell = _followed(objective, start, target)
        after = _verdict(objective, _reported(end, target), target)
        expect(fell > 0, "a loss that falls along its gradient", f"one that rises by {-fell:.3g}", "look at its sign")
        got = f"a score of {before.score:.3g} before and {after.score:.3g} after {_STEPS} steps along the loss"
        do = "look at the sign of the loss, and whether both functions mean the same"
        expect(before.success or after.score > before.score, "success that comes nearer as the loss falls", got, do)
    contract.settle()


def _target(label: str | None, original: str) -> Target:
    classes = tuple(dict.fromkeys((original, label or "person", "stop sign")))
    return Target(box=torch.tensor(_BOX), label=label, classes=classes, original=original)


def _start(target: Target) -> list[Tensor]:
    """Logits (A, C) and boxes (A, C, 4) of a detector that is sure of the original on the object."""
    generator = torch.Generator().manual_seed(0)
    columns = len(target.classes)
    logits = -3.0 + 0.3 * torch.randn(_COUNT, columns, generator=generator)
    logits[:, 0] += 5.0
    boxes = target.box.expand(_COUNT, columns, 4) + 2.0 * torch.randn(_COUNT, 1, 4, generator=generator)
    return [logits, boxes.contiguous()]


def _candidates(parts: list[Tensor]) -> Candidates:
    return Candidates(parts[1], parts[0].sigmoid())


def _gradients(objective: Any, parts: list[Tensor], target: Target) -> tuple[Tensor, ...]:
    leaves = [part.detach().clone().requires_grad_(True) for part in parts]
    loss = objective(_candidates(leaves), target)
    expect(loss.requires_grad, "a loss with a gradient", "none", "keep it a function of candidates.scores or boxes")
    return torch.autograd.grad(loss, leaves, materialize_grads=True)


def _followed(objective: Any, start: list[Tensor], target: Target) -> tuple[list[Tensor], float]:
    """Where the loss leads, and by how much it fell."""
    parts = [part.clone().requires_grad_(True) for part in start]
    search = torch.optim.Adam(parts, lr=_RATE)
    before = float(objective(_candidates(start), target))
    for _ in range(_STEPS):
        search.zero_grad()
        objective(_candidates(parts), target).backward()
        search.step()
    end = [part.detach() for part in parts]
    return end, before - float(objective(_candidates(end), target))


def _reported(parts: list[Tensor], target: Target) -> Detections:
    """What a detector would report: the class of each candidate that it is surest of, from 0.05 on."""
    candidates = _candidates(parts)
    scores, columns = candidates.scores.max(1)
    rows = [int(row) for row in scores.argsort(descending=True) if scores[row] >= 0.05]
    labels = tuple(target.classes[int(columns[row])] for row in rows)
    return Detections(candidates.boxes[rows, columns[rows]], scores[rows], labels)


def _verdict(objective: Any, seen: Detections, target: Target) -> Verdict:
    verdict = objective.verdict(seen, target)
    do = "return attacks.search.Verdict, or make the objective by attacks.objective"
    expect(isinstance(verdict, Verdict), "a Verdict", type(verdict).__name__, do)
    expect(0 <= verdict.score <= 1, "a score in [0, 1]", verdict.score, "scale it")
    checked: Verdict = verdict
    return checked
