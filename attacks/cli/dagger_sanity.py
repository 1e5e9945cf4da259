"""`mi-splat dagger-sanity`: is the attack sane on this object and this detector; red lines end with exit status 1."""

from __future__ import annotations

import os
from typing import Any

from attacks.cli.aims import chosen_object
from attacks.cli.loading import loadable
from attacks.cli.sanity_options import DaggerSanityOptions
from attacks.dagger.config import DaggerConfig
from attacks.dagger.sanity.checks import CHECKS, Finding, run_checks, write_findings
from attacks.dagger.sanity.runs import Case, Runs
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.objectives import relabel
from attacks.studies.scenes import jittered
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.selecting import choose
from mi_splat.io.camera_records import describe
from mi_splat.io.folders import RECORD, check_new_folder, new_folder
from mi_splat.io.parsing import read_json
from mi_splat.scene_files import open_scene
from mi_splat.selection.select import require_visible

ATTACKS = 13
"""Kinds of attacks in the suite, each once a seed; for the progress bar."""


def run(options: DaggerSanityOptions) -> int:
    """Make the checks; 1 if one of them is red."""
    check_new_folder(options.out, force=options.force)
    limit_threads((os.cpu_count() or 1) // 2)
    findings: list[Finding] = []
    with progress("loading the scene and the detectors", total=ATTACKS * options.seeds) as advance:
        case, conditions = _case(options)
        runs = Runs(case, on_run=lambda: advance(f"check {len(findings) + 1} of {len(CHECKS)}"))
        advance("attacking", 0)
        run_checks(runs, checks=CHECKS, on_finding=findings.append)
        with new_folder(options.out, force=options.force) as folder:
            write_findings(findings, runs, folder, **conditions)
    red = sum(one.passed is False for one in findings)
    if options.json:
        show_json(read_json(options.out / RECORD))
    else:
        for one in findings:
            show(f"{one.colour:5}  {one.claim}: {one.figures}")
            if one.passed is False:
                show(f"{'':5}  -> {one.meaning}")
        show(f"{red} of {len(findings)} lines are red. The report is {options.out / 'sanity.md'}.")
    return 1 if red else 0


def _case(options: DaggerSanityOptions) -> tuple[Case, dict[str, Any]]:
    """What the options ask to check, and what the record has to say of it."""
    loaded = open_scene(options.scene)
    selection = chosen_object(loaded, options.selection)
    chosen = choose(loaded, selection, options.view)
    require_visible(chosen.weights(loaded))
    name, camera = next(iter(chosen.cameras.items()))
    centre = loaded.scene.means[chosen.mask].mean(0)
    case = Case(
        scene=loaded.scene,
        mask=chosen.mask,
        cameras=tuple(jittered(camera, centre, seed=seed) for seed in range(options.seeds)),
        detector=load_detector(options.detector, weights=options.weights),
        objective=relabel(options.target, confidence=options.confidence),
        render=chosen.render,
        config=DaggerConfig(eps=(options.eps,), norm=options.norm, steps=options.steps),
        surrogate=_surrogate(options),
    )
    return case, {
        "scene": str(options.scene),
        "selection": selection.as_dict(),
        "cameras": [describe(name, camera)],
    }


def _surrogate(options: DaggerSanityOptions) -> Detector | None:
    """The detector that attacks are transferred from; None if there is none."""
    if options.surrogate == "none":
        return None
    if options.surrogate != "auto":
        return load_detector(options.surrogate)
    others = [name for name in loadable() if name != options.detector]
    return load_detector(others[0]) if others else None
