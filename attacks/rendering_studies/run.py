"""Runs a rendering study: every attack, every look at it, and a ledger of what is done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.study import run_jobs, run_with_file
from attacks.rendering_studies.config import RenderingStudy
from attacks.rendering_studies.jobs import StudyAttack, StudyRunner, looks_at

LOOKS = "looks"
"""Folder of the ledger of looks."""


def run_study(
    study: RenderingStudy,
    jobs: Sequence[StudyAttack],
    out: Path,
    runner: StudyRunner,
    *,
    on_job: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Attack what was not attacked yet, and look at it under every condition.

    Args:
        study: The study.
        jobs: Its attacks, or some of them.
        out: Folder of the study.
        runner: Runs both.
        on_job: Called with the name of every attack that is done and was looked at.

    Returns:
        A record for each attack, see `attacks.rendering_studies.rates.Record`.

    Raises:
        MiSplatError: Something that an attack or a look needs cannot be (`StudyRunner.check`); nothing was done yet.
    """
    runner.check(jobs)
    records = []
    for job in jobs:
        attacked = run_with_file(job, out, runner.attack, fingerprint=runner.fingerprint, file=runner.path(job))
        looks = run_jobs(looks_at(study, job), out, runner.look, fingerprint=runner.look_fingerprint, ledger=LOOKS)
        seen = {look["job"]["condition"]: look["result"] for look in looks}
        records.append({"job": attacked["job"], "attack": attacked["result"], "looks": seen})
        if on_job is not None:
            on_job(job.name)
    return records
