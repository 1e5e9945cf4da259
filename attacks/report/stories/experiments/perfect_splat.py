"""The rates of a splat that shows its attacks perfectly: what detectors report in path-traced pictures of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attacks.cloak.rates import ROWS
from attacks.rate import Rate
from attacks.report.section import Figure, Section, Table, doubts_of
from attacks.report.stories.experiments.documents import Document, Row, section
from attacks.report.wording import counted, counts, listed, plural, pooled, rate_of

_HIDES, _NOTHING, _SHOWS = "trigger_miss_rate", "nothing_reported", "target_rate"


def read(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment perfect-splat`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    names, attacks = (list(dict.fromkeys(str(row[key]) for row in rows)) for key in ("detector", "attack"))
    hidden, nothing, shown = (_pooled(rows, key) for key in (_HIDES, _NOTHING, _SHOWS))
    known = _pooled(rows, "control_recall")
    hides = bool(hidden.total) or not shown.total
    headline = (
        Figure(label="the object is missed well inside the trigger, where it is found as it is", rate=hidden)
        if hides
        else Figure(label="the target class is reported", rate=shown)
    )
    found_before = Rate(successes=known.total - known.successes, total=known.total)
    control = (
        Figure(label="the object as it is: missed inside the trigger", rate=found_before)
        if hides
        else Figure(label="the target class, on the object as it is", rate=_pooled(rows, "control_target_rate"))
    )
    first = headline.rate or hidden
    return section(
        path,
        document,
        kind="CLOAK, shown perfectly",
        done=(
            f"{listed(names)} looked at path-traced pictures of what {plural(len(attacks), 'attack')} of the study "
            "wants to show, from held-out cameras inside the triggers. No splat has a part in it."
        ),
        conclusion=(
            f"A splat that shows these very pictures reaches {counts(first)}, over all detectors. Where that is short "
            "of an aim, the appearance is the reason, and not the splat. One that shows them worse can be reported "
            "more often, or less."
        ),
        headline=headline,
        control=control if control.rate is not None and control.rate.total else None,
        figures=[
            Figure(label=label, rate=rate)
            for label, rate in (
                ("nothing of any class is reported on it there", nothing),
                ("the target class is reported inside the trigger of its attack", shown),
            )
            if rate.total
        ],
        warnings=doubts_of(first, control.rate, what="pictures"),
        tables=[_table(rows, name, names) for name in attacks],
    )


def _pooled(rows: Sequence[Row], key: str) -> Rate:
    return pooled(rate_of(row.get(key)) for row in rows)


def _table(rows: Sequence[Row], attack: str, detectors: Sequence[str]) -> Table:
    """All rates of an attack, a column for each detector."""
    own = {row["detector"]: row for row in rows if row["attack"] == attack}
    keys = [key for key in ROWS if any(key in row for row in own.values())]
    return Table(
        caption=f"{attack}, {next(iter(own.values()))['cameras']} cameras; for cloaked read path-traced",
        head=("", *detectors),
        rows=tuple((ROWS[key], *(counted(rate_of(own[name].get(key))) for name in detectors)) for key in keys),
    )
