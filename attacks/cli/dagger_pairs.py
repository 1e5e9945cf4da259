"""`mi-splat dagger-pairs`: the paper's six attacks on several detectors."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable

from attacks.cli.attack_scenes import read_attack_scene
from attacks.cli.options import DaggerPairsOptions
from attacks.dagger.jobs import AttackScene, Job, JobRunner
from attacks.dagger.pairs import SEARCHES, SUMMARY, Attack, ledger, pairs_table, run_pairs, write_summary
from attacks.dagger.study import PAIRS
from attacks.detectors import load_detector
from mi_splat.cli.console import Advance, limit_threads, progress, show, show_json
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import own_folder


def run(options: DaggerPairsOptions) -> int:
    """Attack what is not attacked yet, and write the tables."""
    with own_folder(options.out, SUMMARY, *options.detectors):
        return _pairs(options)


def _pairs(options: DaggerPairsOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    for name, values in (("detectors", options.detectors), ("eps", options.eps)):
        if not values or len(set(values)) != len(values):
            raise InvalidValueError(message(name, "one or more, each once", values or "none", "name them"))
    limit_threads((os.cpu_count() or 1) // 2)
    attacks: dict[str, Attack] = {}

    @functools.cache
    def read(name: str) -> AttackScene:
        return read_attack_scene(options.scenes / f"{name}.xml")

    objective = {"confidence": options.confidence, **SEARCHES[options.search].objective}
    detectors = [load_detector(name) for name in options.detectors]
    total = len(detectors) * len(PAIRS) * options.seeds * len(options.eps)
    with progress("attacking", total=None if options.radii else total) as advance:
        for detector in detectors:
            runner = JobRunner(read, detector, objective=objective)
            attacks[detector.name] = ledger(
                runner,
                options.out / detector.name,
                on_job=_follow(advance, detector.name),
            )
        found = run_pairs(
            attacks,
            eps=options.eps,
            steps=options.steps,
            seeds=range(options.seeds),
            radii=sorted(options.radii),
            search=options.search,
        )
    write_summary(found, options.out)
    if options.json:
        show_json(found)
    else:
        show(pairs_table(found))
        show(f"Pictures, clean on the left: {options.out}/*/pictures; every number: {options.out / SUMMARY}")
    return 0


def _follow(advance: Advance, detector: str) -> Callable[[Job], None]:
    """A callback that shows each attack."""
    return lambda job: advance(f"{detector}: {job.object} to {job.target}")
