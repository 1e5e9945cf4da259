"""`mi-splat rendering-study`: what becomes of attacks in other renderers, other files, and a street of meshes."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.transfer_options import RenderingStudyOptions
from attacks.dagger.study import JOBS
from attacks.detectors import load_detector
from attacks.rendering_studies.config import read_rendering_study
from attacks.rendering_studies.jobs import StudyRunner, attacks_of
from attacks.rendering_studies.run import run_study
from attacks.rendering_studies.tables import write_study
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.io.folders import own_folder


def run(options: RenderingStudyOptions) -> int:
    """Run the study, or what is missing of it; its tables are written after every seed."""
    with own_folder(options.out, JOBS):
        return _study(options)


def _study(options: RenderingStudyOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    study = read_rendering_study(options.study)
    toml = options.study.read_text("utf-8-sig")
    if options.seeds is not None:
        study = dataclasses.replace(study, seeds=options.seeds)
    if options.detectors:
        study = dataclasses.replace(study, detectors=options.detectors)
    limit_threads((os.cpu_count() or 1) // 2)
    runner = StudyRunner(
        study, lambda name: read_attack_scene(options.scenes / f"{name}.xml"), load_detector, options.out
    )
    jobs = attacks_of(study)
    records: list[dict[str, Any]] = []
    files = []
    with progress("attacking", total=len(jobs)) as advance:
        for seed in range(study.seeds):
            some = [job for job in jobs if job.config.seed == seed]
            records += run_study(study, some, options.out, runner, on_job=advance)
            files = [str(path) for path in write_study(study, records, options.out, toml=toml)]
    if options.json:
        show_json({"attacks": len(records), "files": files})
    else:
        show("\n".join(files))
    return 0
