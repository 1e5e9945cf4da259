"""Objectives: what an attacker wants of a detector, one file each, by their names; also
those of other packages.

Light, without torch, which comes with the first objective that is made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from mi_splat.errors import InvalidValueError
from mi_splat.fields import Fraction, check
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.detectors.base import Candidates, Detections
    from attacks.objectives.base import Objective, Target
    from attacks.search.loop import Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectiveSpec:
    """An aim that is known by its name.

    Attributes:
        name: What `--objective` and the key `aim` of a study call it.
        make: The aim, for a class that is wanted (None unless `targeted`) and a
            confidence that counts (None is its own).
        targeted: Whether a class is wanted, by `--target`.
    """

    name: str
    make: Callable[[str | None, float | None], Objective]
    targeted: bool = False


OBJECTIVES: Registry[ObjectiveSpec] = Registry(
    "mi_splat.objectives",
    "an ObjectiveSpec",
    lambda value: isinstance(value, ObjectiveSpec),
    what="objective",
)
"""Name to spec of every aim."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PluggedObjective:
    """The aim of another package, by its name: it can be written to a file and read
    again.

    Attributes:
        kind: Its name in `OBJECTIVES`.
        label: Class that is wanted; None if no particular one.
        confidence: That counts, in [0, 1]; None is the aim's own.
        package: Which package brings it, with its version; filled in when it is made by
            `objective_of`.
    """

    kind: str
    label: str | None = None
    confidence: Fraction | None = None
    package: str = ""

    def __post_init__(self) -> None:
        check(self)

    @property
    def name(self) -> str:
        """Short name for reports."""
        return self.kind

    @property
    def aim(self) -> Objective:
        """The aim itself."""
        return _made(self.kind, self.label, self.confidence)

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        return self.aim(candidates, target)

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """Success and score of one view."""
        return self.aim.verdict(detections, target)


@cache
def _made(kind: str, label: str | None, confidence: float | None) -> Objective:
    from attacks.objectives.base import check_objective

    aim = OBJECTIVES.chosen(kind).make(label, confidence)
    check_objective(aim)
    return aim


def objective_of(
    name: str,
    label: str | None = None,
    confidence: float | None = None,
    *,
    strict: bool = False,
    quiet: bool = False,
) -> Objective:
    """An objective by its name.

    `strict` holds for `relabel` only (see `attacks.objectives.relabel`); `quiet` says
    that the object's PSNR is the budget.
    """
    spec = OBJECTIVES.chosen(name)
    if spec.targeted is (label is None):
        do = "name the class wanted" if label is None else "leave it out"
        raise InvalidValueError.of(
            "target", f"what the aim {name} has", label or "none", do
        )
    if strict and name == "relabel":
        from attacks.objectives.relabel import relabel

        return relabel(str(label), confidence=confidence, strict=True, quiet=quiet)
    package = OBJECTIVES.package(name)
    if not package:
        return spec.make(label, confidence)
    plugged = PluggedObjective(
        kind=name, label=label, confidence=confidence, package=package
    )
    _ = plugged.aim  # which says at once what is wrong with it
    return plugged


def _relabel(label: str | None, confidence: float | None) -> Objective:
    from attacks.objectives.relabel import relabel

    return relabel(str(label), confidence=confidence)


def _hide(label: str | None, confidence: float | None) -> Objective:
    from attacks.objectives.suppression import hide

    return hide(confidence=confidence)


def _untargeted(label: str | None, confidence: float | None) -> Objective:
    from attacks.objectives.suppression import untargeted

    return untargeted(confidence=confidence)


for _spec in (
    ObjectiveSpec(name="relabel", make=_relabel, targeted=True),
    ObjectiveSpec(name="hide", make=_hide),
    ObjectiveSpec(name="untargeted", make=_untargeted),
):
    OBJECTIVES.add(_spec.name, _spec)
