"""A finished attack on a distribution of views as an artifact."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from attacks.artifacts.contents import Contents, read_object
from attacks.artifacts.dagger_results import broken, cameras_of, contents_of, mask_of, objective_of, splat_of
from attacks.artifacts.detection_rows import OBJECT
from attacks.artifacts.packed import Kind, Outcome, Packed
from attacks.artifacts.rows import Cell, Column, Row, Table
from attacks.objectives import Relabel
from attacks.observe.measures import aim_figures
from attacks.observe.rows import ATTACKED, CLEAN, NOISE
from mi_splat.io.folders import RECORD as RESULT

ROWS = "rows"
_NOISE_SCORE, _NOISE_SUCCESS = "noise_score_", "noise_success_"
REFERENCE = "reference.json"
"""File in an artifact with the reference camera, as --cameras takes it."""
_STATED = (
    *("image_psnr", "psnr_definition", "image", "noise_psnr", "steps", "used", "used_in_file"),
    *("changed_gaussians", "object_gaussians", "redraws", "warnings"),
)
FIGURES = (
    *("success", "rate", "rates", "clean_rate", "noise_rate", "unambiguous_rate"),
    *("by_azimuth", "by_elevation"),
)
"""Keys of a result that follow from its rows."""


def pack(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of a finished attack holds; the arguments are those of `attacks.artifacts.packed.Pack`.

    Raises:
        InvalidValueError: The folder holds no such result.
    """
    result = read_object(folder / RESULT)
    try:
        reference = result.get("reference")
        contents = contents_of(
            result,
            tables_of(result),
            {entry["detector"]: entry["detector_fingerprint"] for entry in result["detectors"]},
            _STATED,
            folder=folder,
        )
        cameras = cameras_of(result, {int(view["index"]): view for view in result["views"]})
        figures = {key: result[key] for key in FIGURES}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise broken(folder / RESULT, error) from error
    return Packed(
        contents=contents,
        figures=figures,
        cameras=cameras,
        texts={} if reference is None else {REFERENCE: json.dumps({"cameras": [reference]}, indent=0) + "\n"},
        files=mask_of(result, folder),
        splats=splat_of(folder),
    )


def tables_of(result: Mapping[str, Any]) -> dict[str, Table]:
    """The rows of an attack.

    Args:
        result: Its result.json.
    """
    reached = _reached(objective_of(result))
    rows = tuple(_row(view, result["rates"][view["detector"]]["original"], reached) for view in result["views"])
    return {ROWS: Table(columns=_columns(int(result["config"]["noise_draws"])), rows=rows)}


def derive(contents: Contents) -> Mapping[str, Any]:
    """Every rate of the attack, of its rows alone.

    Raises:
        InvalidValueError: The rows are not those of the attack.
    """
    try:
        config = contents.configuration["config"]
        low, high = map(float, config["judged"]["cameras"]["elevations"])
        figures = aim_figures(_frame(contents), list(contents.detectors), (low, high))
        rate = figures["rate"]
        return {"success": rate["successes"] >= (config["required_views"] - 1e-9) * rate["total"], **figures}
    except (KeyError, TypeError, ValueError, IndexError, pl.exceptions.PolarsError) as error:
        raise broken("rows", error) from error


def _frame(contents: Contents) -> pl.DataFrame:
    """The rows as rates are counted from them: one for each splat."""
    rows = pl.DataFrame(contents.tables[ROWS].rows, infer_schema_length=None)
    place = ("detector", pl.col("original").cast(pl.String), "azimuth", "elevation", pl.col("index").alias("view"))

    def of(splat: str, draw: int | None, success: str, *further: pl.Expr) -> pl.DataFrame:
        ids = {"splat": pl.lit(splat), "draw": pl.lit(draw, pl.Int64), "success": pl.col(success)}
        return rows.select(*place, *further, **ids).filter(pl.col("success").is_not_null())

    parts = [
        of(CLEAN, None, "clean_success", pl.col("clean_confidence").alias("original_score")),
        of(ATTACKED, None, "success", pl.col("original_confidence").alias("original_score"), pl.col("unambiguous")),
    ]
    names = [name for name in rows.columns if name.startswith(_NOISE_SUCCESS)]
    parts += [of(NOISE, draw, name) for draw, name in enumerate(names)]
    return pl.concat(parts, how="diagonal")


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
        Column(name="clean_success", kind="truth", meaning="whether it is reached without any attack"),
        confidence("score", "how near the aim is, attacked, in [0, 1]"),
        confidence("clean_score", "how near the aim is without any attack"),
        confidence("target_confidence", "in the target on the attacked object", optional=True),
        confidence("clean_confidence", "in the original class on the clean object"),
        confidence("original_confidence", "in the original class on the attacked object"),
        *(confidence(f"{_NOISE_SCORE}{draw}", "how near the aim is with random noise") for draw in range(draws)),
        *(
            Column(name=f"{_NOISE_SUCCESS}{draw}", kind="truth", meaning="whether it is reached with random noise")
            for draw in range(draws)
        ),
    )


def _row(view: Mapping[str, Any], original: str | None, reached: Callable[[float], bool]) -> Row:
    """The row of a view; what an older result does not say of its controls follows from their scores."""
    noise = view["noise_scores"]
    held = view.get("noise_successes", [reached(score) for score in noise])
    same = ("index", "detector", "azimuth", "elevation", "success", "unambiguous", "score", "clean_score")
    confidences = ("target_confidence", "clean_confidence", "original_confidence")
    row: dict[str, Cell] = {name: view[name] for name in (*same, *confidences)}
    row |= {"original": original, "clean_success": view.get("clean_success", reached(view["clean_score"]))}
    row |= dict(zip("xyz", view["position"], strict=True))
    row |= dict(zip(OBJECT, view["box"], strict=True))
    row |= {f"{_NOISE_SCORE}{draw}": score for draw, score in enumerate(noise)}
    return row | {f"{_NOISE_SUCCESS}{draw}": success for draw, success in enumerate(held)}


def _reached(objective: Any) -> Callable[[float], bool]:
    """Whether a score reaches the aim."""
    if isinstance(objective, Relabel):
        return lambda score: score >= objective.confidence
    return lambda score: 1.0 - score < objective.confidence


def _number(value: Cell) -> float:
    return float(value) if isinstance(value, (int, float)) else 0.0


def outcomes(contents: Contents) -> list[Outcome]:
    """What the rows say of the attacked splat."""
    return [
        Outcome(
            view=int(_number(row["index"])),
            detector=str(row["detector"]),
            original=None if row["original"] is None else str(row["original"]),
            success=bool(row["success"]),
            unambiguous=bool(row["unambiguous"]),
        )
        for row in contents.tables[ROWS].rows
    ]


KIND = Kind(pack=pack, derive=derive, columns=columns, outcomes=outcomes)
