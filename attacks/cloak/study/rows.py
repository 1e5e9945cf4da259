"""What was seen of the splats of a study, as tables: the rows that every figure is counted from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import polars as pl

from attacks.cloak.study.observations import Blend, Fidelity, Observation, ObservedSplat
from attacks.cloak.study.pipeline import CLEAN, CLOAKED

DEPTH, SCORE = "depth: ", "score: "
"""What stands before the name of an attack in the column of depths in its trigger, and before a class in its scores."""

_TYPES = {"int": pl.Int64, "float": pl.Float64}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRows:
    """What was seen of the splats of a study.

    Attributes:
        rows: A row for each splat, seed, detector and held-out camera, as `row_of` makes it.
        fidelity: A row for each splat, seed and camera far outside of all triggers, with the values of `Fidelity`.
        transition: A row for each splat, seed and camera of an arc, with the values of `Blend`.
        gaussians: Number of Gaussians of the clean and of the cloaked splats, by seed in the order of the study.
    """

    rows: pl.DataFrame
    fidelity: pl.DataFrame
    transition: pl.DataFrame
    gaussians: Mapping[str, Sequence[int]]

    @classmethod
    def of(cls, observed: Sequence[ObservedSplat]) -> StudyRows:
        """The rows of everything that was observed."""
        whose = [{"splat": item.trained.splat, "seed": item.trained.seed} for item in observed]
        pairs = list(zip(whose, observed, strict=True))
        return cls(
            rows=frame({**own, **row_of(one)} for own, item in pairs for one in item.observations),
            fidelity=frame(({**own, **asdict(one)} for own, item in pairs for one in item.fidelities), Fidelity),
            transition=frame(({**own, **asdict(one)} for own, item in pairs for one in item.blends), Blend),
            gaussians=gaussians_of(
                {"splat": one.trained.splat, "gaussians": one.trained.gaussians} for one in observed
            ),
        )


def frame(rows: Iterable[Mapping[str, Any]], kind: type[Any] | None = None) -> pl.DataFrame:
    """Rows as a table; with a dataclass whose fields they have, it has these columns even without a row."""
    schema = None
    if kind is not None:
        own = {field.name: _TYPES[str(field.type)] for field in fields(kind)}
        schema = {"splat": pl.String, "seed": pl.Int64, **own}
    return pl.DataFrame(list(rows), schema=schema, infer_schema_length=None)


def row_of(one: Observation) -> dict[str, Any]:
    """An observation as a row."""
    return {
        "detector": one.detector,
        "view": one.view,
        "azimuth": one.azimuth,
        "elevation": one.elevation,
        **{f"{DEPTH}{name}": depth for name, depth in one.depths.items()},
        **score_cells({"scores": one.scores, "any_overlap": one.any_overlap, "any_class": one.any_class}),
    }


def score_cells(scored: Mapping[str, Any]) -> dict[str, float]:
    """The part of a row that detections decide, from `attacks.cloak.study.observations.scored`."""
    scores = {f"{SCORE}{label}": score for label, score in scored["scores"].items()}
    return {**scores, "any_overlap": scored["any_overlap"], "any_class": scored["any_class"]}


def gaussians_of(splats: Iterable[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Numbers of Gaussians of the clean and of the cloaked splats, in their order."""
    found: dict[str, list[int]] = {CLEAN: [], CLOAKED: []}
    for splat in splats:
        found[splat["splat"]].append(int(splat["gaussians"]))
    return found
