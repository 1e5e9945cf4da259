"""Plans and what runs them: order, failures, limits, two drivers, plans that go on with
results.
"""

import contextlib
import errno
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import drjit as dr
import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import SplatFileError
from mi_splat.ledger import Done, Event, Job, Store
from mi_splat.ledger.engines import Child, InProcess, Processes, free_cache, keep_to
from mi_splat.ledger.job import EngineError, OnEvent, Outcome, Task
from mi_splat.ledger.plans import (
    Driver,
    Entry,
    Plan,
    Result,
    forecast,
    grid,
    plan,
    planned,
    status,
)
from mi_splat.ledger.running import task_for
from mi_splat.process_group import Limits
from tests.ledger.drive import Ledger, two_levels, walk
from tests.project.layers import ROOT


def run(
    folder: Path,
    jobs: dict[str, Job],
    limits: Limits | None = None,
    *,
    events: list[Event] | None = None,
) -> dict[str, Result]:
    told = [] if events is None else events
    engine = Processes(folder, workers=2, limits=limits, on_event=told.append)
    return Driver(folder, engine, name="plan", on_event=told.append).run([grid(jobs)])


def states(folder: Path, jobs: dict[str, Job]) -> Counter[str]:
    return Counter(entry.state for entry in status(Store(folder), jobs))


def test_one_poisoned_of_20_fails_alone_after_three_tries_with_its_signal_named(
    tmp_path: Path,
) -> None:
    jobs = {str(number): walk(number, steps=1) for number in range(19)}
    jobs["poisoned"] = walk(0, trouble="kill")
    jobs["after"] = walk(1, before=jobs["poisoned"])
    events: list[Event] = []
    results = run(tmp_path, jobs, events=events)
    assert results.pop("poisoned") == "ended by SIGSEGV"
    assert "has failed" in str(results.pop("after"))
    assert all(isinstance(result, Done) for result in results.values())
    assert [event.text for event in events if event.state == "failed"] == [
        f"try {number}: ended by SIGSEGV" for number in (1, 2, 3)
    ]
    assert states(tmp_path, jobs) == {"done": 19, "failed": 1, "waiting": 1}
    (key,) = (
        entry.key for entry in status(Store(tmp_path), jobs) if entry.state == "failed"
    )
    events.clear()
    assert run(tmp_path, {"poisoned": jobs["poisoned"]}, events=events) == {
        "poisoned": "ended by SIGSEGV"
    }
    assert events == []  # it is not tried again until somebody says so
    assert Store(tmp_path).forgive(key)
    run(tmp_path, {"poisoned": jobs["poisoned"]}, events=events)
    assert [event.state for event in events] == ["running", "failed"] * 3


@pytest.mark.parametrize(
    ("trouble", "limits", "why"),
    [
        ("raise", Limits(), "ValueError: no way"),
        ("eat", Limits(megabytes=200.0), "MB of memory, more than 200"),
        ("", Limits(seconds=0.3), r"ran longer than 0.3 s"),
    ],
)
def test_a_failure_says_why(
    trouble: str, limits: Limits, why: str, tmp_path: Path
) -> None:
    slow = walk(0, steps=1, seconds=2.0, trouble=trouble)
    Store(tmp_path).folder.mkdir(exist_ok=True)
    for _ in range(2):  # two tries of the three were made before
        Store(tmp_path).note_failure(_task(tmp_path, slow), "earlier", 0.0)
    results = run(tmp_path, {"slow": slow}, limits)
    assert why in str(results["slow"])


def _task(folder: Path, job: Job) -> Task:
    return task_for(job, Store(folder), {})


def test_a_plan_goes_on_with_results(tmp_path: Path) -> None:
    asked: list[int] = []

    def halved() -> Plan:
        low = 0
        high = 16
        while high - low > 1:
            middle = (low + high) // 2
            asked.append(middle)
            results = yield {f"at {middle}": walk(middle, steps=1)}
            result = (results or {})[f"at {middle}"]
            assert isinstance(result, Done)
            low, high = (low, middle) if middle >= 11 else (middle, high)

    results = Driver(tmp_path, InProcess(tmp_path), name="plan").run(
        [halved(), grid({}), grid({"one": walk(99)})]
    )
    assert asked == [8, 12, 10, 11]
    assert set(results) == {"one", "at 8", "at 12", "at 10", "at 11"}
    assert planned(Store(tmp_path), "plan") == Store(tmp_path).keys()
    assert len(Store(tmp_path).keys()) == 5


def test_what_a_job_raises_in_this_process_ends_the_plan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no way"):
        Driver(tmp_path, InProcess(tmp_path)).run(
            [grid({"bad": walk(0, trouble="raise")})]
        )


def test_an_interrupt_in_this_process_ends_the_plan_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events: list[str] = []

    def tell(event: Event) -> None:
        events.append(event.state)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Driver(tmp_path, InProcess(tmp_path, on_event=tell)).run(
            [grid({str(n): walk(n) for n in range(3)})]
        )
    assert events == ["running"]
    assert capsys.readouterr().err == ""


def test_a_child_that_is_stopped_keeps_what_it_has_and_counts_no_try(
    tmp_path: Path,
) -> None:
    task = _task(tmp_path, walk(0, steps=9, seconds=0.4))
    child = Child(tmp_path)
    events = list[Event]()

    def stop(event: Event) -> None:
        events.append(event)
        if event.state == "progress":
            child.stop()

    assert child.run(task, stop).state == "stopped"
    child.close()
    assert sorted(
        path.name for path in (tmp_path / "partial" / task.key).iterdir()
    ) == ["interrupted", "kept"]
    assert not Store(tmp_path).failures(task.key)
    assert not Store(tmp_path).is_held(task.key)


def test_a_plan_is_looked_at_before_it_is_run(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = walk(1)
    jobs = {"second": walk(2, one=first), "third": walk(3)}
    assert states(tmp_path, jobs) == {"ready": 2, "waiting": 1}
    assert forecast(store, status(store, jobs)) == (0.0, 3)
    Ledger(tmp_path).do(first)
    assert states(tmp_path, jobs) == {"ready": 2, "done": 1}
    seconds = store.record(next(iter(store.keys())))["seconds"]
    assert forecast(store, status(store, jobs)) == (2 * seconds, 0)
    (entry,) = (entry for entry in status(store, jobs) if entry.labels == ("second",))
    with store.held(entry.key):
        assert states(tmp_path, jobs) == {"ready": 1, "done": 1, "running": 1}


def test_two_drivers_run_no_job_twice(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "tests.ledger.drive",
        str(tmp_path),
        "12",
        "1",
        "0.01",
    ]
    drivers = [subprocess.Popen(command, cwd=ROOT) for _ in range(2)]
    assert [driver.wait(300) for driver in drivers] == [0, 0]
    assert len(Store(tmp_path).keys()) == 12 + 6 + 1
    runs = Counter((tmp_path / "runs").read_text().split())
    assert set(runs.values()) == {1}, "a job was run twice"
    assert len(runs) == 19


def test_a_child_ends_with_its_driver(tmp_path: Path) -> None:
    driver = subprocess.Popen(
        [sys.executable, "-m", "tests.ledger.drive", str(tmp_path), "2", "2", "60"],
        cwd=ROOT,
    )
    try:
        until(lambda: len(list((tmp_path / "locks").glob("?" * 32))) == 2)
    finally:
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    until(lambda: not any(map(Store(tmp_path).is_held, os.listdir(tmp_path / "locks"))))


def until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_driver_waits_for_a_job_that_another_process_does(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job = walk(1)
    events = list[Event]()
    key = task_for(job, store, {}).key
    with ThreadPoolExecutor() as pool:
        with store.held(key):
            result = pool.submit(
                run, tmp_path, {"held": job, "other": walk(2)}, events=events
            )
            until(lambda: "done" in [event.state for event in events])
            time.sleep(0.7)
            assert not store.has(key)
        assert isinstance(result.result()["held"], Done)


def test_an_engine_that_is_closed_blames_no_job(tmp_path: Path) -> None:
    engine = Processes(tmp_path, workers=1)
    outcome = engine.submit(_task(tmp_path, walk(0, steps=1, seconds=60.0)))
    until(
        lambda: (tmp_path / "locks").is_dir() and bool(os.listdir(tmp_path / "locks"))
    )
    engine.close()
    assert outcome.result().state == "stopped"
    assert not (tmp_path / "failed").exists()


def test_a_child_that_cannot_start_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(
        EngineError, match="expected one that starts, got ended with status 1"
    ):
        run(tmp_path, {"any": walk(0)})
    assert not (tmp_path / "failed").exists()


def test_a_full_disk_has_no_free_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with contextlib.ExitStack() as held:
        assert free_cache(tmp_path, itertools.count(3), held).name.endswith("-3")
        monkeypatch.setattr(os, "pwrite", is_full)
        with pytest.raises(SplatFileError, match="No space left on device"):
            free_cache(tmp_path, itertools.count(5), held)


def test_a_task_that_is_alone_has_all_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = list[Sequence[int]]()
    ended = threading.Event()

    def run_on(
        child: Child, task: Task, tell: OnEvent, *, cores: Sequence[int]
    ) -> Outcome:
        given.append(cores)
        assert ended.wait(60)
        return Outcome(state="done")

    monkeypatch.setattr(
        os, "sched_getaffinity", lambda process: {1, 2, 3, 5}, raising=False
    )
    monkeypatch.setattr(Child, "run", run_on)
    engine = Processes(tmp_path, workers=2)
    tasks = [_task(tmp_path, walk(number)) for number in range(3)]
    alone = engine.submit(tasks[0])
    until(lambda: len(given) == 1)
    second = engine.submit(tasks[1])
    until(lambda: len(given) == 2)
    ended.set()
    assert [
        alone.result().state,
        second.result().state,
        engine.submit(tasks[2]).result().state,
    ] == ["done"] * 3
    engine.close()
    assert given == [[1, 2, 3, 5], [2, 5], [1, 2, 3, 5]]


@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"),
    reason="the system keeps no process to some cores",
)
def test_threads_are_as_many_as_cores() -> None:
    cores = os.sched_getaffinity(0)
    threads = dr.thread_count()
    end = threading.Event()
    second = threading.Thread(target=end.wait)
    second.start()
    try:
        keep_to(sorted(cores)[:1])
        assert [
            os.sched_getaffinity(thread) for thread in (0, second.native_id or 0)
        ] == [{min(cores)}] * 2
        assert dr.thread_count() == 1
    finally:
        keep_to(sorted(cores))
        dr.set_thread_count(threads)
        end.set()


def test_the_plan_of_the_tests_is_the_same_in_one_process_and_in_two(
    tmp_path: Path,
) -> None:
    one = tmp_path / "one"
    two = tmp_path / "two"
    Driver(one, InProcess(one)).run([two_levels(6, seconds=0.0)])
    Driver(two, Processes(two, workers=2)).run([two_levels(6, seconds=0.0)])
    assert bytes_of(one) == bytes_of(two)


def bytes_of(folder: Path) -> dict[str, object]:
    """Files and rows of every job by its key."""
    store = Store(folder)
    done = map(store.existing, store.keys())
    return {job.key: (job.record["files"], job.rows) for job in done}


def test_a_plan_knows_the_keys_that_it_has_used(tmp_path: Path) -> None:
    store = Store(tmp_path)
    jobs = {"second": walk(2, one=walk(1))}
    with pytest.raises(InvalidValueError, match="expected a plan, got none"):
        planned(store, "plan")
    assert len(planned_after(plan(store, "plan", jobs), store)) == 1
    run(tmp_path, jobs)
    assert planned(store, "plan") == store.keys()
    (tmp_path / "plans" / "plan.json").write_text("[[]]")
    with pytest.raises(InvalidValueError, match="expected a list of keys"):
        planned(store, "plan")
    assert len(planned_after(plan(store, "plan", jobs), store)) == 2


def planned_after(entries: list[Entry], store: Store) -> set[str]:
    assert planned(store, "plan") == {entry.key for entry in entries if entry.key}
    return planned(store, "plan")
