"""`mi-splat study`: what a study will take, its run, how far it is, and what to do with
what it keeps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from attacks.cli.options import Address, Workers, chosen_workers
from attacks.studies.study_file import Study
from mi_splat.cli.console import (
    Advance,
    UsageError,
    limit_threads,
    progress,
    show,
    show_json,
    show_result,
    warn,
)
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.fields import OutFolder, at_least

if TYPE_CHECKING:
    from attacks.studies.running import Run, Work
    from mi_splat.ledger import Event
    from mi_splat.ledger.engines import Engine
    from mi_splat.ledger.states import Entry


EXAMPLES = (
    "study plan scenes/studies/dagger.toml",
    "study run scenes/studies/pairs.toml --out out/studies/pairs",
    "study run scenes/studies/dagger.toml --workers 4",
)


@dataclass(frozen=True, kw_only=True)
class JobOptions(JsonOptions):
    """What a command takes that does many jobs."""

    store: OutFolder = Path("out/store")
    """Folder of finished jobs."""
    workers: Workers | None = None
    """Number of parallel worker processes; 0 runs everything in this one. Default: one
    per core, if memory allows.
    """
    scheduler: Address | None = None
    """Address of a Dask scheduler, as tcp://HOST:8786, whose workers run the jobs;
    --store has to be on a disk that all of them share.
    """
    seconds: Annotated[float, at_least(1, "seconds")] | None = None
    """Time limit of a job in seconds; a job that exceeds it is stopped and counts as
    failed. Not with --workers 0. Default: no limit.
    """
    megabytes: Annotated[float, at_least(1, "MB")] | None = None
    """Memory limit of a job in MB, likewise. Not with --scheduler. Default: no limit.
    """


@dataclass(frozen=True, kw_only=True)
class StudyOptions(JobOptions):
    """Run a study: a TOML file that defines the attack and its parameter sweep.

    plan: list the jobs and the estimated time. run: run the jobs that are not finished,
    and write result.json, rows.csv.xz and table.md into --out; failed jobs are tried
    again. status: print the progress. clean: delete only this study's jobs from the
    store.

    The shipped studies are in scenes/studies. Finished jobs are kept in --store, which
    several studies may share: a job is run once, and an interrupted study resumes where
    it stopped.
    """

    action: Positional[Literal["plan", "run", "status", "clean"]]
    """What to do."""
    study: Positional[Path]
    """TOML file of the study."""
    out: OutFolder | None = None
    """Folder for the result. Default: out/studies/NAME."""
    parts: tuple[str, ...] = ()
    """Names of cases to run. Default: all."""

    def folder(self, study: Study) -> Path:
        """Folder for the result of a study."""
        return self.out or Path("out/studies") / study.name


def run(options: StudyOptions) -> int | None:
    """Do what is asked for."""
    from attacks.studies.study_file import read_study

    return _ACTIONS[options.action](
        options, read_study(options.study).of(options.parts)
    )


def _work(study: Study) -> Work[Any]:
    from attacks.studies.running import work_of

    limit_threads(1)
    return work_of(study)


def _plan(options: StudyOptions, study: Study) -> None:
    from mi_splat.ledger import Store
    from mi_splat.ledger.states import note_keys

    entries = show_forecast(options, _work(study))
    keys = [entry.key for entry in entries if entry.key]
    note_keys(Store(options.store), study.name, keys)


def show_forecast(options: StudyOptions, work: Work[Any]) -> list[Entry]:
    """Show what is left to do of a study, and how long it takes; the jobs."""
    from attacks.report.section import duration
    from mi_splat.ledger import Store
    from mi_splat.ledger.states import forecast, status

    study = work.study
    store = Store(options.store)
    entries = status(store, work.jobs())
    done = sum(entry.state == "done" for entry in entries)
    seconds, unknown = forecast(store, entries)
    document = {
        "study": study.name,
        "jobs": len(entries),
        "done": done,
        "seconds": round(seconds, 1),
    }
    lines = [study.question or study.name, f"{len(entries)} jobs, {done} of them done."]
    if work.searches:
        lines.append(
            f"Of {len(work.searches)} searches some of the jobs: which ones, their"
            " results say."
        )
    if seconds:
        workers = max(1, chosen_workers(options.workers))
        on = "" if workers < 2 else f", on {workers} workers"
        lines.append(f"About {duration(seconds / workers)} by what was measured{on}.")
    if unknown:
        lines.append(
            f"{unknown} jobs are of kinds that were never done here, so how long they"
            " take is not known."
        )
    document |= {"not_measured": unknown, "searches": len(work.searches)}
    show_result(document, *lines, as_json=options.json)
    return entries


def _run(options: StudyOptions, study: Study) -> int:
    from attacks.cli.summary import show_summary
    from attacks.studies.running import TABLE

    done = run_work(options, _work(study))
    if options.json:
        show_json(
            {
                "jobs": done.jobs,
                "failed": done.failed,
                "files": [str(path) for path in done.files],
            }
        )
    elif done.files and study.kind == "compare":
        show((options.folder(study) / TABLE).read_text())
    elif done.files:
        show_summary(options.folder(study), as_json=False)
    if done.failed:
        return 1
    return 0


def run_work(
    options: StudyOptions,
    work: Work[Any],
    *,
    begin: Callable[[], object] = lambda: None,
) -> Run:
    """Do the jobs of a study, write the result, and say which have failed; `begin`
    comes first.
    """
    from attacks.studies.running import STUDY_FILE
    from mi_splat.io.folders import check_unlocked

    out = options.folder(work.study)
    check_unlocked(out)
    done = run_in(out, STUDY_FILE, work, options, begin=begin)
    if done.failed and not options.json:
        warn(
            f"{len(done.failed)} jobs have failed; mend the cause, then give the same"
            " command again"
        )
    return done


def run_in(
    out: Path,
    record: str,
    work: Work[Any],
    options: JobOptions,
    *,
    begin: Callable[[], object] = lambda: None,
) -> Run:
    """Do jobs, also those that have failed earlier, and write their result into a
    folder known by its record.
    """
    from attacks.studies.running import run_with
    from mi_splat.io.folders import check_own_folder, own_folder

    check_own_folder(out, record)
    total = None if work.searches else work.size
    with own_folder(out, record), progress("preparing", total=total) as advance:
        begin()
        done = run_with(engine_of(options, follow(advance)), work, out=out)
    for label, text in done.failed.items() if not options.json else ():
        warn(f"{label}: {_last_line(text)}")
    return done


def _last_line(text: str) -> str:
    return text.strip().splitlines()[-1]


def engine_of(options: JobOptions, on_event: Callable[[Event], None]) -> Engine:
    """What runs the jobs of a command."""
    from mi_splat.ledger.engines import engine_for
    from mi_splat.process_group import Limits

    for name in ("workers", "megabytes") if options.scheduler else ():
        value = getattr(options, name)
        if value is not None:
            do = "leave it out: the command that starts the workers decides that"
            raise UsageError.of(f"--{name}", "none with --scheduler", value, do)
    return engine_for(
        options.store,
        workers=chosen_workers(options.workers),
        scheduler=options.scheduler or "",
        limits=Limits(seconds=options.seconds, megabytes=options.megabytes),
        on_event=on_event,
    )


def follow(advance: Advance) -> Callable[[Event], None]:
    """What shows the events of jobs."""

    def told(event: Event) -> None:
        if event.state in ("done", "kept"):
            advance(units=1)
        elif event.state == "failed":
            warn(event.text)
        elif event.text:
            advance(
                (
                    f"{event.text}, {event.done} of {event.total}"
                    if event.total
                    else event.text
                ),
                units=0,
            )

    return told


def _status(options: StudyOptions, study: Study) -> None:
    from mi_splat.ledger import Store
    from mi_splat.ledger.states import STATES, status

    store = Store(options.store)
    entries = status(store, _work(study).jobs())
    counts = Counter(entry.state for entry in entries)
    failed = {
        _title(entry): store.failures(entry.key)[-1]["error"]
        for entry in entries
        if entry.state == "failed"
    }
    document = {**{state: counts[state] for state in STATES}, "failures": failed}
    lines = [f"{label}: {_last_line(text)}" for label, text in failed.items()]
    show_result(
        document,
        ", ".join(f"{counts[state]} {state}" for state in STATES),
        *lines,
        as_json=options.json,
    )


def _title(entry: Entry) -> str:
    if entry.labels:
        return entry.labels[0]
    return f"{entry.kind} {entry.key}"


def _clean(options: StudyOptions, study: Study) -> None:
    """Delete the results that no other study of the store uses."""
    from mi_splat.ledger import Store
    from mi_splat.ledger.states import planned

    store = Store(options.store)
    others = [
        path.stem
        for path in (options.store / "plans").glob("*.json")
        if path.stem != study.name
    ]
    keys = sorted(
        planned(store, study.name).difference(
            *(planned(store, name) for name in others)
        )
    )
    for key in keys:
        store.remove(key)
    store.sweep()
    line = (
        f"{len(keys)} jobs deleted from {options.store}; the result folder of the study"
        " stays as it is."
    )
    show_result({"deleted": len(keys)}, line, as_json=options.json)


_ACTIONS: Mapping[str, Callable[[StudyOptions, Study], int | None]] = {
    "plan": _plan,
    "run": _run,
    "status": _status,
    "clean": _clean,
}
