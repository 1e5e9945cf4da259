"""The detectors that a command's options name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message


def load_detectors(names: Sequence[str], weights: Sequence[Path] = (), *, flag: str = "--detectors") -> list[Detector]:
    """Detectors by name, each with its file of weights if there are any.

    Args:
        names: As `mi-splat detectors` lists them.
        weights: As many files, or none for the shipped or published weights.
        flag: Option that names them.

    Raises:
        InvalidValueError: There are other numbers of files, no names, or the same twice.
        DetectorError: A detector cannot be loaded.
    """
    if not names or len(set(names)) < len(names):
        raise InvalidValueError(message(flag, "different names", list(names), "see `mi-splat detectors`"))
    if weights and len(weights) != len(names):
        do = f"pass one for each of {', '.join(names)}"
        raise InvalidValueError(message("--weights", f"{len(names)} files", len(weights), do))
    files: Sequence[Path | None] = weights or [None] * len(names)
    return [load_detector(name, weights=file) for name, file in zip(names, files, strict=True)]
