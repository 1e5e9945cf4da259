"""A finished attack on a distribution of views as an artifact."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import Contents, read_object
from attacks.artifacts.dagger_results import broken, contents_of, objective_of, splat_of
from attacks.artifacts.detection_rows import OBJECT
from attacks.artifacts.packed import Kind, Packed
from attacks.artifacts.rows import Cell, Column, Row, Table
from attacks.dagger.eot.judging import joint_rate
from attacks.dagger.eot.report import AZIMUTHS, ELEVATIONS
from attacks.dagger.eot.result import binned
from attacks.evaluation.rates import Rate
from attacks.objectives import Relabel
from mi_splat.io.folders import RECORD as RESULT

ROWS = "rows"
_NOISE = "noise_score_"
_STATED = (
    *("image_psnr", "psnr_definition", "image", "noise_psnr", "steps", "used", "used_in_file"),
    *("changed_gaussians", "object_gaussians", "redraws", "warnings"),
)
_FOUND = 0.5
"""Confidence from which the object counts as found, as in `attacks.dagger.eot.result.found_rate`."""


def pack(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of a finished attack holds; the arguments are those of `attacks.artifacts.packed.Pack`.

    Raises:
        InvalidValueError: The folder holds no such result.
    """
    result = read_object(folder / RESULT)
    try:
        draws = int(result["config"]["noise_draws"])
        rows = tuple(_row(view, result["rates"][view["detector"]]["original"]) for view in result["views"])
        table = Table(columns=_columns(draws), rows=rows)
        contents = contents_of(result, {ROWS: table}, result["detectors"], _STATED)
        keys = ("success", "rate", "rates", "clean_rate", "noise_rate", "unambiguous_rate")
        figures = {key: result[key] for key in (*keys, "by_azimuth", "by_elevation")}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise broken(folder / RESULT, error) from error
    return Packed(contents=contents, figures=figures, splats=splat_of(folder))


def derive(contents: Contents) -> Mapping[str, Any]:
    """Every rate of the attack, of its rows alone.

    Raises:
        InvalidValueError: The rows are not those of the attack.
    """
    rows, config = contents.tables[ROWS].rows, contents.configuration["config"]
    reached = _reached(contents)
    try:
        rate = _joint(rows, lambda row: [bool(row["success"])])
        clean = _joint(rows, lambda row: [reached(row["clean_score"])])
        noise = _joint(rows, lambda row: [reached(score) for score in _noise(row)])
        interval = tuple(map(float, config["judged"]["cameras"]["elevations"]))
        return {
            "success": rate.fraction >= config["required_views"] - 1e-9,
            "rate": rate.as_dict(),
            "rates": {name: _of_detector(rows, name, reached) for name in contents.detectors},
            "clean_rate": clean.as_dict(),
            "noise_rate": noise.as_dict(),
            "unambiguous_rate": _joint(rows, lambda row: [bool(row["unambiguous"])]).as_dict(),
            "by_azimuth": _binned(rows, "azimuth", (0.0, 360.0), AZIMUTHS),
            "by_elevation": _binned(rows, "elevation", (interval[0], interval[1]), ELEVATIONS),
        }
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise broken("rows", error) from error


def columns(contents: Contents) -> Mapping[str, Sequence[Column]]:
    """The table of such an artifact."""
    try:
        return {ROWS: _columns(min(int(contents.configuration["config"]["noise_draws"]), 1000))}
    except (KeyError, TypeError, ValueError) as error:
        raise broken("configuration", error) from error


def _columns(draws: int) -> tuple[Column, ...]:
    def confidence(name: str, meaning: str, *, optional: bool = False) -> Column:
        return Column(name=name, kind="number", meaning=meaning, optional=optional)

    return (
        Column(name="index", kind="whole", meaning="number of the held-out view, from 0"),
        Column(name="detector", kind="text", meaning="name of the detector"),
        Column(name="original", kind="text", meaning="what it calls the clean object in most views", optional=True),
        Column(name="azimuth", kind="number", unit="degrees", meaning="of the camera, from +x towards +y"),
        Column(name="elevation", kind="number", unit="degrees", meaning="of the camera"),
        *(Column(name=name, kind="number", unit="world units", meaning="of the camera") for name in "xyz"),
        *(Column(name=name, kind="number", unit="pixels", meaning="of the object's box") for name in OBJECT),
        Column(name="success", kind="truth", meaning="whether the aim is reached in the attacked picture"),
        Column(name="unambiguous", kind="truth", meaning="whether so, and no other class has more confidence there"),
        confidence("score", "how near the aim is, attacked, in [0, 1]"),
        confidence("clean_score", "how near the aim is without any attack"),
        confidence("target_confidence", "in the target on the attacked object", optional=True),
        confidence("clean_confidence", "in the original class on the clean object"),
        confidence("original_confidence", "in the original class on the attacked object"),
        *(confidence(f"{_NOISE}{draw}", "how near the aim is with random noise") for draw in range(draws)),
    )


def _row(view: Mapping[str, Any], original: str | None) -> Row:
    same = ("index", "detector", "azimuth", "elevation", "success", "unambiguous", "score", "clean_score")
    confidences = ("target_confidence", "clean_confidence", "original_confidence")
    row: dict[str, Cell] = {name: view[name] for name in (*same, *confidences)}
    row |= {"original": original}
    row |= dict(zip("xyz", view["position"], strict=True))
    row |= dict(zip(OBJECT, view["box"], strict=True))
    return row | {f"{_NOISE}{draw}": score for draw, score in enumerate(view["noise_scores"])}


def _noise(row: Row) -> list[Cell]:
    return [value for name, value in row.items() if name.startswith(_NOISE)]


def _reached(contents: Contents) -> Callable[[Cell], bool]:
    """Whether a score reaches the aim."""
    objective: Any = objective_of(contents)
    if isinstance(objective, Relabel):
        return lambda score: _number(score) >= objective.confidence
    return lambda score: 1.0 - _number(score) < objective.confidence


def _number(value: Cell) -> float:
    return float(value) if isinstance(value, float) else 0.0


def _joint(rows: Sequence[Row], holds: Callable[[Row], Sequence[bool]]) -> Rate:
    """Views in which something holds for all detectors at once."""
    return joint_rate((int(row["index"]), holds(row)) for row in rows)  # type: ignore[arg-type]


def _of_detector(rows: Sequence[Row], name: str, reached: Callable[[Cell], bool]) -> dict[str, Any]:
    """What one detector reports."""
    own = [row for row in rows if row["detector"] == name]
    original = next(iter(own))["original"] if own else None

    def found(column: str) -> dict[str, Any]:
        return Rate.of(own, lambda row: original is not None and _number(row[column]) >= _FOUND).as_dict()

    return {
        "original": original,
        "success": _joint(own, lambda row: [bool(row["success"])]).as_dict(),
        "noise": _joint(own, lambda row: [reached(score) for score in _noise(row)]).as_dict(),
        "clean": _joint(own, lambda row: [reached(row["clean_score"])]).as_dict(),
        "found_clean": found("clean_confidence"),
        "found_attacked": found("original_confidence"),
    }


def _binned(rows: Sequence[Row], name: str, interval: tuple[float, float], parts: int) -> list[dict[str, Any]]:
    return binned([(_number(row[name]), bool(row["success"])) for row in rows], interval, parts)


KIND = Kind(pack=pack, derive=derive, columns=columns)
