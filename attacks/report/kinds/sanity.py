"""What `mi-splat dagger --sanity` leaves behind: whether an attack that fails may be believed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.report.section import Figure, Section, listed, plural, settings
from attacks.tables import Table

_ELSEWHERE = ("story", "checks", "command", "versions", "variant", "commit")
_WORDS = {True: "holds", False: "does not hold", None: "not checked"}


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a suite."""
    checks = record["checks"]
    passed, red, skipped = ([check for check in checks if check["passed"] is state] for state in _WORDS)
    return Section(
        kind="sanity of DAGGER",
        title=f"{record['detector']}, {record['target']}",
        done=(
            f"{plural(len(checks), 'check')} asked whether DAGGER behaves as a sane attack does on one object and "
            f"{record['detector']}, with {plural(record['seeds'], 'seed')}: whether success rises with the radius, "
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
            note=f"{len(skipped)} not made" if skipped else "",
        ),
        figures=(Figure(label="checks that do not hold", words=listed([check["check"] for check in red]) or "none"),),
        warnings=(
            *(f"{check['claim']}: {check['figures']}. {check['meaning']}" for check in red),
            *(f"Not checked: {check['claim']}" for check in skipped),
        ),
        tables=(
            Table.of(
                "Every check",
                {
                    "a sane attack": "claim",
                    "here": lambda check: _WORDS[check["passed"]],
                    "measured": "figures",
                    "if it does not hold": "meaning",
                },
                checks,
            ),
        ),
        configuration=settings({key: value for key, value in record.items() if key not in _ELSEWHERE}),
    )
