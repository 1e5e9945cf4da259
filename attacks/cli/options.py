"""What the options of several commands take; light, so that --help is fast."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from attacks.objectives import OBJECTIVES
from mi_splat.cli.console import UsageError
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import Fraction, Metavar, between, check_choice

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.detectors.base import Detector
    from mi_splat.cli.sources import FindBoxes

DEFAULT_OBJECT = "car"
"""Part that is attacked if nothing else is said."""
DEFAULT_TARGET = "person"
"""Class that detectors shall see there if nothing else is said."""


def check_names(options: Any) -> None:
    """Raise unless detectors are known, they know the classes, and the aim can be
    one.
    """
    given = {
        field.name: getattr(options, field.name)
        for field in dataclasses.fields(options)
    }
    # which an attack from Python may have, as a control
    if 0 in getattr(given.get("config"), "eps", ()):
        raise UsageError.of("--eps", "a number > 0", 0, "5 is the paper's")
    objective = given.get("objective", "relabel")
    target = given.get("target")
    weights = given.get("weights")
    if objective != "relabel":
        try:
            check_choice("--objective", objective, tuple(OBJECTIVES))
        except InvalidValueError as error:
            raise UsageError(str(error)) from None
    if target is not None and not OBJECTIVES[objective].targeted:
        raise UsageError.of(
            "--target", f"none with --objective {objective}", target, "leave one out"
        )
    named = given.get("detectors") or given.get("detector") or ()
    names = (named,) if isinstance(named, str) else named
    if isinstance(weights, tuple):
        check_detectors(names, weights)
    if not names:
        return
    # not for commands that have none
    from attacks.detectors.registry import detector_spec

    known = {name: detector_spec(name).classes for name in names}
    for flag in ("original", "target"):
        # a file of weights may have other classes
        for name in names if not weights else ():
            check_class(given.get(flag) or (), name, known[name], what=f"--{flag}")
    if objective == "relabel" and {"target", "selection"} <= set(given):
        # who judges takes nothing for granted
        attacks = "original" not in given
        selection = given["selection"]
        if selection.is_empty and attacks:
            part = DEFAULT_OBJECT
        else:
            part = selection.object or ""
        own = given.get("original") or (part.replace("_", " "),)
        name = target or (DEFAULT_TARGET if attacks else None)
        if name in own:
            do = "name another class with --target"
            raise InvalidValueError.of(
                "--target", f"another class than the object's, {name}", name, do
            )


def check_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> None:
    """Raise if a detector is named twice, or there are weights of some only."""
    if len(set(names)) < len(names):
        raise InvalidValueError.of(
            "--detectors", "different names", list(names), "see `mi-splat detectors`"
        )
    if weights and names and len(weights) != len(names):
        do = f"pass one for each of {', '.join(names)}"
        raise InvalidValueError.of("--weights", f"{len(names)} files", len(weights), do)


def check_class(
    names: str | Sequence[str], detector: str, classes: Sequence[str], *, what: str
) -> None:
    """Raise if a detector does not know a class, or of several, any."""
    wanted = [names] if isinstance(names, str) else names
    if wanted and not set(wanted) & set(classes):
        name = wanted[0]
        expected = f"one of {', '.join(classes)} for {detector}"
        do = "name a class that it knows"
        raise InvalidValueError.of(what, expected, name, nearest(name, classes, do))


def load_detectors(
    names: Sequence[str], weights: Sequence[Path] = (), device: str = "cpu"
) -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any."""
    from attacks.detectors import load_detector

    files = weights_of(names, weights)
    return [
        load_detector(name, weights=files.get(name), device=device) for name in names
    ]


def weights_of(names: Sequence[str], weights: Sequence[Path]) -> dict[str, Path]:
    """The files of weights by the names of their detectors; empty for the shipped or
    published ones.
    """
    if not names:
        raise InvalidValueError.of(
            "--detectors", "one name or more", "none", "see `mi-splat detectors`"
        )
    check_detectors(names, weights)
    if weights:
        return dict(zip(names, weights, strict=True))
    return {}


_FOUND = 0.3
"""Confidence from which a detection says where an object is: boxes of true objects in
photographs often have less than 0.5, and a wrong one among many is outvoted.
"""


def box_finder(
    names: Sequence[str], weights: Sequence[Path] = (), device: str = "cpu"
) -> FindBoxes:
    """What finds boxes of some classes in an image by detectors, which are loaded when
    the first image is looked at.
    """
    loaded: list[Detector] = []

    def find(image: Tensor, classes: Sequence[str]) -> list[Tensor]:
        if not loaded:
            loaded.extend(load_detectors(names, weights, device))
            check_any_class(classes, loaded)
        reports = [detector.detect(image[None].to(device))[0] for detector in loaded]
        found = []
        for report in reports:
            pairs = zip(report.labels, report.scores.tolist(), strict=True)
            kept = [
                number
                for number, (label, score) in enumerate(pairs)
                if label in classes and score >= _FOUND
            ]
            found.append(report.boxes[kept].detach().cpu())
        return found

    return find


def check_any_class(classes: Sequence[str], detectors: Sequence[Detector]) -> None:
    """Raise unless each class is known to one of the detectors."""
    for name in classes:
        if not any(name in detector.classes for detector in detectors):
            check_class(name, detectors[0].name, detectors[0].classes, what="--detect")


Detectors = Annotated[tuple[str, ...], Metavar("DETECTOR")]
ClassName = Annotated[str, Metavar("CLASS")]
Confidence = Annotated[Fraction, Metavar("CONFIDENCE")]
Address = Annotated[str, Metavar("ADDRESS")]
Workers = Annotated[int, between(0, 1024, "processes")]
_WORKER = 2e9
"""Bytes of memory that a process takes which trains or attacks."""


def chosen_workers(asked: int | None) -> int:
    """Number of processes that do jobs side by side: one for each core if None and the
    memory allows.
    """
    if asked is not None:
        return asked
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(
        1,
        min(
            cores,
            int(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / _WORKER),
        ),
    )


def check_result_folder(folder: Path) -> None:
    """Raise unless a command may have written its result there."""
    if not any(folder.glob("*.json")):
        got = (
            "one without a result"
            if folder.is_dir()
            else f"a file; pass {folder.parent}"
            if folder.is_file()
            else ""
        )
        expected = "a folder that a command of mi-splat has written"
        raise InvalidValueError.of(
            str(folder), expected, got or "nothing there", "check the path"
        )


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """The detectors that a command uses."""

    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Weight files, one for each detector. Default: the shipped or published ones."""
