"""The splats of a study of CLOAK seen again, by cameras.json and its detectors or others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from attacks.artifacts.cloak_rows import DETECTIONS, columns, study_rows
from attacks.artifacts.contents import Contents
from attacks.artifacts.detection_rows import detection_cells, detections_of, object_box
from attacks.artifacts.figures import Line
from attacks.artifacts.packed import OnView, Packed
from attacks.artifacts.places import checked_splat, places_of
from attacks.artifacts.rows import Row, Table
from attacks.artifacts.study_results import study_of
from attacks.cloak.config import StudyConfig
from attacks.cloak.observations import frame, score_cells, scored
from attacks.cloak.rates import Rates, rates
from attacks.detectors.base import Detector
from attacks.objectives import confidence
from attacks.observe.drawing import listed
from attacks.observe.views import ViewDetections
from mi_splat.errors import InvalidValueError, message

RATE_TOLERANCE = 0.02
"""How far a rate may move: another machine rounds otherwise, and a score near the threshold crosses it."""
_PLACE = ("splat", "seed", "detector", "view")
"""Columns that say which picture a row is of."""


def look_again(packed: Packed, detectors: Sequence[Detector], on_view: OnView) -> dict[str, Table]:
    """Every detection on every splat of a study, as a table.

    Args:
        packed: The study.
        detectors: Its detectors, with the weights that it used.
        on_view: Told of the progress.

    Raises:
        InvalidValueError: A splat is not there any more, or a detector is another one.
    """
    contents = packed.contents
    for detector in detectors:
        known = contents.detectors.get(detector.name)
        if known != detector.fingerprint:
            expected, do = f"the weights {known} of the study", "pass them with --weights"
            raise InvalidValueError(message(f"detector {detector.name}", expected, detector.fingerprint, do))
    places = places_of(packed.cameras or {}, "cameras")
    views, rows = range(len(places.cameras)), list[Row]()
    total = len(views) * len(detectors) * len(contents.splats)
    done = 0
    for entry, path in zip(contents.splats, packed.splats.values(), strict=True):
        if path is None:
            expected, do = f"the {entry['splat']} splat, seed {entry['seed']}", "pass the folder of stages"
            raise InvalidValueError(message("splats", expected, "none", do)).hinted("--stages")
        for one in places.look(checked_splat(path, entry), detectors, views):
            rows += _rows(entry, one)
            done += 1
            on_view(done, total)
    study = study_of(contents.configuration, "configuration")
    return {DETECTIONS: Table(columns=columns(study)[DETECTIONS], rows=tuple(rows))}


def _rows(entry: Mapping[str, Any], seen: ViewDetections) -> Iterator[Row]:
    """A row for each detection of a picture; one with an empty detection where there is none."""
    box = None if seen.box is None else seen.box.tolist()
    reported: list[dict[str, Any] | None] = [*listed(seen.detections)]
    for found in reported or [None]:
        place = {"splat": entry["splat"], "seed": entry["seed"], "detector": seen.detector, "view": seen.view}
        yield {**place, **detection_cells(found, box)}


def agreement(contents: Contents) -> list[Line]:
    """A line for each detector: whether its detections give the rates that the rows of observations give."""
    if DETECTIONS not in contents.tables:
        return []
    study = study_of(contents.configuration, "configuration")
    before = study_rows(study, contents.splats, contents.tables).rows
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in contents.tables[DETECTIONS].rows:
        groups.setdefault(tuple(row[name] for name in _PLACE), []).append(row)
    after = frame(_scored_again(study, row, groups) for row in before.iter_rows(named=True))
    old, new = (rates(study, rows, ("detector",)) for rows in (before, after))
    return [_agreement_line(name, found, new[name,]) for (name,), found in old.items()]


def _scored_again(study: StudyConfig, row: Row, groups: Mapping[tuple[Any, ...], Sequence[Row]]) -> dict[str, Any]:
    """A row with the scores that single detections give."""
    reported, box = groups.get(tuple(row[name] for name in _PLACE)), object_box(row)
    found = None if reported is None else detections_of(reported)

    def on_object(label: str | None = None, *, iou: float = 0.5) -> float:
        if found is None or box is None:
            return 0.0
        return confidence(found, box, labels=None if label is None else [label], iou=iou)

    return {**row, **score_cells(scored(study, on_object))}


def _agreement_line(detector: str, old: Rates, new: Rates) -> Line:
    moves = [
        abs(now.fraction - then.fraction)
        for now, then in zip(new.values(), old.values(), strict=True)
        if now is not None and then is not None
    ]
    largest = max(moves, default=0.0)
    words = f"give its rates within {largest:.1%}, may differ by {RATE_TOLERANCE:.1%}"
    return Line(name=f"detections of {detector}", words=words, passed=largest <= RATE_TOLERANCE)
