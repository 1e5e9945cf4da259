"""`mi-splat cloak`: a study of CLOAK from the first picture to the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from attacks.cli.loading import weights_of
from attacks.cli.options import CloakOptions
from attacks.cloak.config import StudyConfig, read_study
from attacks.cloak.rates import ROWS, words_of
from attacks.cloak.study import check, detectors_of, forecast, run_study
from attacks.cloak.variations import check_variations, vary
from attacks.detectors import Detector
from mi_splat.cli.console import follow, limit_threads, progress, show, show_json, show_table, warn
from mi_splat.errors import InvalidValueError, message

_SHOWN = ("control_recall", "trigger_miss_rate", "benign_recall", "target_rate")


def run(options: CloakOptions) -> int:
    """Do the study, or what is missing of it, and say what came of it."""
    limit_threads(1)
    study = _asked(options)
    with progress("loading the detectors"):
        weights = weights_of(study.evaluation.detectors, options.weights)
        detectors = detectors_of(study, weights)
        studies = _checked(study, detectors, options)
    forecasts = {name: forecast(one) for name, one in studies.items()}
    for name, takes in forecasts.items():
        warn(f"{name}: {takes}")
    if options.forecast:
        if options.json:
            show_json({name: asdict(takes) for name, takes in forecasts.items()})
        return 0
    with progress("starting", total=None) as advance:
        if options.vary:
            found = vary(
                study,
                options.vary,
                options.out,
                weights=weights,
                values=options.values,
                stages=options.stages,
                on_step=follow(advance),
            )
        else:
            summary = run_study(study, options.out, weights=weights, stages=options.stages, on_step=follow(advance))
    if options.json:
        show_json(found if options.vary else {**summary, "out": str(options.out)})
    elif options.vary:
        plots = ", ".join(f"{group}.png" for group in options.vary)
        show(f"{options.out}: variations.md, variations.json, {plots}")
    else:
        _tell(summary, options)
    return 0


def _asked(options: CloakOptions) -> StudyConfig:
    """The study of the file, with the seeds and detectors of the command."""
    if options.values and not options.vary:
        do = "add --vary with the group that they are of, or leave --values out"
        raise InvalidValueError(message("--values", "values of a group", f"{' '.join(options.values)} alone", do))
    study = read_study(options.study)
    study = replace(study, seeds=options.seeds or study.seeds)
    if not options.detectors:
        return study
    return replace(study, evaluation=replace(study.evaluation, detectors=options.detectors))


def _checked(study: StudyConfig, detectors: Sequence[Detector], options: CloakOptions) -> dict[str, StudyConfig]:
    """Every study that the command asks for, by what it is called, once it is known that each can be done."""
    stages = options.stages or options.out / "stages"
    if not options.vary:
        check(study, detectors, options.out, stages)
        return {study.name: study}
    plans = check_variations(study, options.vary, detectors, options.out, stages, values=options.values)
    return {f"{study.name}, {group} {name}": one for group, some in plans.items() for name, one in some.items()}


def _tell(summary: dict[str, Any], options: CloakOptions) -> None:
    """The figures that matter, for each detector."""
    for name, rates in summary["by_detector"].items():
        show(name)
        show_table([(f"  {ROWS[key]}", words_of(rates[key])) for key in _SHOWN if rates[key] is not None])
    drop, band = summary["benign_psnr_drop"], summary["transition_degrees"]
    if drop is not None:
        clean = summary["benign_psnr"]["clean"]
        show(f"pictures far from the triggers: {clean:.1f} dB clean, {drop:.2f} dB less cloaked")
    show("transition: not seen" if band is None else f"transition: {band:.1f} degrees")
    show(f"{options.out}: summary.json, {', '.join(summary['files'])}")
