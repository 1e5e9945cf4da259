"""Scoring the splats of a result again: needs the splats, cameras.json and a detector, and nothing else."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.detectors.base import Detector
from attacks.observe.result_cameras import CAMERAS, ResultCameras, result_cameras
from attacks.observe.rows import ROWS, Row, frame_of
from attacks.observe.views import ViewDetections
from attacks.rate import Rate
from attacks.report.checking import Check, Result
from mi_splat.errors import InvalidValueError
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
    """Render the splats of a result, let detectors look, and say how every rate moved."""
    if rescoring is None:
        do = "score one of its attacks again"
        raise InvalidValueError.of(str(result.folder), "one attack, or a study of CLOAK", result.story, do)
    file = result.folder / CAMERAS
    cameras = result_cameras(DocumentReader(do="get the result again").read_json(file), str(file))
    scenes = _scenes(result, rescoring, splats)
    rows = result.tables[ROWS]
    if rows["view"].max() != len(cameras.cameras) - 1:
        got, do = f"{len(cameras.cameras)} cameras", "get the result again"
        raise InvalidValueError.of(str(file), "the cameras of the rows", got, do)
    views = rows["view"].unique().sort().to_list()[::every]
    before = rows.filter(pl.col("view").is_in(views), pl.col("seed").is_in([seed for _, seed in scenes]))
    seen, total = list[Row](), len(views) * len(detectors) * len(scenes)
    for row in _seen_again(result.record, rescoring, detectors, cameras, scenes, before):
        seen.append(row)
        on_view(len(seen), total)
    again = pl.col("detector").is_in([detector.name for detector in detectors])
    again &= pl.col("splat").is_in([splat for splat, _ in scenes])
    after = pl.concat([before.filter(~again), frame_of(seen)], how="diagonal")
    then, now = (rescoring.rates(result.record, frame) for frame in (before, after))
    weights = fingerprints(result.record)
    return [
        _moved(
            f"{detector.name}, {words}",
            then.get(detector.name, {}).get(words) if detector.name in weights else None,
            rate,
            rate_tolerance,
            "" if weights.get(detector.name) == detector.fingerprint else "; other weights than the result's",
        )
        for detector in detectors
        for words, rate in now.get(detector.name, {}).items()
    ]


def _seen_again(
    record: Mapping[str, Any],
    rescoring: Rescoring,
    detectors: Sequence[Detector],
    cameras: ResultCameras,
    scenes: Mapping[tuple[str, int], GaussianScene],
    before: pl.DataFrame,
) -> Iterator[Row]:
    """The rows that detectors give to splats today, in the views of the rows `before`."""
    views, named = before["view"].unique().sort().to_list(), {detector.name: detector for detector in detectors}
    rows = {(row["splat"], row["seed"], row["view"], row["detector"]): row for row in before.iter_rows(named=True)}
    of_view = {key[:3]: row for key, row in rows.items()}
    for (splat, seed), scene in scenes.items():
        for seen in cameras.look(scene, detectors, views, batch=rescoring.batch):
            # What another detector calls the object is not known: it counts as what one of the result's calls it.
            row = rows.get((splat, seed, seen.view, seen.detector), of_view[splat, seed, seen.view])
            yield {**row, "detector": seen.detector, **rescoring.cells(record, seen, row, named[seen.detector])}


def _moved(name: str, then: Rate | None, now: Rate, tolerance: float, other: str) -> Check:
    """How a rate moved from `then`, in the rows, to today; grey if they lack it. `other` tells of other weights."""
    if then is None:
        return Check(name=name, words=f"{now.successes}/{now.total}; not in the result", passed=None)
    by = abs(now.fraction - then.fraction) if now.total and then.total else float(now.total != then.total)
    words = (
        f"{then.successes}/{then.total} in the rows, {now.successes}/{now.total} now: moved by {by:.1%}, may move by "
        f"{tolerance:.1%}{other}"
    )
    return Check(name=name, words=words, passed=by <= tolerance)


def fingerprints(record: Mapping[str, Any]) -> dict[str, str]:
    """What stands for the weights of each detector of a result."""
    detectors = record.get("detectors")
    if isinstance(detectors, list):
        detectors = {judged["detector"]: judged["detector_fingerprint"] for judged in detectors}
    return {str(name): str(mark) for name, mark in detectors.items()} if isinstance(detectors, Mapping) else {}


def _scenes(result: Result, rescoring: Rescoring, splats: Path | None) -> dict[tuple[str, int], GaussianScene]:
    """The splats of a result, each with the SHA-256 that its manifest lists."""
    scenes, folder = {}, result.folder if splats is None else splats
    for key, name in rescoring.splats(result.record).items():
        path, entry = folder / name, result.manifest.files.get(name)
        if not path.is_file():
            do = "pass the folder with the splats"
            raise InvalidValueError.of(str(path), "a splat of the result", "none", do).hinted("--splats")
        if entry is None or sha256(path) != entry[0]:
            expected = f"the SHA-256 that the manifest lists of {name}"
            raise InvalidValueError.of(str(path), expected, "another", "pass the splat of this result")
        scenes[key] = load_splat(path)
    return scenes
