"""`mi-splat dagger-transfer`: attacks on some detectors, judged by all, and the matrix of it."""

from __future__ import annotations

import os

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.transfer_options import DaggerTransferOptions
from attacks.dagger.study import JOBS
from attacks.dagger.transfer.jobs import TransferRunner, transfer_jobs
from attacks.dagger.transfer.study import run_transfer
from attacks.dagger.transfer.tables import write_tables
from attacks.detectors import load_detector
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import limit_threads, progress, show, show_json, warn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import check_own_folder

STUDIED = ("_small", "_coco")
"""Endings of the names of the detectors that are taken if none is named: the project's own, and those that
`mi-splat detectors --get` fetches."""


def run(options: DaggerTransferOptions) -> int:
    """Run the study, or what is missing of it; its tables are written after every seed."""
    check_own_folder(options.out, JOBS)
    limit_threads((os.cpu_count() or 1) // 2)
    names = _chosen(options)
    judges = list(dict.fromkeys([*names, *options.judges]))
    jobs = transfer_jobs(names, seeds=options.seeds, eps=options.eps, steps=options.steps, ensembles=options.ensembles)
    runner = TransferRunner(lambda name: read_attack_scene(options.scenes / f"{name}.xml"), load_detector, options.out)
    records, files = [], []
    with progress("attacking", total=len(jobs)) as advance:
        for seed in range(options.seeds):
            some = [job for job in jobs if job.config.seed == seed]
            records += run_transfer(some, judges, options.out, runner, on_job=advance)
            files = [str(path) for path in write_tables(records, options.out)]
    if options.json:
        show_json({"jobs": len(records), "files": files})
    else:
        show("\n".join(files))
    return 0


def _chosen(options: DaggerTransferOptions) -> list[str]:
    """Names of the detectors that are attacked."""
    names = list(options.detectors) or loadable()
    if len(set(names)) < len(names) or not names:
        raise InvalidValueError(message("--detectors", "different names", names, "see `mi-splat detectors`"))
    return names


def loadable() -> list[str]:
    """Names of the detectors of a study that can be loaded here; says which cannot, and why."""
    found = []
    for name in DETECTORS:
        if name.endswith(STUDIED):
            missing = DETECTORS[name].missing()
            if missing:
                warn(f"{name} is left out: {missing}")
            else:
                found.append(name)
    return found
