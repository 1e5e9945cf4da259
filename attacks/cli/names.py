"""The detectors, classes and aims that a command's options name: checked together before torch is loaded, then loaded.

One set of rules for every command, by the name of the option.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.cli.console import UsageError, warn
from mi_splat.errors import InvalidValueError, message, nearest

if TYPE_CHECKING:
    from attacks.detectors.base import Detector

DEFAULT_OBJECT = "car"
"""Part that is attacked if nothing else is said."""
DEFAULT_TARGET = "person"
"""Class that detectors shall see there if nothing else is said."""
ENDINGS = ("_small", "_coco")
"""Of the names of the project's own detectors, and of those that `mi-splat detectors --get` fetches."""


def check_names(options: object) -> None:
    """Raise unless detectors are known, they know the classes, and the aim can be one.

    Args:
        options: A dataclass of a command's options.

    Raises:
        DetectorError: There is no such detector.
        InvalidValueError: A detector is named twice, files of weights are too many or too few, a detector does not know
            a class, or the class wanted is what the object is.
        UsageError: A class is wanted beside an objective that wants none, or nothing may change.
    """
    radii = getattr(getattr(options, "config", None), "eps", ())
    if 0 in radii:  # which an attack from Python may have, as a control
        raise UsageError(message("--eps", "a number > 0", 0, "5 is the paper's"))
    objective, target = getattr(options, "objective", "relabel"), getattr(options, "target", None)
    if objective != "relabel" and target is not None:
        do = "leave one out"
        raise UsageError(message("--target", f"none beside --objective {objective}", target, do))
    names = _detectors(options)
    weights = getattr(options, "weights", None)
    if len(names) > 1 or isinstance(weights, tuple):
        check_detectors(names, weights or ())
    asked = (*names, *_others(options))
    if not asked:
        return
    from attacks.detectors.registry import detector_spec  # not for commands that have none

    known = {name: detector_spec(name).classes for name in asked}
    for flag in ("original", "target"):
        for name in names if not weights else ():  # a file of weights may have other classes
            check_class(getattr(options, flag, None), name, known[name], what=f"--{flag}")
    if hasattr(options, "target") and objective == "relabel":
        _check_new(options, target)


def check_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> None:
    """Raise if a detector is named twice, or there are weights of some only.

    Args:
        names: Of detectors.
        weights: As many files, or none.

    Raises:
        InvalidValueError: There are other numbers of files, or the same name twice.
    """
    if len(set(names)) < len(names):
        raise InvalidValueError(message("--detectors", "different names", list(names), "see `mi-splat detectors`"))
    if weights and names and len(weights) != len(names):
        do = f"pass one for each of {', '.join(names)}"
        raise InvalidValueError(message("--weights", f"{len(names)} files", len(weights), do))


def check_class(name: str | None, detector: str, classes: Sequence[str], *, what: str) -> None:
    """Raise if a detector does not know a class.

    Args:
        name: Of the class; None for none.
        detector: Name of the detector.
        classes: Those that it knows.
        what: Where the class was named.

    Raises:
        InvalidValueError: It does not know the class.
    """
    if name is not None and name not in classes:
        expected, do = f"one of {', '.join(classes)} for {detector}", "name a class that it knows"
        raise InvalidValueError(message(what, expected, name, nearest(name, classes, do)))


def load_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any.

    Args:
        names: As `mi-splat detectors` lists them.
        weights: As many files, or none for the shipped or published weights.

    Raises:
        InvalidValueError: There are other numbers of files, no names, or the same twice.
        DetectorError: A detector cannot be loaded.
    """
    from attacks.detectors import load_detector

    files = weights_of(names, weights)
    return [load_detector(name, weights=files.get(name)) for name in names]


def weights_of(names: Sequence[str], weights: Sequence[Path]) -> dict[str, Path]:
    """The files of weights by the names of their detectors; empty for the shipped or published ones.

    Raises:
        InvalidValueError: As in `load_detectors`.
    """
    if not names:
        raise InvalidValueError(message("--detectors", "one name or more", "none", "see `mi-splat detectors`"))
    check_detectors(names, weights)
    return dict(zip(names, weights, strict=True)) if weights else {}


def loadable() -> list[str]:
    """Names of the project's own detectors, and of those that others trained, that can be loaded here.

    Says which cannot, and why.
    """
    from attacks.detectors.registry import DETECTORS

    names = []
    for name in DETECTORS:
        if name.endswith(ENDINGS):
            missing = DETECTORS[name].missing()
            if missing:
                warn(f"{name} is left out: {missing}")
            else:
                names.append(name)
    return names


def _detectors(options: object) -> tuple[str, ...]:
    """Names of the detectors that a command uses."""
    named: Any = getattr(options, "detectors", None) or getattr(options, "detector", None) or ()
    return (named,) if isinstance(named, str) else tuple(named)


def _others(options: object) -> tuple[str, ...]:
    """Names of detectors that are used beside these."""
    surrogate = getattr(options, "surrogate", "none")
    return (surrogate,) if surrogate not in ("none", "auto") else ()


def _check_new(options: object, target: str | None) -> None:
    """Raise if the class wanted is what the object is by its own name."""
    selection: Any = getattr(options, "selection", None)
    if selection is None:
        return
    attacks = not hasattr(options, "original")  # the other command judges, and takes nothing for granted
    named = DEFAULT_OBJECT if selection.is_empty and attacks else selection.object
    name = getattr(options, "original", None) or (named or "").replace("_", " ")
    wanted = target or (DEFAULT_TARGET if attacks else None)
    if wanted is not None and wanted == name:
        do = "name another class with --target"
        raise InvalidValueError(message("--target", f"another class than the object's, {name}", wanted, do))
