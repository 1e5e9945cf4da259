"""The detectors, classes and aims that a command's options name: checked together before torch is loaded, then loaded.

One set of rules for every command, by the name of the option.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.aims import OBJECTIVES
from mi_splat.cli.console import UsageError
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import check_choice

if TYPE_CHECKING:
    from attacks.detectors.base import Detector

DEFAULT_OBJECT = "car"
"""Part that is attacked if nothing else is said."""
DEFAULT_TARGET = "person"
"""Class that detectors shall see there if nothing else is said."""


def check_names(options: Any) -> None:
    """Raise unless detectors are known, they know the classes, and the aim can be one."""
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    if 0 in getattr(given.get("config"), "eps", ()):  # which an attack from Python may have, as a control
        raise UsageError.of("--eps", "a number > 0", 0, "5 is the paper's")
    objective, target, weights = given.get("objective", "relabel"), given.get("target"), given.get("weights")
    if objective != "relabel":
        try:
            check_choice("--objective", objective, tuple(OBJECTIVES))
        except InvalidValueError as error:
            raise UsageError(str(error)) from None
    if target is not None and not OBJECTIVES[objective].targeted:
        raise UsageError.of("--target", f"none beside --objective {objective}", target, "leave one out")
    named = given.get("detectors") or given.get("detector") or ()
    names = (named,) if isinstance(named, str) else named
    if isinstance(weights, tuple):
        check_detectors(names, weights)
    surrogate = given.get("surrogate", "none")
    asked = (*names, *([surrogate] if surrogate not in ("none", "auto") else []))
    if not asked:
        return
    from attacks.detectors.registry import detector_spec  # not for commands that have none

    known = {name: detector_spec(name).classes for name in asked}
    for flag in ("original", "target"):
        for name in names if not weights else ():  # a file of weights may have other classes
            check_class(given.get(flag), name, known[name], what=f"--{flag}")
    if objective == "relabel" and {"target", "selection"} <= set(given):
        attacks, selection = "original" not in given, given["selection"]  # who judges takes nothing for granted
        part = DEFAULT_OBJECT if selection.is_empty and attacks else selection.object or ""
        name = given.get("original") or part.replace("_", " ")
        if name and name == (target or (DEFAULT_TARGET if attacks else None)):
            do = "name another class with --target"
            raise InvalidValueError.of("--target", f"another class than the object's, {name}", name, do)


def check_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> None:
    """Raise if a detector is named twice, or there are weights of some only."""
    if len(set(names)) < len(names):
        raise InvalidValueError.of("--detectors", "different names", list(names), "see `mi-splat detectors`")
    if weights and names and len(weights) != len(names):
        do = f"pass one for each of {', '.join(names)}"
        raise InvalidValueError.of("--weights", f"{len(names)} files", len(weights), do)


def check_class(name: str | None, detector: str, classes: Sequence[str], *, what: str) -> None:
    """Raise if a detector does not know a class."""
    if name is not None and name not in classes:
        expected, do = f"one of {', '.join(classes)} for {detector}", "name a class that it knows"
        raise InvalidValueError.of(what, expected, name, nearest(name, classes, do))


def load_detectors(names: Sequence[str], weights: Sequence[Path] = (), device: str = "cpu") -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any."""
    from attacks.detectors import load_detector

    files = weights_of(names, weights)
    return [load_detector(name, weights=files.get(name), device=device) for name in names]


def weights_of(names: Sequence[str], weights: Sequence[Path]) -> dict[str, Path]:
    """The files of weights by the names of their detectors; empty for the shipped or published ones."""
    if not names:
        raise InvalidValueError.of("--detectors", "one name or more", "none", "see `mi-splat detectors`")
    check_detectors(names, weights)
    return dict(zip(names, weights, strict=True)) if weights else {}
