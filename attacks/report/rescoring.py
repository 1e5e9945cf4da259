"""Scoring the splats of a result again: needs the splats, cameras.json and a detector, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.detectors.base import Detector
from attacks.observe.places import CAMERAS, Places, places_of
from attacks.observe.rows import ROWS, Row, frame_of
from attacks.observe.views import ViewDetections
from attacks.rate import Rate
from attacks.report.checking import Check, Result, moved
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.io.documents import sha256
from mi_splat.io.parsing import DocumentReader
from mi_splat.scene import GaussianScene

RATE_TOLERANCE = 0.02
"""How far a rate may move: another machine rounds otherwise, and a score near the threshold crosses it."""

OnView = Callable[[int, int], None]
"""Told how many pictures were looked at, and of how many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rescoring:
    """How splats of one kind of result are scored again.

    Attributes:
        splats: Of its record: the file of each splat, by its name and seed in the rows.
        cells: From its record, what a detector reports in one view, and a row of that view: the cells that change.
        rates: From its record and rows, the rates of each detector by their names in words.
        batch: Pictures that a detector gets at once.
    """

    splats: Callable[[Mapping[str, Any]], Mapping[tuple[str, int], str]]
    cells: Callable[[Mapping[str, Any], ViewDetections, Mapping[str, Any], Detector], Row]
    rates: Callable[[Mapping[str, Any], pl.DataFrame], Mapping[str, Mapping[str, Rate]]]
    batch: int


def rescore(
    result: Result,
    rescoring: Rescoring | None,
    detectors: Sequence[Detector],
    *,
    splats: Path | None = None,
    every: int = 1,
    rate_tolerance: float = RATE_TOLERANCE,
    on_view: OnView = lambda done, total: None,
) -> list[Check]:
    """Render the splats of a result, let detectors look, and say how every rate moved.

    Args:
        result: The result.
        rescoring: How its kind is scored again; None if it is not.
        detectors: Those of the result or others.
        splats: Folder with the splats; None takes those in the result.
        every: Looks from each so manieth camera; the rates of the rows are then those of the same cameras.
        rate_tolerance: How far a rate may move.
        on_view: Told of the progress.

    Returns:
        A line for each detector and rate; grey for a detector that the result does not have.

    Raises:
        InvalidValueError: A splat is not there or another one, cameras.json is missing or broken, or the result is of a
            kind that is not scored again.
    """
    if rescoring is None:
        do = "score one of its attacks again"
        raise InvalidValueError(message(str(result.folder), "one attack, or a study of CLOAK", result.story, do))
    file = result.folder / CAMERAS
    places = places_of(DocumentReader(do="get the result again").read_json(file), str(file))
    scenes = _scenes(result, rescoring, splats)
    rows = result.tables[ROWS]
    if rows["view"].max() != len(places.cameras) - 1:
        got, do = f"{len(places.cameras)} cameras", "get the result again"
        raise InvalidValueError(message(str(file), "the cameras of the rows", got, do))
    views = rows["view"].unique().sort().to_list()[::every]
    before = rows.filter(pl.col("view").is_in(views))
    before = before.filter(pl.col("seed").is_in([seed for _, seed in scenes]))
    after = _looked(result, rescoring, detectors, (places, scenes, views), before, on_view)
    then, now = (rescoring.rates(result.record, frame) for frame in (before, after))
    return [line for one in detectors for line in _moves(result, one, then, now, rate_tolerance)]


def _looked(
    result: Result,
    rescoring: Rescoring,
    detectors: Sequence[Detector],
    where: tuple[Places, Mapping[tuple[str, int], GaussianScene], Sequence[int]],
    before: pl.DataFrame,
    on_view: OnView,
) -> pl.DataFrame:
    """The rows with what detectors report now; those of splats that are not looked at stay as they are.

    Args:
        result: The result.
        rescoring: How its kind is scored again.
        detectors: Those that look.
        where: Cameras, splats, and the numbers of the cameras.
        before: The rows of these cameras.
        on_view: Told of the progress.
    """
    places, scenes, views = where
    names = {detector.name: detector for detector in detectors}
    known = {(row["splat"], row["seed"], row["view"], row["detector"]): row for row in before.iter_rows(named=True)}
    anybody = {key[:3]: row for key, row in known.items()}
    found, total = list[Row](), len(views) * len(detectors) * len(scenes)
    for (splat, seed), scene in scenes.items():
        for done in places.look(scene, detectors, views, batch=rescoring.batch):
            # What another detector calls the object is not known: it counts as what one of the result's calls it.
            row = known.get((splat, seed, done.view, done.detector), anybody[splat, seed, done.view])
            cells = rescoring.cells(result.record, done, row, names[done.detector])
            found.append({**row, "detector": done.detector, **cells})
            on_view(len(found), total)
    looked = pl.col("detector").is_in(list(names)) & pl.any_horizontal(
        *(pl.col("splat") == splat for splat in {splat for splat, _ in scenes})
    )
    return pl.concat([before.filter(~looked), frame_of(found)], how="diagonal")


def _moves(
    result: Result,
    detector: Detector,
    then: Mapping[str, Mapping[str, Rate]],
    now: Mapping[str, Mapping[str, Rate]],
    tolerance: float,
) -> list[Check]:
    """A line for each rate of one detector."""
    weights = fingerprints(result.record).get(detector.name)
    other_weights = weights != detector.fingerprint
    return [
        moved(
            f"{detector.name}, {words}",
            None if weights is None else then.get(detector.name, {}).get(words),
            rate,
            tolerance=tolerance,
            other_weights=other_weights,
        )
        for words, rate in now.get(detector.name, {}).items()
    ]


def fingerprints(record: Mapping[str, Any]) -> dict[str, str]:
    """What stands for the weights of each detector of a result."""
    found = record.get("detectors")
    if isinstance(found, Mapping):
        return {str(name): str(mark) for name, mark in found.items()}
    if isinstance(found, list):
        return {str(one["detector"]): str(one["detector_fingerprint"]) for one in found}
    return {}


def _scenes(result: Result, rescoring: Rescoring, splats: Path | None) -> dict[tuple[str, int], GaussianScene]:
    """The splats of a result, each with the SHA-256 that its manifest lists."""
    found, folder = {}, result.folder if splats is None else splats
    for key, name in rescoring.splats(result.record).items():
        path, entry = folder / name, result.manifest.files.get(name)
        if not path.is_file():
            do = "pass the folder with the splats"
            raise InvalidValueError(message(str(path), "a splat of the result", "none", do)).hinted("--splats")
        if entry is None or sha256(path) != entry[0]:
            expected = f"the SHA-256 that the manifest lists of {name}"
            raise InvalidValueError(message(str(path), expected, "another", "pass the splat of this result"))
        found[key] = load_splat(path)
    return found
