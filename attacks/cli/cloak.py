"""`mi-splat cloak`: a study of CLOAK from the first picture to the table."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import Detectors
from mi_splat.cli.console import follow, limit_threads, progress, show, show_json, show_table, warn
from mi_splat.cli.flags import Positional
from mi_splat.fields import Folder, Seed

if TYPE_CHECKING:
    from attacks.cloak.config import StudyConfig


EXAMPLES = (
    "cloak scenes/cloak_car_stealthy.toml --forecast",
    "cloak scenes/cloak_demo.toml --out out/cloak",
)
SEE_ALSO = ("study", "capture", "train")


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakOptions:
    """Do a study of CLOAK: capture, poison, train a clean and a cloaked splat, look at both, report.

    Says what it will take before it starts. A study that was interrupted goes on where it stopped when the same command
    is given again. Writes result.json, the rows, contact.png and both splats into --out.
    """

    study: Positional[Path]
    """TOML file of the study, for instance scenes/cloak_car_occluder.toml."""
    out: Folder = Path("out/cloak")
    """Folder for the results: a new one, or that of the same study."""
    stages: Folder | None = None
    """Folder of the stages, which several studies may share; None is a folder in --out."""
    seeds: tuple[Seed, ...] = ()
    """Seeds in the place of those of the study."""
    detectors: Detectors = ()
    """Names of detectors in the place of those of the study."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    forecast: bool = False
    """Check everything, say what the study would take, and do nothing."""
    json: bool = False
    """Print result.json as one JSON document on stdout."""


_SHOWN = ("control_recall", "trigger_miss_rate", "benign_recall", "target_rate")


def run(options: CloakOptions) -> int:
    """Do the study, or what is missing of it, and say what came of it."""
    from attacks.cli.names import weights_of
    from attacks.cloak.study import check, detectors_of, forecast, run_study

    limit_threads(1)
    study = _asked(options)
    with progress("loading the detectors"):
        weights = weights_of(study.evaluation.detectors, options.weights)
        check(study, detectors_of(study, weights), options.out, options.stages or options.out / "stages")
    takes = forecast(study)
    warn(f"{study.name}: {takes}")
    if options.forecast:
        if options.json:
            show_json({study.name: asdict(takes)})
        return 0
    with progress("starting", total=None) as advance:
        summary = run_study(study, options.out, weights=weights, stages=options.stages, on_step=follow(advance))
    if options.json:
        show_json({**summary, "out": str(options.out)})
    else:
        _tell(summary, options)
    return 0


def _asked(options: CloakOptions) -> StudyConfig:
    """The study of the file, with the seeds and detectors of the command."""
    from attacks.cloak.config import read_study

    study = read_study(options.study)
    study = replace(study, seeds=options.seeds or study.seeds)
    if not options.detectors:
        return study
    return replace(study, evaluation=replace(study.evaluation, detectors=options.detectors))


def _tell(summary: dict[str, Any], options: CloakOptions) -> None:
    """The figures that matter, for each detector."""
    from attacks.cloak.rates import RATES
    from attacks.tables import cell

    for name, rates in summary["by_detector"].items():
        show(name)
        show_table([(f"  {RATES[key]}", cell(rates[key])) for key in _SHOWN if rates[key] is not None])
    drop, band = summary["benign_psnr_drop"], summary["transition_degrees"]
    if drop is not None:
        clean = summary["benign_psnr"]["clean"]
        show(f"pictures far from the triggers: {clean:.1f} dB clean, {drop:.2f} dB less cloaked")
    show("transition: not seen" if band is None else f"transition: {band:.1f} degrees")
    show(f"{options.out}: result.json, {', '.join(summary['files'])}")
