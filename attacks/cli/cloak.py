"""`mi-splat cloak`: a study of CLOAK from the first picture to the table."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from attacks.cli.loading import load_detectors
from attacks.cli.options import CloakOptions
from attacks.cloak.study.ablations import check_variations, vary
from attacks.cloak.study.markdown import ROWS, words_of
from attacks.cloak.study.run import check, forecast, run_study
from attacks.cloak.study.study_file import read_study
from mi_splat.cli.console import limit_threads, progress, show, show_json, show_table, warn
from mi_splat.errors import InvalidValueError, message

_SHOWN = ("control_recall", "trigger_miss_rate", "benign_recall", "target_rate")


def run(options: CloakOptions) -> int:
    """Do the study, or what is missing of it, and say what came of it."""
    limit_threads(1)
    if options.values and not options.vary:
        do = "add --vary with the group that they are of, or leave --values out"
        raise InvalidValueError(message("--values", "values of a group", f"{' '.join(options.values)} alone", do))
    study = read_study(options.study)
    study = replace(study, seeds=options.seeds or study.seeds)
    if options.detectors:
        study = replace(study, evaluation=replace(study.evaluation, detectors=options.detectors))
    with progress("loading the detectors"):
        detectors = load_detectors(study.evaluation.detectors, options.weights)
        stages = options.stages or options.out / "stages"
        if options.vary:
            plans = check_variations(study, options.vary, detectors, options.out, stages, values=options.values)
            studies = {f", {group} {name}": one for group, some in plans.items() for name, one in some.items()}
        else:
            check(study, detectors, options.out, stages)
            studies = {"": study}
    forecasts = {f"{study.name}{name}": forecast(one) for name, one in studies.items()}
    for name, takes in forecasts.items():
        warn(f"{name}: {takes}")
    if options.forecast:
        if options.json:
            show_json({name: asdict(takes) for name, takes in forecasts.items()})
        return 0
    now = [""]
    with progress("starting", total=None) as advance:

        def follow(text: str, done: int, total: int) -> None:
            if text != now[0]:
                now[0] = text
                warn(text)
            advance(f"{text}, {done:,} of {total:,}")

        if options.vary:
            found = vary(
                study,
                options.vary,
                detectors,
                options.out,
                values=options.values,
                stages=options.stages,
                on_step=follow,
            )
        else:
            summary = run_study(study, detectors, options.out, stages=options.stages, on_step=follow)
    if options.json:
        show_json(found if options.vary else {**summary, "out": str(options.out)})
    elif options.vary:
        plots = ", ".join(f"{group}.png" for group in options.vary)
        show(f"{options.out}: variations.md, variations.json, {plots}")
    else:
        _tell(summary, options)
    return 0


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
