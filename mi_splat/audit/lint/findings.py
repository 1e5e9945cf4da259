"""What lint says of a file: a finding names a rule, how bad it is, why, and in which rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Severity = Literal["error", "warning", "note"]
"""An error breaks a file or a renderer, a warning is hardly ever wanted, a note is no fault."""

SHOWN = 100
"""So many rows a finding lists; it counts all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a rule found.

    Attributes:
        rule: Its name in docs/audit_lint.md.
        severity: How bad it is.
        reason: What is wrong with it, in a plain sentence.
        rows: Numbers of the first Gaussians that it is about, in the order of the file; none if it is about all.
        count: How many Gaussians it is about.
    """

    rule: str
    severity: Severity
    reason: str
    rows: tuple[int, ...] = ()
    count: int = 0

    @classmethod
    def of(cls, rule: str, severity: Severity, reason: str, mask: NDArray[np.bool_]) -> Finding:
        """A finding about some rows."""
        rows = np.flatnonzero(mask)
        return cls(rule=rule, severity=severity, reason=reason, rows=tuple(rows[:SHOWN].tolist()), count=len(rows))

    def document(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "rule": self.rule,
            "severity": self.severity,
            "reason": self.reason,
            "rows": list(self.rows),
            "count": self.count,
        }
