"""The studies that `mi-splat dagger-study`, `dagger-eot-study` and `dagger-pairs` leave behind, as artifacts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.artifacts import dagger, dagger_eot
from attacks.artifacts.contents import read_object
from attacks.artifacts.studies.attacks import Study, kind
from attacks.artifacts.studies.settings import records_of
from attacks.dagger import tables as study_tables
from attacks.dagger.config import DaggerConfig
from attacks.dagger.eot import tables as eot_tables
from attacks.dagger.jobs import Job
from attacks.dagger.pairs import pair_row, pairs_table, smallest_radius
from attacks.dagger.study import JOBS, PAIRS

Record = Mapping[str, Any]
Own = Mapping[str, Any]

TABLE, SUMMARY = "table.json", "summary.json"
_STATED = ("image_psnr", "image", "steps", "used", "used_in_file", "changed_gaussians", "warnings", "seconds")
_OF_PAIRS = ("radii", "seeds", "search", "steps_allowed", "norm", "attributes")
_NAMED = ("detector", "object", "target")


def _jobs(folder: Path) -> dict[str, dict[str, Any]]:
    return records_of(folder / JOBS)


def _jobs_of_each(folder: Path) -> dict[str, dict[str, Any]]:
    """The records of every detector, each with its name before it."""
    folders = sorted(path.parent for path in folder.glob(f"*/{JOBS}"))
    return {f"{one.name}-{name}": found for one in folders for name, found in _jobs(one).items()}


def _by(lines: Iterable[Mapping[str, Any]], names: Sequence[str], values: Sequence[str]) -> dict[str, Any]:
    """Lines of a table by their names in words."""

    def words(value: Any) -> str:
        several = value if isinstance(value, (list, tuple)) else [value]
        return " ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in several)

    return {", ".join(words(line[name]) for name in names): {key: line[key] for key in values} for line in lines}


def _smallest(lines: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Of the smallest radii what follows from rows."""
    named = ("object", "target", "detectors", "azimuths", "sh_degree")
    return {"smallest": _by(lines, named, ("smallest", "successes", "not_enough"))}


def _radii(lines: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Of the lines by radius what follows from rows."""
    counted = ("pairs", "pairs_reached", "successes", "runs", "score")
    return {"by_radius": _by(lines, ("group", "attribute", "norm", "eps"), counted)}


def _figures(result: Record, tables: Mapping[str, Any]) -> dict[str, Any]:
    return {key: result[key] for key in dagger_eot.FIGURES}


EOT_STUDY = kind(
    Study(
        kind="dagger-eot-study",
        tables=dagger_eot.tables_of,
        figures=_figures,
        single=dagger_eot.KIND,
        stated=(*_STATED, "noise_psnr", "redraws"),
        ledger=_jobs,
        summary=lambda records, own: _smallest(eot_tables.smallest_radii(records)),
        stored=lambda folder: _table(folder, lambda table: _smallest(table["smallest"])),
        page=lambda records, own: eot_tables.markdown(records),
        kept=("success", "rate", "clean_rate", "noise_rate", "unambiguous_rate"),
    )
)

STUDY = kind(
    Study(
        kind="dagger-study",
        tables=dagger.tables_of,
        figures=dagger.figures_of,
        single=dagger.KIND,
        stated=(*_STATED, "noise"),
        ledger=_jobs,
        summary=lambda records, own: _radii(study_tables.by_radius(records)),
        stored=lambda folder: _table(folder, lambda table: _radii(table["by_radius"])),
        page=lambda records, own: study_tables.markdown(records),
    )
)


def _table(folder: Path, figures: Callable[[Record], dict[str, Any]]) -> tuple[str, Own, dict[str, Any]]:
    table = read_object(folder / TABLE)
    return str(table.get("command") or ""), {}, figures(table)


def _stored_pairs(folder: Path) -> tuple[str, Own, dict[str, Any]]:
    found = read_object(folder / SUMMARY)
    own = {**{key: found[key] for key in _OF_PAIRS}, "eps": sorted({row["eps"] for row in found["pairs"]})}
    own["detectors"] = list(dict.fromkeys(row["detector"] for row in found["pairs"]))
    return str(found.get("command") or ""), own, {"smallest": _by(found["smallest"], _NAMED, ("eps",))}


def _smallest_of_pairs(records: Sequence[Record], own: Own) -> list[dict[str, Any]]:
    """The bisection of `attacks.dagger.pairs` again, over what is in the rows."""
    success = {_place(record): bool(record["result"]["success"]) for record in records}
    lines = []
    for detector in own["detectors"] if own["radii"] else ():
        for pair in PAIRS:
            found = [
                smallest_radius(
                    own["radii"],
                    lambda radius: success[(detector, *pair, seed, radius)],  # noqa: B023  # at once
                )
                for seed in own["seeds"]
            ]
            lines.append({"detector": detector, "object": pair[1], "target": pair[2], "eps": found})
    return lines


def _place(record: Record) -> tuple[Any, ...]:
    """Detector, pair, seed and radius of an attack."""
    job = record["job"]
    named = (record["result"]["detector"], job["scene"], job["object"], job["target"])
    return (*named, job["config"]["seed"], job["config"]["eps"][0])


def _pairs_page(records: Sequence[Record], own: Own) -> str:
    by_place = {_place(record): record for record in records}
    rows = []
    for detector in own["detectors"]:
        for pair in PAIRS:
            for eps in own["eps"]:
                for seed in own["seeds"]:
                    record = by_place[(detector, *pair, seed, eps)]
                    rows.append(pair_row(detector, _job(record["job"]), record["result"]))
    return pairs_table({"pairs": rows, "smallest": _smallest_of_pairs(records, own), "seeds": own["seeds"]})


def _job(values: Mapping[str, Any]) -> Job:
    given = values["config"].items()
    settings: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in given}
    return Job(**{**values, "config": DaggerConfig(**settings)})


PAIRS_STUDY = kind(
    Study(
        kind="dagger-pairs",
        tables=dagger.tables_of,
        figures=dagger.figures_of,
        single=dagger.KIND,
        stated=(*_STATED, "noise"),
        ledger=_jobs_of_each,
        summary=lambda records, own: {"smallest": _by(_smallest_of_pairs(records, own), _NAMED, ("eps",))},
        stored=_stored_pairs,
        page=_pairs_page,
    )
)
