"""Rows of audits: how well each tells splats that hide something from honest ones, counted from a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks import tables
from attacks.rate import Rate
from attacks.studies.audit import STORY, interval, negatives, positives, ranked_above
from attacks.tables import Table, cell
from mi_splat.errors import InvalidValueError
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import DocumentReader

AUDIT = "the audit"
FALSE_ALARMS = 0.1
"""Share of honest splats that may be called hidden, where audits are compared by what they find."""
_READER = DocumentReader(expected="a result of a study of the audit", do="run the study scenes/studies/audit.toml")


def audit_rows(path: Path) -> list[dict[str, Any]]:
    """The row of the audit and of each other way to find a hidden look, the best one first.

    Contents on which the audit was chosen are left out, and so are splats that were changed afterwards.
    """
    record = _READER.read_json(path / RECORD if path.is_dir() else path)
    if record.get("story") != STORY:
        raise InvalidValueError.of(str(path), "a study of the audit", str(record.get("story")), "pass another result")
    held = [row for row in record["files"] if row["content"] not in record["chosen_on"] and not row["derived"]]
    hiding, honest = positives(held), negatives(held)
    if not hiding or not honest:
        got = f"{len(hiding)} that hide something, {len(honest)} honest ones"
        raise InvalidValueError.of(str(path), "splats of both kinds", got, "run all parts of the study")
    rows = [_row(name, hiding, honest) for name in (AUDIT, *held[0].get("scores", ()))]
    return sorted(rows, key=lambda row: -row["auroc"])


def _row(name: str, hiding: Sequence[Mapping[str, Any]], honest: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    high, low = ([_score(row, name) for row in rows] for rows in (hiding, honest))
    allowed = int(FALSE_ALARMS * len(low))
    threshold = sorted(low, reverse=True)[allowed] if allowed < len(low) else min(low)
    seconds = [row["seconds"][name] for row in (*hiding, *honest) if "seconds" in row]
    return {
        "audit": name,
        "auroc": ranked_above(high, low),
        "interval": list(interval(high, low)),
        "finds": Rate(successes=sum(value > threshold for value in high), total=len(high)).as_dict(),
        "false_alarms": Rate(successes=sum(value > threshold for value in low), total=len(low)).as_dict(),
        "seconds": sum(seconds) / len(seconds) if seconds else None,
    }


def _score(row: Mapping[str, Any], name: str) -> float:
    return float(row["evidence"] if name == AUDIT else row["scores"][name])


def audit_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of audits as a table."""
    heads: dict[str, Any] = {
        "rank": lambda line: str(line[0]),
        "what looks at the file": lambda line: line[1]["audit"],
        "AUROC": lambda line: "{:.3f} ({:.3f} to {:.3f})".format(line[1]["auroc"], *line[1]["interval"]),
        "finds": lambda line: cell(line[1]["finds"]),
        "false alarms": lambda line: cell(line[1]["false_alarms"]),
        "CPU seconds a file": lambda line: "-" if line[1]["seconds"] is None else f"{line[1]['seconds']:.1f}",
    }
    table = Table.of("", heads, enumerate(rows, 1))
    return tables.markdown(table.head, table.rows) + "\n"
