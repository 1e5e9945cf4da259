"""`mi-splat dagger-eot-study`: many attacks on distributions of views, and tables of them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.dagger_eot import follow
from attacks.cli.eot_options import DaggerEotStudyOptions
from attacks.dagger.eot.jobs import EotJob, EotJobRunner
from attacks.dagger.eot.study import GROUPS, StudySetup
from attacks.dagger.eot.tables import write_eot_tables
from attacks.dagger.study import JOBS, run_jobs, stored_records
from attacks.detectors import load_detector
from attacks.transformations.config import Transformations
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import own_folder


def run(options: DaggerEotStudyOptions) -> int:
    """Run the study, or what is missing of it, and write its tables."""
    with own_folder(options.out, JOBS):
        return _study(options)


def _study(options: DaggerEotStudyOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    limit_threads((os.cpu_count() or 1) // 2)
    groups = options.groups or tuple(GROUPS)
    for group in groups:
        if group not in GROUPS:
            raise InvalidValueError(message("groups", f"some of {', '.join(GROUPS)}", group, "name one of these"))
    setup = _setup(options)
    with progress("attacking") as advance:
        runner = EotJobRunner(
            lambda name: read_attack_scene(options.scenes / f"{name}.xml"),
            load_detector,
            keep=options.out / "results",
            on_step=follow(advance),
        )

        def ask(job: EotJob) -> Mapping[str, Any]:
            advance(job.name)
            (record,) = run_jobs([job], options.out, runner.run, fingerprint=runner.fingerprint)
            write_eot_tables(stored_records(options.out), options.out)
            result: Mapping[str, Any] = record["result"]
            return result

        for group in groups:
            GROUPS[group](ask, setup)
    records = stored_records(options.out)
    files = [str(path) for path in write_eot_tables(records, options.out)]
    if options.json:
        show_json({"jobs": len(records), "files": files})
    else:
        show("\n".join(files))
    return 0


def _setup(options: DaggerEotStudyOptions) -> StudySetup:
    """What all attacks of the study have in common."""
    setup = StudySetup(
        detectors=options.detectors,
        confidence=options.confidence,
        config=options.config,
        transformations=Transformations(cameras=options.region),
        search=options.search,
    )
    chosen = tuple(setup.pairs[number] for number in options.pairs if number < len(setup.pairs))
    if len(chosen) != len(options.pairs):
        expected = f"numbers in 0..{len(setup.pairs) - 1}"
        raise InvalidValueError(message("pairs", expected, options.pairs, "0 is the first of docs/dagger.md"))
    return dataclasses.replace(setup, pairs=chosen) if chosen else setup
