"""`mi-splat dagger-transfer`: attacks on some detectors, judged by all, and the matrix of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.transfer_options import DaggerTransferOptions
from attacks.dagger.jobs import AttackScene
from attacks.dagger.study import JOBS
from attacks.dagger.transfer.held_out import HELD_OUT, HeldOutRunner, held_out_jobs, run_held_out
from attacks.dagger.transfer.jobs import TransferRunner, transfer_jobs
from attacks.dagger.transfer.study import run_transfer
from attacks.dagger.transfer.tables import write_held_out, write_tables
from attacks.detectors import load_detector
from attacks.detectors.registry import DETECTORS
from mi_splat import provenance
from mi_splat.cli.console import limit_threads, progress, show, show_json, warn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import own_folder

STUDIED = ("_small", "_coco")
"""Endings of the names of the detectors that are taken if none is named: the project's own, and those that
`mi-splat detectors --get` fetches."""


def run(options: DaggerTransferOptions) -> int:
    """Run the study, or what is missing of it; its tables are written after every seed."""
    with own_folder(options.out, JOBS, HELD_OUT):
        return _transfer(options)


def _transfer(options: DaggerTransferOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    limit_threads((os.cpu_count() or 1) // 2)
    names = _chosen(options)
    judges = list(dict.fromkeys([*names, *options.judges]))
    if options.eot_study is None:
        count, files = _attack(options, names, judges)
    else:
        count, files = _judge(options, options.eot_study, judges)
    if options.json:
        show_json({"jobs": count, "files": [str(path) for path in files]})
    else:
        show("\n".join(map(str, files)))
    return 0


def _attack(options: DaggerTransferOptions, names: list[str], judges: list[str]) -> tuple[int, list[Path]]:
    """Attack and judge; number of attacks, and the files of the tables, which are written after every seed."""
    jobs = transfer_jobs(names, seeds=options.seeds, eps=options.eps, steps=options.steps, ensembles=options.ensembles)
    runner = TransferRunner(_reader(options), load_detector, options.out)
    records: list[dict[str, Any]] = []
    files: list[Path] = []
    with progress("attacking", total=len(jobs)) as advance:
        for seed in range(options.seeds):
            some = [job for job in jobs if job.config.seed == seed]
            records += run_transfer(some, judges, options.out, runner, on_job=advance)
            files = write_tables(records, options.out)
    return len(records), files


def _judge(options: DaggerTransferOptions, study: Path, judges: list[str]) -> tuple[int, list[Path]]:
    """Judge the splats of a study on held-out views; number of looks, and the files."""
    jobs = held_out_jobs(study, judges, views=options.views)
    runner = HeldOutRunner(_reader(options), load_detector, study)
    with progress("judging", total=len(jobs)) as advance:
        records = run_held_out(jobs, options.out, runner, on_job=advance)
    attacks = len({job.attack for job in jobs})
    origin = {
        "study": str(study),
        "scenes": str(options.scenes),
        "weights": runner.weights(judges),
        **provenance.origin(),
    }
    return len(jobs), write_held_out(records, options.out, attacks=attacks, views=options.views, origin=origin)


def _reader(options: DaggerTransferOptions) -> Callable[[str], AttackScene]:
    return lambda name: read_attack_scene(options.scenes / f"{name}.xml")


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
