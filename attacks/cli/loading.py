"""The detectors that a command's options name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attacks.cli.names import check_detectors
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message


def load_detectors(names: Sequence[str], weights: Sequence[Path] = ()) -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any.

    Args:
        names: As `mi-splat detectors` lists them.
        weights: As many files, or none for the shipped or published weights.

    Raises:
        InvalidValueError: There are other numbers of files, no names, or the same twice.
        DetectorError: A detector cannot be loaded.
    """
    if not names:
        raise InvalidValueError(message("--detectors", "one name or more", "none", "see `mi-splat detectors`"))
    check_detectors(names, weights)
    files: Sequence[Path | None] = weights or [None] * len(names)
    return [load_detector(name, weights=file) for name, file in zip(names, files, strict=True)]
