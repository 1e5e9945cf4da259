"""The run of a study: the work of its kind, the jobs that an engine does, and the result that is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.studies.study_file import Study, read_study
from mi_splat.errors import InvalidValueError

if TYPE_CHECKING:
    from attacks.studies.plan import Work
    from mi_splat.ledger.engines import Engine
    from mi_splat.ledger.job import OnEvent

STORE = Path("out/store")
"""Folder of finished jobs where none is named."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a run of a study left behind."""

    jobs: int  # how many there are
    failed: dict[str, str]  # what was said by those that have failed, by their labels
    files: tuple[Path, ...]  # of the result; none where all jobs have failed


def work_of(study: Study) -> Work:
    """The jobs of a study, by its kind."""
    if study.kind == "cloak":
        from attacks.studies.cloak import CloakWork

        return CloakWork(study)
    if study.kind == "audit":
        from attacks.studies.audit import AuditWork

        return AuditWork(study)
    if study.kind == "poison":
        from attacks.studies.poison import PoisonWork

        return PoisonWork(study)
    from attacks.studies.dagger import DaggerWork

    return DaggerWork(study)


def run_with(engine: Engine, study: Study, work: Work, *, store: Path, out: Path, on_event: OnEvent) -> Run:
    """Do what of a study is not done yet, and write its result into a folder that is its own."""
    from mi_splat.io.folders import write_manifest
    from mi_splat.ledger.plans import Driver

    results = Driver(store, engine, name=study.name, on_event=on_event).run(work.plans())
    failed = {label: result for label, result in results.items() if isinstance(result, str)}
    files = [] if len(failed) == len(results) else work.write(results, out)
    if files:
        write_manifest(out, without=(store.name,) if store.parent == out else ())
    return Run(jobs=len(results), failed=failed, files=tuple(files))


def run_study(
    study: str | Path,
    *,
    out: str | Path | None = None,
    store: str | Path = STORE,
    workers: int = 0,
    parts: Sequence[str] = (),
) -> Path:
    """Run a study: many attacks and what they hang on, from one TOML file.

    Finished jobs are kept in the store, so that a run that was interrupted goes on where it stopped.

    Args:
        study: TOML file of the study; scenes/studies has some, and docs/studies.md says what may stand in it.
        out: Folder for the result; None is out/studies/NAME. `rows` reads its table.
        store: Folder of finished jobs, which several studies may share.
        workers: Processes that do jobs side by side; 0 does them in this one.
        parts: Names of cases to do; all if none is named.

    Returns:
        The folder of the result.

    Raises:
        InvalidValueError: The file is no study, a setting cannot be, or a job of another process has failed; what a job
            of this process raises comes as it is.
    """
    from attacks.studies.plan import STUDY_FILE
    from mi_splat.io.folders import check_own_folder, own_folder
    from mi_splat.ledger.engines import InProcess, Processes
    from mi_splat.ledger.job import nobody

    asked, kept = read_study(Path(study)).of(tuple(parts)), Path(store)
    folder = Path("out/studies") / asked.name if out is None else Path(out)
    check_own_folder(folder, STUDY_FILE)
    work = work_of(asked)
    work.check_room(kept)
    with own_folder(folder, STUDY_FILE):
        engine: Engine = Processes(kept, workers=workers) if workers else InProcess(kept)
        run = run_with(engine, asked, work, store=kept, out=folder, on_event=nobody)
    if run.failed:
        label, text = next(iter(run.failed.items()))
        expected, got = f"{run.jobs} jobs that are done", f"{len(run.failed)} that failed; {label}: {text.strip()}"
        raise InvalidValueError.of(str(study), expected, got, "mend the cause, and let mi-splat study retry it")
    return folder
