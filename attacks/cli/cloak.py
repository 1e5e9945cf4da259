"""`mi-splat cloak`: a study of CLOAK from the first image to the table."""

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from attacks.cli.options import Address, Detectors, Workers
from mi_splat.cli.console import limit_threads, progress
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import OutFolder, Seed

EXAMPLES = (
    "cloak scenes/cloak_car_colour.toml --forecast",
    "cloak scenes/cloak_demo.toml --out out/cloak",
    "cloak scenes/cloak_demo.toml --object YOUR.glb --label car --out out/yours",
)
STUDY_FILE = "study.toml"


@dataclass(frozen=True, kw_only=True)
class CloakOptions(JsonOptions):
    """Run a CLOAK study: capture, poison, train a clean and an attacked splat, run
    detectors on both, report.

    Repeat the command to resume an interrupted study. Writes result.json, the rows,
    contact.png and both splats into --out.
    """

    study: Positional[Path]
    """TOML file of the study, for instance scenes/cloak_car_stealthy.toml."""
    out: OutFolder = Path("out/cloak")
    """Folder for the results: a new one, or that of the same study."""
    stages: OutFolder | None = None
    """Folder of the stages, which several studies may share. Default: a folder in
    --out.
    """
    object: str | None = None
    """GLB file, or name of a shipped object, instead of the study's."""
    label: str | None = None
    """Class name of that object for the detectors. Default: the name of the object or
    of its file.
    """
    seeds: tuple[Seed, ...] = ()
    """Seeds instead of those of the study."""
    detectors: Detectors = ()
    """Names of detectors instead of those of the study."""
    weights: tuple[Path, ...] = ()
    """Weight files, one for each detector. Default: the shipped or published ones."""
    workers: Workers | None = None
    """Number of parallel worker processes; 0 runs everything in this one. Default: one
    per core, if memory allows.
    """
    scheduler: Address | None = None
    """Address of a Dask scheduler whose workers run the steps; --stages has to be on a
    disk that all of them share.
    """
    forecast: bool = False
    """Check everything and print the number of jobs and the estimated time, without
    running anything.
    """


def check_inputs(options: CloakOptions) -> None:
    """Raise unless the study exists."""
    if not options.study.is_file():
        raise InvalidValueError.of(
            "study", "a TOML file", f"no file {options.study}", "check the path"
        )


def run(options: CloakOptions) -> int:
    """Do the study, or what is missing of it, and say what came of it."""
    from attacks.cli.options import weights_of
    from attacks.cli.study import StudyOptions, run_work, show_forecast
    from attacks.cli.summary import show_summary
    from attacks.cloak.study import study_toml
    from attacks.studies.cloak import CloakReport, config_of
    from attacks.studies.study_file import merged, read_study
    from mi_splat.io.documents import save_text

    limit_threads(1)
    file = read_study(options.study)
    if file.kind != "cloak" or len(file.points) != 1:
        expected = "one study of CLOAK"
        do = "run it with mi-splat study"
        raise InvalidValueError.of(
            str(options.study), expected, f"{len(file.points)} of kind {file.kind}", do
        )
    changes: dict[str, Any] = {"seeds": list(options.seeds)} if options.seeds else {}
    if options.detectors:
        changes["evaluation"] = {"detectors": list(options.detectors)}
    if options.object is not None:
        label = options.label or "none"
        changes["scene"] = {"object": options.object, "label": label}
    point = replace(file.points[0], settings=merged(file.points[0].settings, changes))
    with progress("loading the detectors"):
        weights = weights_of(
            config_of(point.settings, file.name).evaluation.detectors, options.weights
        )
        work = CloakReport(replace(file, parts={"": [point]}), weights)
    study = work.attempts[0].steps.study
    store = options.stages or options.out / "stages"
    text = study_toml(asdict(study))
    _check_folder(options.out, text)
    run_options = StudyOptions(
        action="run",
        study=options.study,
        store=store,
        out=options.out,
        workers=options.workers,
        scheduler=options.scheduler,
        json=options.json,
    )
    if options.forecast:
        show_forecast(run_options, work)
        return 0
    begin = partial(save_text, text, options.out / STUDY_FILE)
    done = run_work(run_options, work, begin=begin)
    if done.files:
        show_summary(options.out, as_json=options.json, tables=1)
    if done.failed:
        return 1
    return 0


def _check_folder(out: Path, text: str) -> None:
    """Refuse a folder with something else, or with the results of another study."""
    from mi_splat.io.folders import check_own_folder

    check_own_folder(out, STUDY_FILE)
    if (out / STUDY_FILE).is_file() and (out / STUDY_FILE).read_text("utf-8") != text:
        do = (
            "choose another folder; stages that both need are not done again with the"
            " same folder of stages"
        )
        raise InvalidValueError.of(
            str(out), "results of this study", "those of another", do
        ).hinted("--out, --stages")
