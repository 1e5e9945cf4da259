"""The detectors that a command's options name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attacks.cli.names import check_detectors
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import warn
from mi_splat.errors import InvalidValueError, message

OWN = ("_small", "_coco")
"""Endings of the names of the project's own detectors, and of those that `mi-splat detectors --get` fetches."""


def load_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any.

    Args:
        names: As `mi-splat detectors` lists them.
        weights: As many files, or none for the shipped or published weights.

    Raises:
        InvalidValueError: There are other numbers of files, no names, or the same twice.
        DetectorError: A detector cannot be loaded.
    """
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
    names = []
    for name in DETECTORS:
        if name.endswith(OWN):
            missing = DETECTORS[name].missing()
            if missing:
                warn(f"{name} is left out: {missing}")
            else:
                names.append(name)
    return names
