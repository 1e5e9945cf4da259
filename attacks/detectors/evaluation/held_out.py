"""A detector on held-out pictures: average precision, recall by how objects are seen, false positives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.detectors.base import Detector
from attacks.detectors.catalogue import SMALL_CLASSES, DetectorError
from attacks.detectors.evaluation.measure import Measurement, confidences_at, false_positives, measure_detector
from attacks.detectors.registry import load_detector
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from attacks.detectors.training.dataset import OnWork, background_sets, load, make, splat_set
from attacks.detectors.training.pictures import LabelledPicture
from mi_splat.errors import message

MIN_CONFIDENCE = 0.001
"""Confidence of detections that count in an average precision, of detectors whose floor can be chosen.

The floor of 0.25 that ultralytics' detectors have otherwise would cut the curve off.
"""

PATH_TRACED, SPLAT_RENDERS, BACKGROUND = "path traced", "splat renders", "background: "
"""What the sets are called; the kind of background follows."""

EQUAL = (0.01, 0.1, 1.0)
"""False positives per picture at which detectors are equally strict."""

_FIRST_SPLAT = 10_000
"""Number of the first scene that is made into a splat: none of the path-traced scenes."""


def load_for_evaluation(name: str, weights: Path | None = None) -> Detector:
    """A detector of the project's classes that keeps its unlikely detections too, as an average precision needs them.

    Where `min_confidence` is an attribute of the detector it is lowered; others keep theirs, 0.05 for most.

    Raises:
        DetectorError: It does not know all of the project's classes, its weights are missing or do not fit, or it needs
            a package that is not there.
    """
    detector: Any = load_detector(name, weights=weights)
    missing = [label for label in SMALL_CLASSES if label not in detector.classes]
    if missing:
        got, do = f"one without {', '.join(missing)}", "the pictures show these; choose another detector"
        raise DetectorError(message(f"detector {name}", f"one of {', '.join(SMALL_CLASSES)}", got, do))
    if "min_confidence" in getattr(detector, "__dict__", {}):
        detector.min_confidence = MIN_CONFIDENCE
    return detector  # type: ignore[no-any-return]


def held_out_sets(
    folder: Path,
    scenes: PictureSetConfig,
    *,
    splats: int,
    splat: SplatConfig,
    backgrounds: BackgroundConfig,
    processes: int,
    on_work: OnWork,
) -> dict[str, list[LabelledPicture]]:
    """Held-out pictures by set: path traced, renders of splats, and each kind of background.

    Args:
        folder: Where the pictures are kept; what is missing is made.
        scenes: Scenes with objects, and how many pictures of them.
        splats: Number of further such scenes that are made into splats; 0 leaves them out.
        splat: How splats are made.
        backgrounds: Pictures without objects.
        processes: How many processes make path-traced pictures; 0 makes them in this one.
        on_work: Called as pictures are made.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """

    def step(text: str) -> Callable[[int, int], None]:
        return lambda done, total: on_work(text, done, total)

    make(scenes, folder / scenes.split, processes=processes, on_step=step("path-traced pictures"))
    sets = {PATH_TRACED: load(folder / scenes.split, limit=scenes.count)} if scenes.count else {}
    if splats:
        numbers = range(_FIRST_SPLAT, _FIRST_SPLAT + splats)
        sets[SPLAT_RENDERS] = splat_set(scenes, numbers, folder / "splats", splat, on_step=step("splats"))
    empty = background_sets(folder / "backgrounds", backgrounds, on_step=step("backgrounds"))
    return sets | {f"{BACKGROUND}{kind}": pictures for kind, pictures in empty.items() if pictures}


def measure_sets(
    detector: Detector, sets: Mapping[str, Sequence[LabelledPicture]], *, confidence: float = 0.5
) -> dict[str, Measurement]:
    """Run a detector over sets of labelled pictures, whose labels count from 1 in SMALL_CLASSES.

    Args:
        detector: Knows these classes, and others if it likes.
        sets: Name to pictures of one size.
        confidence: Least confidence of a false positive, and of an object that is found.
    """
    return {name: measure_detector(detector, pictures, confidence=confidence) for name, pictures in sets.items()}


def total_false_positives(measured: Mapping[str, Measurement]) -> dict[str, dict[str, Any]]:
    """False positives of the project's sets together: with objects, without any, and all; empty ones are absent.

    `confidence_at` says from which confidence there are so many per picture (`confidences_at`): rates that count from
    there compare detectors that are equally strict.
    """
    with_objects = [part for name, part in measured.items() if name in (PATH_TRACED, SPLAT_RENDERS)]
    without = [part for name, part in measured.items() if name.startswith(BACKGROUND)]
    totals = {"with objects": with_objects, "without objects": without, "all": [*with_objects, *without]}
    return {
        name: {**false_positives(sets), "confidence_at": confidences_at(sets, EQUAL)}
        for name, sets in totals.items()
        if sets
    }
