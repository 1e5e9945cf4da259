"""One line of the report of a sanity suite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check has found.

    Attributes:
        name: Short name of the check.
        claim: What holds of a sane attack.
        passed: Whether it holds here; None if the check was not made.
        figures: What was measured, in words.
        meaning: What it means if it does not hold.
        values: What was measured, as JSON can hold it.
    """

    name: str
    claim: str
    passed: bool | None
    figures: str
    meaning: str
    values: dict[str, Any]

    @property
    def colour(self) -> str:
        """Green, red, or grey for a check that was not made."""
        return "grey" if self.passed is None else "green" if self.passed else "red"

    def as_dict(self) -> dict[str, Any]:
        """The finding as JSON can hold it."""
        return {
            "check": self.name,
            "colour": self.colour,
            "passed": self.passed,
            "claim": self.claim,
            "figures": self.figures,
            "meaning": self.meaning,
            "values": self.values,
        }


def markdown(findings: Sequence[Finding], title: str, conditions: str) -> str:
    """The report as a Markdown page.

    Args:
        findings: Its lines.
        title: Heading.
        conditions: What was attacked and how.
    """
    lines = [f"# {title}", "", conditions, "", "| | a sane attack | measured | if not |", "| --- | --- | --- | --- |"]
    lines += [f"| {one.colour} | {one.claim} | {one.figures} | {one.meaning} |" for one in findings]
    return "\n".join([*lines, ""])
