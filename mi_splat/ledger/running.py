"""The one function that runs a job, which every engine calls."""

import errno
import importlib
import math
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import code_digest
from mi_splat.ledger.job import (
    DiskFullError,
    Done,
    Event,
    HeldError,
    Job,
    OnEvent,
    Out,
    Outcome,
    Part,
    Row,
    Task,
    by_depth,
    nobody,
)
from mi_splat.ledger.store import TRIES, Store, content_of_path, origin
from mi_splat.process_group import ending_of

_FULL = (errno.ENOSPC, errno.EDQUOT)


def run_job(store: Store, task: Task, on_event: OnEvent = nobody) -> Outcome:
    """Do a job whose inputs are done, unless it is done already, another process does
    it, or it has failed too often; raises what the job raises.
    """
    try:
        with store.held(task.key) as left:
            if left is not None:
                how = ending_of(left["process"])
                why = how or f"process {left['process']} on {left['host']} ended"
                on_event(note_failure(store, task, why, 0.0))
                return Outcome(state="again")
            if store.has(task.key):
                on_event(task.event("kept"))
                return Outcome(state="done")
            failures = store.failures(task.key)
            if len(failures) >= TRIES:
                return Outcome(state="failed", text=failures[-1]["error"])
            _make(store, task, on_event)
    except HeldError as error:
        return Outcome(state="held", text=str(error))
    except Exception as error:
        if not is_disk_full(error):
            raise
        do = "free some space; finished jobs are kept, and this one resumes"
        raise DiskFullError.of(
            str(store.folder), "space on the disk", "none", do
        ) from error
    return Outcome(state="done")


def note_failure(
    store: Store, task: Task, error: str, seconds: float, *, shown: str = ""
) -> Event:
    """Write down that a try of a job has failed; the event that says so."""
    tries = store.note_failure(task, error, round(seconds, 3))
    text = f"try {tries} of {TRIES}: {shown or error}"
    return task.event("failed", text=text, seconds=seconds)


def task_for(job: Job, store: Store, finished: Mapping[str, Done]) -> Task:
    """A job as a task."""
    inputs: dict[str, dict[str, str]] = {}
    for name, source in job.sources.items():
        if isinstance(source, Part):
            done = finished[source.job.identity]
            inputs[name] = {
                "content": done.content_of(source.pattern),
                "job": done.key,
                "part": source.pattern,
            }
        else:
            inputs[name] = {
                "content": content_of_path(source),
                "path": str(source.absolute()),
            }
    return Task(
        kind=job.kind, config=job.config, inputs=inputs, code=code_digest(job.kind)
    )


def lookup(
    jobs: Iterable[Job], store: Store
) -> Iterator[tuple[Job, Task | None, Done | None]]:
    """Jobs, after all before them: each with its task if its inputs are done, and with
    its result if it is there.
    """
    finished: dict[str, Done] = {}
    for job in (job for level in by_depth(jobs) for job in level):
        task = done = None
        if all(needed.identity in finished for needed in job.before):
            task = task_for(job, store, finished)
            done = store.recorded(task.key)
            if done is not None:
                finished[job.identity] = done
        yield job, task, done


def input_paths(store: Store, task: Task) -> dict[str, Path]:
    """Where the inputs of a task are, each of which is still what it was."""
    paths = {}
    for name, source in task.inputs.items():
        if "job" in source:
            done = store.done(source["job"])
            content = None if done is None else done.content_of(source["part"])
            if done is None:
                path = store.folder_of(source["job"])
            else:
                path = done.input_path(source["part"])
        else:
            path = Path(source["path"])
            content = content_of_path(path)
        if content != source["content"]:
            do = "plan the job again"
            raise InvalidValueError.of(
                f"input {name} of job {task.key}", "what it was planned with", path, do
            )
        paths[name] = path
    return paths


def _make(store: Store, task: Task, on_event: OnEvent) -> None:
    """Do a job, and write down a failure."""
    started = time.monotonic()
    try:
        _run(store, task, on_event)
    except Exception as error:
        # which is no fault of the job's, and could not hold it
        if not is_disk_full(error):
            seconds = time.monotonic() - started
            text = "".join(traceback.format_exception(error))
            on_event(note_failure(store, task, text, seconds, shown=str(error)))
        raise
    on_event(task.event("done", seconds=time.monotonic() - started))


def _run(store: Store, task: Task, on_event: OnEvent) -> None:
    """Do a job, and put its result into the store."""
    if code_digest(task.kind) != task.code:
        do = "plan the job again, with the same code everywhere"
        raise InvalidValueError.of(
            f"code of {task.kind}", task.code, code_digest(task.kind), do
        )
    inputs = input_paths(store, task)
    kind: Any = importlib.import_module(task.kind)

    def progress(text: str, done: int, total: int) -> None:
        on_event(task.event("progress", text=text, done=done, total=total))

    def note(text: str) -> None:
        on_event(task.event("note", text=text))

    on_event(task.event("running"))
    with store.making(task.key) as (temporary, partial):
        started = time.monotonic()
        cpu = time.process_time()
        out = Out(files=temporary / "files", kept=partial, progress=progress, note=note)
        rows: Sequence[Row] | None = kind.run(task.config, inputs, out)
        record = {
            **task.as_json,
            **origin(),
            "seconds": round(time.monotonic() - started, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
            "varies": list(getattr(kind, "VARIES", ())),
            "rows": _checked(rows or (), task.kind),
        }
        store.publish(temporary, record, task.key)


def _checked(rows: Sequence[Row], kind: str) -> list[dict[str, Any]]:
    """Rows as JSON keeps them."""
    for row in rows:
        for name, value in row.items():
            if not (
                value is None
                or type(value) in (str, int, bool)
                or (type(value) is float and math.isfinite(value))
            ):
                expected = "a finite number of Python, a text, a truth value or None"
                raise InvalidValueError.of(
                    f"rows of {kind}: {name}", expected, repr(value), "convert it"
                )
    return [dict(row) for row in rows]


def is_disk_full(error: BaseException | None) -> bool:
    """Whether an error, or what led to it, is that of a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _FULL:
            return True
        error = error.__cause__ or error.__context__
    return False
