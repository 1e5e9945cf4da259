"""`mi-splat cloak`: a study of CLOAK from the first picture to the table."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

from attacks.cli.options import Detectors, Workers, chosen_workers
from mi_splat.cli.console import follow, limit_threads, progress, show_json, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Folder, Seed

EXAMPLES = (
    "cloak scenes/cloak_car_colour.toml --forecast",
    "cloak scenes/cloak_demo.toml --out out/cloak",
)
SEE_ALSO = ("study", "capture", "train")


@dataclass(frozen=True, kw_only=True)
class CloakOptions(JsonOptions):
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
    workers: Workers | None = None
    """Processes that do steps side by side; None is one for each core if memory allows; 0 does all in this one."""
    forecast: bool = False
    """Check everything, say what the study would take, and do nothing."""


def check_inputs(options: CloakOptions) -> None:
    """Raise unless the study exists."""
    if not options.study.is_file():
        raise InvalidValueError.of("study", "a TOML file", f"no file {options.study}", "check the path")


def run(options: CloakOptions) -> None:
    """Do the study, or what is missing of it, and say what came of it."""
    from attacks.cli.names import weights_of
    from attacks.cli.summary import show_summary
    from attacks.cloak.config import read_study
    from attacks.cloak.study import check, detectors_of, forecast, run_study

    limit_threads(1)
    study = read_study(options.study)
    judges = replace(study.evaluation, detectors=options.detectors or study.evaluation.detectors)
    study = replace(study, seeds=options.seeds or study.seeds, evaluation=judges)
    with progress("loading the detectors"):
        weights = weights_of(study.evaluation.detectors, options.weights)
        check(study, detectors_of(study, weights), options.out, options.stages or options.out / "stages")
    takes = forecast(study)
    warn(f"{study.name}: {takes}")
    if options.forecast:
        if options.json:
            show_json({study.name: asdict(takes)})
        return
    with progress("starting", total=None) as advance:
        workers = chosen_workers(options.workers)
        told = follow(advance)
        run_study(study, options.out, weights=weights, stages=options.stages, on_step=told, workers=workers)
    show_summary(options.out, as_json=options.json, tables=1)
