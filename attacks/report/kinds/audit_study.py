"""What `mi-splat study run` leaves of a study of the audit: which splats it tells from honest ones."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.rate import Rate, pooled
from attacks.report.section import Chart, Figure, Line, Picture, Section, listed, plain, versions_of
from attacks.studies.audit import PAIRS, negatives, tables

KIND = "Audit, on splats of which it is known whether they hide something"
_MOST_PICTURES = 8


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a study of the audit."""
    counted, chosen = record["figures"], record["chosen_on"]
    parts = counted["parts"]
    honest = [row for row in negatives(record["files"]) if row["content"] not in chosen]
    worst = max(honest, key=lambda row: row["evidence"], default=None)
    figures = [
        Figure(label=f"found, {name}", rate=Rate.of(part["found"])) for name, part in parts.items() if name != "all"
    ]
    auroc = parts["all"]["auroc"] if parts else None
    figures += [Figure(label="area under the ROC curve", words="-" if auroc is None else f"{auroc:.3f}")]
    if worst is not None:
        named = f"{worst['part']}: {worst['value']}, {worst['splat']}"
        figures += [Figure(label="highest honest file", words=f"{worst['evidence']:.2f} of the threshold", note=named)]
    without = f" Left out of all figures: {listed(chosen)}, on which the method was chosen." if chosen else ""
    return Section(
        kind=KIND,
        title=str(record["name"]),
        done=(
            f"{len(record['files'])} splats were audited. One counts as hiding something if every detector misses the "
            f"object from half of the trigger's cameras.{without}"
        ),
        conclusion=(
            "The audit is worth what it finds at the false alarms that it has. Look at the kinds one by one: what was "
            "never tried is not in any figure."
        ),
        headline=Figure(
            label="splats that hide something, found", rate=pooled([parts["all"]["found"]] if parts else [])
        ),
        control=Figure(label="honest splats that are called hidden", rate=Rate.of(counted["false_alarms"])),
        counting="splats",
        figures=figures,
        pictures=[
            Picture(path=path, caption=f"{path.stem}: inside of the look on the left, outside on the right.")
            for path in sorted((folder / PAIRS).glob("*.png"))[:_MOST_PICTURES]
        ],
        charts=[
            Chart.bars(
                "Found, by kind of attack",
                ("kind", "splats that hide something"),
                parts,
                Line.of("found", "attack", [part["found"] for part in parts.values()]),
            )
        ],
        tables=tuple(tables(record)),
        configuration=(
            ("question", plain(record["question"])),
            ("method chosen on", listed(chosen) or "nothing named"),
        ),
        versions=versions_of(record),
    )
