"""`mi-splat doctor`: print the findings of `attacks.cli.checks`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from attacks.cli.checks import GROUPS, examine
from mi_splat.cli.console import progress, show, show_json

EXAMPLES = ("doctor",)
SEE_ALSO = ("detectors",)


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """Render one Gaussian, take one gradient, load one detector; say what works and what to do about what does not.

    The exit status is 1 if something that `mi-splat dagger` needs does not work.
    """

    json: bool = False
    """Print the findings as one JSON document on stdout."""


def run(options: DoctorOptions) -> int:
    """Examine this machine; 1 if something that `mi-splat dagger` needs does not work."""
    with progress("checking", total=len(GROUPS)) as advance:
        findings = examine(lambda group: advance(f"checked {group}"))
    healthy = all(finding.state == "works" for finding in findings if finding.required)
    if options.json:
        show_json({"healthy": healthy, "findings": [dataclasses.asdict(finding) for finding in findings]})
        return 0 if healthy else 1
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        show(f"{finding.state:7}  {finding.name:{width}}  {finding.detail}")
        if finding.advice:
            show(f"{'':7}  {'':{width}}  -> {finding.advice}")
    show("all that mi-splat needs works" if healthy else "something that mi-splat needs does not work; see the arrows")
    return 0 if healthy else 1
