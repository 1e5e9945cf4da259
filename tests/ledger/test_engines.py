"""Plans and what runs them: order, failures, limits, two drivers, plans that go on with
results.
"""

import asyncio
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
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from subprocess import Popen

import drjit as dr
import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import SplatFileError
from mi_splat.ledger import Done, Event, Job, Store, engines, workers
from mi_splat.ledger.engines import Cluster, InProcess
from mi_splat.ledger.job import EngineError, EngineWarning, Row, Task
from mi_splat.ledger.plans import Driver, Plan, Result, grid
from mi_splat.ledger.running import task_for
from mi_splat.ledger.states import forecast, note_keys, planned, status
from mi_splat.process_group import Limits
from mi_splat.processes import keep_to, own_cores
from tests.ledger.cluster import cluster, until
from tests.ledger.drive import Ledger, two_levels, walk
from tests.ledger.kinds.configs import NumbersConfig, WalkConfig
from tests.project.layers import ROOT

NUMBERS = "tests.ledger.kinds.numbers"


def run(
    folder: Path,
    jobs: dict[str, Job],
    limits: Limits | None = None,
    *,
    scheduler: str = "",
    events: list[Event] | None = None,
) -> dict[str, Result]:
    heard = [] if events is None else events
    engine = Cluster(
        folder, workers=2, scheduler=scheduler, limits=limits, on_event=heard.append
    )
    driver = Driver(engine, name="plan")
    return driver.run([grid(jobs)])


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
        f"try {number} of 3: ended by SIGSEGV" for number in (1, 2, 3)
    ]
    assert states(tmp_path, jobs) == {"done": 19, "failed": 1, "waiting": 1}
    events.clear()
    # The next run tries it again.
    run(tmp_path, {"poisoned": jobs["poisoned"]}, events=events)
    assert [event.state for event in events].count("failed") == 3


@pytest.mark.parametrize(
    ("trouble", "limits", "why"),
    [
        ("raise", Limits(), "ValueError: no way"),
        ("eat", Limits(megabytes=400.0), "used more memory than it may"),
        ("", Limits(seconds=0.3), r"ran longer than 0.3 s"),
    ],
)
def test_a_failure_says_why(
    trouble: str, limits: Limits, why: str, tmp_path: Path
) -> None:
    slow = walk(0, steps=1, seconds=2.0, trouble=trouble)
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

    results = Driver(InProcess(tmp_path), name="plan").run(
        [halved(), grid({}), grid({"one": walk(99)})]
    )
    assert asked == [8, 12, 10, 11]
    assert set(results) == {"one", "at 8", "at 12", "at 10", "at 11"}
    assert planned(Store(tmp_path), "plan") == Store(tmp_path).keys()
    assert len(Store(tmp_path).keys()) == 5


def test_what_a_job_raises_in_this_process_ends_the_plan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no way"):
        Driver(InProcess(tmp_path)).run([grid({"bad": walk(0, trouble="raise")})])


def test_an_interrupt_in_this_process_ends_the_plan_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events: list[str] = []

    def tell(event: Event) -> None:
        events.append(event.state)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Driver(InProcess(tmp_path, on_event=tell)).run(
            [grid({str(n): walk(n) for n in range(3)})]
        )
    assert events == ["running"]
    assert capsys.readouterr().err == ""


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
    driver = drive(tmp_path, "2", "2", "60")
    try:
        until(lambda: len(list((tmp_path / "locks").glob("?" * 32))) == 2)
    finally:
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    until(lambda: not any(map(Store(tmp_path).is_held, os.listdir(tmp_path / "locks"))))


def drive(folder: Path, *words: str) -> Popen[bytes]:
    """A driver as a process of its own."""
    command = [sys.executable, "-m", "tests.ledger.drive", str(folder), *words]
    return Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)


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


def test_an_interrupted_run_keeps_what_it_has_and_counts_no_try(
    tmp_path: Path,
) -> None:
    driver = drive(tmp_path, "1", "1", "0.3")
    until(lambda: bool(list(tmp_path.glob("partial/*/kept"))))
    driver.send_signal(signal.SIGINT)
    assert driver.wait(60) not in (0, -signal.SIGKILL)
    (partial,) = (tmp_path / "partial").iterdir()
    left = sorted(path.name for path in partial.iterdir())
    assert left == ["interrupted", "kept"]
    assert not (tmp_path / "failed").exists()
    assert not Store(tmp_path).is_held(partial.name)


def test_a_job_that_does_not_listen_is_ended_and_not_blamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "_GRACE", 0.2)
    engine = Cluster(tmp_path, workers=1)
    task = _task(tmp_path, walk(0, steps=1, seconds=60.0))

    async def closed() -> None:
        attempt = asyncio.create_task(engine.attempt(task))
        while not (tmp_path / "runs").is_file():
            await asyncio.sleep(0.02)
        engine.close()
        with contextlib.suppress(asyncio.CancelledError, EngineError):
            await attempt

    asyncio.run(closed())
    until(lambda: not Store(tmp_path).is_held(task.key))
    assert not (tmp_path / "failed").exists()


def test_a_cluster_that_cannot_start_says_why(
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
        assert (
            Store(tmp_path).free_kernels(itertools.count(3), held).name.endswith("-3")
        )
        monkeypatch.setattr(os, "pwrite", is_full)
        with pytest.raises(SplatFileError, match="No space left on device"):
            Store(tmp_path).free_kernels(itertools.count(5), held)


WHEREABOUTS = "tests.ledger.kinds.whereabouts"


def whereabouts(count: int, seconds: float) -> dict[str, Job]:
    """Jobs that say where they run."""
    return {
        str(n): Job(kind=WHEREABOUTS, config=WalkConfig(start=n, seconds=seconds))
        for n in range(count)
    }


def rows_of(results: Mapping[str, Result]) -> list[Row]:
    assert all(isinstance(result, Done) for result in results.values()), results
    return [row for result in results.values() for row in result.rows]  # type: ignore[union-attr]


@pytest.mark.skipif(
    len(own_cores()) < 2, reason="there are no cores to share, or none to be seen"
)
def test_a_job_that_is_alone_has_all_cores(tmp_path: Path) -> None:
    cores = len(own_cores())
    alone = rows_of(run(tmp_path, whereabouts(1, 0.0)))
    assert [row["cores"] for row in alone] == [cores]
    both = rows_of(run(tmp_path, whereabouts(2, 0.4)))
    assert sum(row["cores"] for row in both) == cores


# Any Dask scheduler: its workers are elsewhere, and it may go away


def test_workers_have_working_directories_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("three.txt").write_text("3.0")
    config = NumbersConfig(values=(1.0,))
    reading = Job(kind=NUMBERS, config=config, inputs={"file": Path("three.txt")})
    jobs = {**whereabouts(8, 0.2), "reading": reading}
    with cluster(tmp_path, 2) as (address, _):
        results = run(Path("store"), jobs, scheduler=address)
    (sum_,) = rows_of({"reading": results.pop("reading")})
    assert sum_["sum"] == 4.0
    assert len({row["process"] for row in rows_of(results)}) == 2


def test_a_scheduler_that_is_lost_is_an_error_and_nothing_else(tmp_path: Path) -> None:
    store = tmp_path / "store"
    jobs = {"quick": walk(1, steps=1), "slow": walk(2, steps=9, seconds=0.3)}
    with cluster(tmp_path, 2) as (address, scheduler):

        def lose(event: Event) -> None:
            if event.state == "progress" and event.done == 2:
                scheduler.kill()

        engine = Cluster(store, scheduler=address, on_event=lose)
        with pytest.raises(EngineError, match="expected a scheduler that answers, got"):
            Driver(engine).run([grid(jobs)])
    assert not (store / "failed").exists()
    assert all(isinstance(result, Done) for result in run(store, jobs).values())


def test_a_machine_without_the_store_is_an_error(tmp_path: Path) -> None:
    terms = workers.Terms(
        store=str(tmp_path / "elsewhere"),
        folder=str(tmp_path),
        run="any",
        limits=Limits(),
        variables={},
    )
    with pytest.raises(EngineError, match="put the store on a disk that all machines"):
        workers.attempt(_task(tmp_path, walk(0)), terms)
    assert not (tmp_path / "elsewhere").exists()


def test_a_worker_has_the_variables_of_the_command_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MI_SPLAT_WEIGHTS", "of this run")
    jobs = whereabouts(2, 0.0)
    with cluster(tmp_path, 1) as (address, _):
        first = run(tmp_path, {"0": jobs["0"]}, scheduler=address)
        monkeypatch.delenv("MI_SPLAT_WEIGHTS")
        second = run(tmp_path, {"1": jobs["1"]}, scheduler=address)
    assert rows_of(first)[0]["weights"] == "of this run"
    assert rows_of(second)[0]["weights"] is None


def test_no_scheduler_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = {"any": walk(0)}
    monkeypatch.setattr(engines, "_CONNECTING", 0.5)
    with pytest.raises(EngineError, match="expected the address of a Dask scheduler"):
        run(tmp_path, jobs, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(EngineError, match="expected the address of a Dask scheduler"):
        run(tmp_path, jobs, scheduler="nonsense://")
    with pytest.raises(EngineError, match="got no keys for TLS in the configuration"):
        run(tmp_path, jobs, scheduler="tls://127.0.0.1:1")


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
    Driver(InProcess(one)).run([two_levels(6, seconds=0.0)])
    Driver(Cluster(two, workers=2)).run([two_levels(6, seconds=0.0)])
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
    run(tmp_path, jobs)
    assert len(store.keys()) == 2
    assert planned(store, "plan") == store.keys()
    note_keys(store, "plan", ["0" * 32])
    assert planned(store, "plan") == {*store.keys(), "0" * 32}
    (tmp_path / "plans" / "plan.json").write_text("[[]]")
    with pytest.raises(InvalidValueError, match="expected a list of keys"):
        planned(store, "plan")
    run(tmp_path, jobs)
    assert planned(store, "plan") == store.keys()


def test_a_scheduler_without_workers_is_warned_of(tmp_path: Path) -> None:
    with cluster(tmp_path, 0) as (address, _):
        engine = Cluster(tmp_path / "store", scheduler=address)

        async def connect() -> None:
            engine._connected()

        try:
            with pytest.warns(EngineWarning, match="scheduler with workers, got none"):
                asyncio.run(connect())
        finally:
            engine.close()
