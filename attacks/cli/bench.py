"""`mi-splat bench`: one row of the scoreboard: how robust a detector is, or what a
defence is worth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from attacks.cli.study import JobOptions, run_in
from mi_splat.cli.console import limit_threads, show, show_json
from mi_splat.cli.flags import Positional
from mi_splat.fields import Metavar, OutFolder

EXAMPLES = (
    "bench fasterrcnn_small",
    "bench fasterrcnn_small --weights YOUR.safetensors --out out/bench/mine",
    "bench fasterrcnn_small --defence .spz",
)


@dataclass(frozen=True, kw_only=True)
class BenchOptions(JobOptions):
    """Do a suite of attacks, the same for everybody, and write one row: how often a
    detector still names the object.

    Columns: DAGGER from one view, DAGGER for all views, CLOAK, and attacks that were
    made on other detectors. Only views count in which the detector names the clean
    object. Higher is more robust. A run that was killed resumes where it stopped. Run
    it in a checkout, where scenes/suites is.
    """

    detector: Positional[str] = "fasterrcnn_small"
    """Name of the detector (see `mi-splat detectors`)."""
    suite: str = "v1"
    """Name of the suite, or its folder."""
    weights: Path | None = None
    """File with weights of the detector. Default: the shipped or published ones."""
    defence: Annotated[str, Metavar("CONDITION")] | None = None
    """What comes before the detector: a condition, as "SH of degree 1", "JPEG 60" or
    that of a plug-in.
    """
    columns: tuple[str, ...] = ()
    """Columns to run; the row has those that are finished. Default: all."""
    store: OutFolder = Path("out/store")
    """Folder of finished jobs; detector-independent jobs are shared there."""
    out: OutFolder | None = None
    """Folder for the row and its raw rows. Default: out/bench/SUITE/NAME, or another
    one beside it with --weights or --defence.
    """


def run(options: BenchOptions) -> int:
    """Do what is asked for; the exit status is 1 if a job has failed."""
    from attacks.bench.suite import BenchWork, read_suite
    from attacks.figures.frame import read_figures
    from attacks.studies.running import STUDY_FILE, TABLE

    limit_threads(1)
    suite = read_suite(options.suite)
    work = BenchWork(
        suite,
        options.detector,
        weights=options.weights,
        defence=options.defence or "",
        columns=options.columns,
    )
    out = options.out or usual_folder(options)
    done = run_in(out, STUDY_FILE, work, options)
    if options.json:
        show_json(
            {
                "failed": done.failed,
                "out": str(out),
                "figures": read_figures(out).as_dicts() if done.files else None,
            }
        )
    elif done.files:
        show((out / TABLE).read_text())
        show(
            f"{out}: figures.csv has every rate, rows.csv.xz every look; mi-splat"
            f" artifact-check {out} counts them again."
        )
    if done.failed:
        return 1
    return 0


def usual_folder(options: BenchOptions) -> Path:
    """Where a row goes if nothing is said: each detector, weights and defence has a
    folder of its own.
    """
    from mi_splat.io.documents import file_name

    weights = options.weights.stem if options.weights else ""
    name = " ".join(filter(None, (options.detector, weights, options.defence)))
    return Path("out/bench") / Path(options.suite).name / file_name(name)
