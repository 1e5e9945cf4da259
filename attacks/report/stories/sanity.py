"""What `mi-splat dagger-sanity` leaves behind: whether an attack that fails may be believed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.report.section import Figure, Section
from attacks.report.wording import listed, plural, settings
from attacks.tables import Table

KIND = "sanity of DAGGER"
_ELSEWHERE = ("story", "checks", "command", "versions", "variant", "commit")
_WORDS = {True: "holds", False: "does not hold", None: "not checked"}


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of a suite.

    Args:
        folder: Where it lies.
        found: Its result.json.
    """
    checks = found["checks"]
    passed, red = ([one for one in checks if one["passed"] is wanted] for wanted in (True, False))
    skipped = len(checks) - len(passed) - len(red)
    return Section(
        kind=KIND,
        title=f"{found['detector']}, {found['target']}",
        done=(
            f"{plural(len(checks), 'check')} asked whether DAGGER behaves as a sane attack does on one object and "
            f"{found['detector']}, with {plural(found['seeds'], 'seed')}: whether success rises with the radius, "
            "whether gradients are right, whether noise and random search do worse, and so on."
        ),
        conclusion=(
            "Every check that was made holds: where the attack fails here, the reason is not a broken attack."
            if not red
            else f"{plural(len(red), 'check')} did not hold: do not take a failure of the attack for robustness."
        ),
        headline=Figure(
            label="checks that hold",
            words=f"{len(passed)} of {len(passed) + len(red)}",
            note=f"{skipped} not made" if skipped else "",
        ),
        figures=(Figure(label="checks that do not hold", words=listed([one["check"] for one in red]) or "none"),),
        warnings=tuple(
            [f"{one['claim']}: {one['figures']}. {one['meaning']}" for one in red]
            + [f"Not checked: {one['claim']}" for one in checks if one["passed"] is None]
        ),
        tables=(
            Table(
                caption="Every check",
                head=("a sane attack", "here", "measured", "if it does not hold"),
                rows=tuple((one["claim"], _WORDS[one["passed"]], one["figures"], one["meaning"]) for one in checks),
            ),
        ),
        configuration=settings({key: value for key, value in found.items() if key not in _ELSEWHERE}),
    )
