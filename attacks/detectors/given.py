"""Detectors as callers give them: values or names, one or several."""

from __future__ import annotations

from collections.abc import Sequence

from attacks.detectors.base import Detector
from attacks.detectors.errors import DetectorError
from attacks.detectors.registry import load_detector
from mi_splat.errors import message


def as_detectors(detectors: Detector | str | Sequence[Detector | str]) -> tuple[Detector, ...]:
    """The detectors as a tuple, whether one was given or several; those given by name are loaded.

    Raises:
        DetectorError: As in `load_detector`, or something else is among them.
    """
    given = detectors if isinstance(detectors, Sequence) and not isinstance(detectors, str) else [detectors]
    return tuple(_as_detector(one) for one in given)


def _as_detector(detector: object) -> Detector:
    if isinstance(detector, str):
        return load_detector(detector)
    if not isinstance(detector, Detector):
        got = type(detector).__name__
        raise DetectorError(message("detector", "a Detector or its name", got, "see attacks.detectors.Detector"))
    return detector
