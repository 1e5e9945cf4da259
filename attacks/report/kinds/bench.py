"""What `mi-splat bench` leaves: one row, column by column."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.bench.row import HEADS, row_of
from attacks.rate import Rate, pooled
from attacks.report.section import Figure, Section


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a row."""
    columns, score, name = record["columns"], record["score"], record["detector"]["name"]
    filled = {head: columns[column] for column, head in HEADS.items() if columns[column]["robust"] is not None}
    figures = [Figure(label=f"still named, {head}", rate=Rate.of(column["robust"])) for head, column in filled.items()]
    words = "no score: a column cannot be filled" if score is None else f"{score['mean']:.3f}"
    return Section(
        kind="Scoreboard",
        title=f"{name}, suite {record['suite']['name']}",
        done=f"The attacks of the suite were made for {name}. Rates are of views in which it names the clean object.",
        conclusion=f"Score: {words}. Higher is more robust. It holds for the attacks and scenes of this suite.",
        headline=Figure(label="score", words=words),
        control=Figure(label="clean object named", rate=pooled(column["named_clean"] for column in columns.values())),
        attacked=False,
        warnings=record["warnings"],
        figures=figures,
        configuration=tuple(
            (key, str(value)) for key, value in row_of(record).items() if key not in ("columns", "score")
        ),
    )
