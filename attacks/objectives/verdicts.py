"""One verdict of the verdicts of several views and detectors."""

import math
from collections.abc import Sequence

from attacks.search.loop import Verdict


def joint_verdict(verdicts: Sequence[Verdict], required: float) -> Verdict:
    """Success in at least a fraction of the verdicts, and the score that so many
    reach.
    """
    needed = _needed(len(verdicts), required)
    return Verdict(
        success=sum(verdict.success for verdict in verdicts) >= needed,
        score=reached_by([verdict.score for verdict in verdicts], required),
        unambiguous=sum(verdict.unambiguous for verdict in verdicts) >= needed,
    )


def overall_verdict(
    rows: Sequence[Sequence[Verdict]], required: float, *, drawn: bool = False
) -> Verdict:
    """One verdict of views (rows) and detectors: success where enough views succeed
    with every detector.

    From chosen cameras each detector needs enough views of its own, and the score is
    what so many reach. Of drawn views a view needs all detectors, and the score orders
    by the number of these views, and between equals by the mean of what is reached in
    them.
    """
    if not drawn:
        return joint_verdict(
            [joint_verdict(verdicts, required) for verdicts in zip(*rows, strict=True)],
            1.0,
        )
    views = [joint_verdict(row, 1.0) for row in rows]
    successes, unambiguous = (
        sum(getattr(view, name) for view in views)
        for name in ("success", "unambiguous")
    )
    return Verdict(
        success=successes / len(views) >= required - 1e-9,
        score=(successes + sum(view.score for view in views) / len(views))
        / (len(views) + 1),
        unambiguous=unambiguous / len(views) >= required - 1e-9,
    )


def reached_by(values: Sequence[float], required: float) -> float:
    """The largest value that at least a fraction of the values reach."""
    return sorted(values, reverse=True)[_needed(len(values), required) - 1]


def _needed(count: int, required: float) -> int:
    # 0.07 * 100 is a little more than 7: rounding must not ask for one more.
    return math.ceil(required * count - 1e-9)
