"""The study of transfer: every attack, every judge, and a ledger of what is done.

Attacks leave JSONs in `jobs/` and splats in `attacked/`, judgements in `judged/`. What is there and belongs to the same
settings, scene and weights is not done again, so an interrupted study goes on where it stopped, and a further detector
judges the splats that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.study import run_jobs, run_with_file
from attacks.dagger.transfer.jobs import JudgeJob, SourceJob, TransferRunner

JUDGED = "judged"
"""Folder of the ledger of judgements."""


def run_transfer(
    jobs: Sequence[SourceJob],
    judges: Sequence[str],
    out: Path,
    runner: TransferRunner,
    *,
    on_job: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Attack what was not attacked yet, and let every detector judge it.

    Args:
        jobs: The attacks.
        judges: Names of the detectors that judge.
        out: Folder of the study.
        runner: Runs both.
        on_job: Called with the name of every attack that is done and judged.

    Returns:
        A record for each attack: `job`, `attack` (its summary), and `judged`, by detector what `TransferRunner.judge`
        returns.
    """
    records = []
    for job in jobs:
        attacked = run_with_file(job, out, runner.attack, fingerprint=runner.attack_fingerprint, file=runner.path(job))
        looks = [JudgeJob(source=job, detector=name) for name in judges]
        judged = run_jobs(looks, out, runner.judge, fingerprint=runner.judge_fingerprint, ledger=JUDGED)
        seen = {record["job"]["detector"]: record["result"] for record in judged}
        records.append({"job": attacked["job"], "attack": attacked["result"], "judged": seen})
        if on_job is not None:
            on_job(job.name)
    return records
