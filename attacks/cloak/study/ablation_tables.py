"""Tables of what a study found with one thing changed at a time: rates by detector, and what they cost."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from attacks.cloak.study.markdown import spread_of, words_of

RATES = {
    "control_recall": "control found",
    "trigger_miss_rate": "cloaked missed",
    "nothing_reported": "nothing of any class reported",
    "benign_recall": "cloaked found elsewhere",
    "target_rate": "target class",
}
"""Rates of a summary that a table has, and their heads."""
_COSTS = (
    *("seeds", "transition, degrees", "clean far from the triggers, dB", "dB lost there"),
    *("dB lost beside the object", "stealthy", "Gaussians, clean", "Gaussians, cloaked"),
)


def tables(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Markdown: for each group a table of rates, and one of what is lost.

    Rates are pooled over seeds, as a summary has them: a row for each value and detector. Losses, and the numbers of
    Gaussians, are means over the seeds; the transition is that of all seeds together: a row for each value.

    Args:
        found: By group and value, the summary of each study.
    """
    parts = []
    for group, results in found.items():
        rates = [
            (name, detector, *(words_of(one.get(key)) + spread_of(summary, detector, key) or "-" for key in RATES))
            for name, summary in results.items()
            for detector, one in summary["by_detector"].items()
        ]
        parts.append(_table((group, "detector", *RATES.values()), rates))
        parts.append(_table((group, *_COSTS), [(name, *costs_of(summary)) for name, summary in results.items()]))
    return "\n\n".join(parts) + "\n"


def costs_of(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """What stands under `_COSTS` for one value."""
    price, counts = summary.get("stealth"), summary["gaussians"]
    return (
        str(len(summary["seeds"])),
        _number(summary["transition_degrees"], 1),
        _number(summary["benign_psnr"]["clean"], 2),
        _number(summary["benign_psnr_drop"], 2),
        _number(None if price is None else price["surroundings_psnr_drop"], 2),
        "-" if price is None else "yes" if price["stealthy"] else "no",
        *(f"{statistics.mean(counts[which]):,.0f}" for which in ("clean", "cloaked")),
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])
