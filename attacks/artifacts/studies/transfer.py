"""Results of `mi-splat dagger-transfer` as artifacts: every look of a detector at an attacked splat is a row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import Contents, read_object
from attacks.artifacts.dagger_results import broken
from attacks.artifacts.packed import Kind, Packed
from attacks.artifacts.rows import Column, Row, Table
from attacks.artifacts.studies.settings import configuration_of, only, records_of
from attacks.dagger.study import JOBS
from attacks.dagger.transfer.held_out import HELD_OUT
from attacks.dagger.transfer.matrix import Cell, cells, left_out
from attacks.dagger.transfer.study import JUDGED
from attacks.dagger.transfer.tables import left_out_table, rate_tables
from attacks.observe.rows import frame_of

ROWS = "rows"
TRANSFER, OVER_VIEWS = "dagger-transfer", "dagger-transfer --eot-study"
_SPLATS, _CLASSES = ("clean", "attacked", "noise"), ("original", "target")
_SCORES = tuple(f"{splat}_{label}" for splat in _SPLATS for label in _CLASSES)
_COLUMNS = (
    Column(name="attack", kind="text", meaning="name of the attack in configuration.attacks"),
    Column(name="sources", kind="text", meaning="the detectors attacked, with + between them"),
    Column(name="detector", kind="text", meaning="the one that looks"),
    Column(name="view", kind="whole", meaning="number of the view, from 0"),
    *(
        Column(name=f"{splat}_{label}", kind="number", meaning=f"confidence in the {words} class on the {splat} splat")
        for splat in _SPLATS
        for label, words in zip(_CLASSES, ("object's", "wanted"), strict=True)
    ),
)
_RATES = ("runs", "targeted", "untargeted", "noise_targeted", "noise_untargeted")
_MADE = ("config", "detectors", "scene_hash", "versions", "variant", "commit")
_STATED = ("success", "image_psnr", "steps", "used", "warnings")

Look = tuple[str, Sequence[str], str, int, Mapping[str, Any]]
"""Name of the attack, detectors attacked, the one that looks, number of the view, and what it reports."""


def _pack_transfer(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of attacks from one view each holds."""
    found, attacks = read_object(folder / "transfer.json"), records_of(folder / JOBS)
    judged = records_of(folder / JUDGED).values()
    try:
        names = {_key(record["job"]): name for name, record in attacks.items()}
        known = [one for one in judged if _key(one["job"]["source"]) in names]
        looks: list[Look] = [
            (names[_key(source)], source["sources"], one["job"]["detector"], 0, one["result"])
            for one in known
            for source in (one["job"]["source"],)
        ]
        results = [record["result"] for record in attacks.values()]
        made = {
            name: {"job": one["job"], "result": {key: one["result"][key] for key in _MADE if key in one["result"]}}
            for name, one in attacks.items()
        }
        contents = Contents(
            kind=TRANSFER,
            name="dagger_transfer",
            command=str(found.get("command") or ""),
            configuration=configuration_of(made),
            seeds=tuple(sorted({int(record["job"]["config"]["seed"]) for record in attacks.values()})),
            versions=results[0]["versions"],
            commit=only([one["commit"] for one in results]),
            variant=only([one["variant"] for one in results]),
            detectors={name: ", ".join(marks) for name, marks in found["weights"].items()},
            stated={
                name: {key: one["result"][key] for key in _STATED if key in one["result"]}
                for name, one in attacks.items()
            },
            tables=_table(looks, found["cells"]),
        )
        figures = {"cells": _named(found["cells"]), "leave_one_out": _best(found["leave_one_out"])}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise broken(folder, error) from error
    return Packed(contents=contents, figures=figures)


def _pack_views(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of splats that were judged over held-out views holds."""
    found, records = read_object(folder / "held_out.json"), records_of(folder / HELD_OUT)
    try:
        groups = {tuple(cell["sources"]) for cell in found["cells"]}
        looks: list[Look] = [
            (record["job"]["attack"], _sources(record["job"], groups), record["job"]["detector"], number, view)
            for record in records.values()
            for number, view in enumerate(record["result"]["views"])
        ]
        jobs = {record["job"]["attack"]: record["job"] for record in records.values()}
        made = {name: {key: job[key] for key in job if key != "detector"} for name, job in jobs.items()}
        # An older result names the weights of the detectors attacked alone.
        weights = found.get("weights") or {
            name: mark
            for job in jobs.values()
            for name, mark in zip(_sources(job, groups), job["weights"], strict=True)
            if name in job["sources"]
        }
        contents = Contents(
            kind=OVER_VIEWS,
            name="dagger_transfer_views",
            command=str(found.get("command") or ""),
            configuration=configuration_of(made),
            seeds=tuple(sorted({int(job["seed"]) for job in jobs.values()})),
            versions=found.get("versions", {}),
            commit=found.get("commit"),
            variant=found.get("variant"),
            detectors=weights,
            tables=_table(looks, found["cells"]),
        )
        figures = {"cells": _named(found["cells"])}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise broken(folder, error) from error
    return Packed(contents=contents, figures=figures)


def _key(job: Mapping[str, Any]) -> str:
    return repr(job)


def _sources(job: Mapping[str, Any], groups: Iterable[tuple[str, ...]]) -> list[str]:
    """The detectors attacked as the matrix names them: with their weights where others judge by the same name."""
    known = {name for group in groups for name in group}
    marked = [(name, f"{name}, weights {mark[:6]}") for name, mark in zip(job["sources"], job["weights"], strict=True)]
    return [name if name in known and long not in known else long for name, long in marked]


def _table(looks: Sequence[Look], matrix: Sequence[Mapping[str, Any]]) -> dict[str, Table]:
    """The rows, in the order of the matrix."""
    sources = list(dict.fromkeys("+".join(cell["sources"]) for cell in matrix))
    names = list(dict.fromkeys(cell["detector"] for cell in matrix))
    rows: list[Row] = [
        {
            "attack": attack,
            "sources": "+".join(group),
            "detector": detector,
            "view": view,
            **{f"{splat}_{label}": float(seen[splat][f"{label}_score"]) for splat in _SPLATS for label in _CLASSES},
        }
        for attack, group, detector, view, seen in looks
    ]
    rows.sort(key=lambda row: (sources.index(str(row["sources"])), row["attack"], names.index(str(row["detector"]))))
    return {ROWS: Table(columns=_COLUMNS, rows=tuple(rows))}


def _cells(contents: Contents) -> list[Cell]:
    """The matrix, of the rows alone."""
    ids = ("attack", "sources", "detector", "view")
    return cells(
        frame_of(
            {**{key: row[key] for key in ids}, "splat": splat, **{f"{x}_score": row[f"{splat}_{x}"] for x in _CLASSES}}
            for row in contents.tables[ROWS].rows
            for splat in _SPLATS
        )
    )


def _derive(kind: str, contents: Contents) -> Mapping[str, Any]:
    """Every rate of the matrix, of the rows alone."""
    matrix = _cells(contents)
    figures: dict[str, Any] = {"cells": _named([cell.as_dict() for cell in matrix])}
    return {**figures, "leave_one_out": _best(left_out(matrix))} if kind == TRANSFER else figures


def _named(matrix: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """The rates of each cell, by its name."""
    return {
        f"{' + '.join(cell['sources'])} by {cell['detector']}": {key: cell[key] for key in _RATES} for cell in matrix
    }


def _best(rows: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Which single attack is the best against each detector that was left out."""
    keys = ("best_single_targeted", "best_single_untargeted")
    return {row["detector"]: {key: row[key] and " + ".join(row[key]["sources"]) for key in keys} for row in rows}


def _page(kind: str, derived: Mapping[str, Any], contents: Contents) -> str:
    """The tables of rates as the command writes them."""
    matrix = _cells(contents)
    return "\n".join([*rate_tables(matrix), *(left_out_table(matrix) if kind == TRANSFER else [])])


def _columns(contents: Contents) -> Mapping[str, Sequence[Column]]:
    return {ROWS: _COLUMNS}


def _kind(name: str, pack: Any) -> Kind:
    return Kind(pack=pack, derive=partial(_derive, name), columns=_columns, page=partial(_page, name), rescored=False)


TRANSFER_KIND, VIEWS_KIND = _kind(TRANSFER, _pack_transfer), _kind(OVER_VIEWS, _pack_views)
