"""`mi-splat dagger-study`: many attacks, and tables of them."""

from __future__ import annotations

import os

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.options import DaggerStudyOptions
from attacks.dagger.jobs import Job, JobRunner
from attacks.dagger.study import JOBS, run_jobs, study_jobs
from attacks.dagger.tables import write_tables
from attacks.detectors import load_detector
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import own_folder


def run(options: DaggerStudyOptions) -> int:
    """Run the study, or what is missing of it, and write its tables."""
    with own_folder(options.out, JOBS):
        return _study(options)


def _study(options: DaggerStudyOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    limit_threads((os.cpu_count() or 1) // 2)
    jobs = _chosen(options)
    runner = JobRunner(
        lambda name: read_attack_scene(options.scenes / f"{name}.xml"),
        load_detector(options.detector, weights=options.weights),
    )
    with progress("attacking", total=len(jobs)) as advance:
        records = run_jobs(
            jobs, options.out, runner.run, fingerprint=runner.fingerprint, on_job=lambda job: advance(job.name)
        )
    files = [str(path) for path in write_tables(records, options.out)]
    if options.json:
        show_json({"jobs": len(records), "files": files})
    else:
        show("\n".join(files))
    return 0


def _chosen(options: DaggerStudyOptions) -> list[Job]:
    """The jobs of the groups that the options name."""
    jobs = study_jobs(options.seeds)
    groups = tuple(dict.fromkeys(job.group for job in jobs))
    for group in options.groups:
        if group not in groups:
            raise InvalidValueError(message("groups", f"some of {', '.join(groups)}", group, "name one of these"))
    return [job for job in jobs if not options.groups or job.group in options.groups]
