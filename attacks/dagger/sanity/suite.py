"""The whole suite: every check, in the order of the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.sanity import comparisons, gradient_checks
from attacks.dagger.sanity.finding import Finding, markdown
from attacks.dagger.sanity.runs import Runs
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text
from mi_splat.scene import scene_hash

Check = Callable[[Runs], Finding]

CHECKS: tuple[Check, ...] = (
    comparisons.clean,
    comparisons.noise,
    comparisons.radius,
    comparisons.iterative,
    comparisons.white_box,
    comparisons.random_search,
    comparisons.more_steps,
    comparisons.unbounded,
    comparisons.budget,  # after the others: it looks at all their attacks
    gradient_checks.renderer_gradient,
    gradient_checks.gradient,
    gradient_checks.zero_gradients,
)
"""Each makes one finding."""


def run_checks(
    runs: Runs, *, checks: Sequence[Check] = CHECKS, on_finding: Callable[[Finding], None] | None = None
) -> list[Finding]:
    """Make every check.

    Args:
        runs: The case and the attacks on it.
        checks: What to check.
        on_finding: Called with each finding as it comes.
    """
    found = []
    for check in checks:
        found.append(check(runs))
        if on_finding is not None:
            on_finding(found[-1])
    return found


def write_findings(findings: list[Finding], runs: Runs, folder: Path, **more: Any) -> list[Path]:
    """Write sanity.md and sanity.json into a folder that is there; returns their paths.

    Args:
        findings: What the checks have found.
        runs: The attacks.
        folder: Where to.
        more: What else the JSON shall hold, for instance names of files.
    """
    case, config = runs.case, runs.case.config
    surrogate = None if case.surrogate is None else case.surrogate.name
    conditions = (
        f"{case.detector.name} shall report {case.objective.label} at {case.objective.confidence:g} or more. "
        f"{config.norm} ball of {config.eps[0]:g} over {', '.join(config.attributes)}, {config.steps} steps, "
        f"{len(case.cameras)} seeds, each with its own view. Surrogate: {surrogate or 'none'}. "
        f"{len(runs.made)} attacks were made."
    )
    paths = [folder / "sanity.md", folder / "sanity.json"]
    save_text(markdown(findings, f"Sanity of DAGGER on {case.detector.name}", conditions), paths[0])
    document = {
        "passed": all(one.passed is not False for one in findings),
        "checks": [one.as_dict() for one in findings],
        "detector": case.detector.name,
        "detector_fingerprint": case.detector.fingerprint,
        "surrogate": surrogate,
        "target": case.objective.label,
        "confidence": case.objective.confidence,
        "seeds": len(case.cameras),
        "steps": config.steps,
        "eps": list(config.eps),
        "norm": config.norm,
        "attributes": list(config.attributes),
        "scene_hash": scene_hash(case.scene),
        **provenance.rendered_with(case.render),
        **provenance.origin(),
        **more,
    }
    save_json(document, paths[1])
    return paths
