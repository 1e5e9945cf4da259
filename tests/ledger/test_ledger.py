"""Jobs in one process: done once, found again, made anew when anything that counts has
changed, and looked at.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Event, Job, Part, Store
from mi_splat.ledger.engines import Cluster
from mi_splat.ledger.plans import Driver
from tests.ledger.drive import Ledger, two_levels
from tests.ledger.kinds.configs import NumbersConfig, Shift
from tests.ledger.test_engines import bytes_of
from tests.project.layers import ROOT

NUMBERS = "tests.ledger.kinds.numbers"


def numbers(*values: float, **inputs: Job | Part | Path) -> Job:
    return Job(kind=NUMBERS, config=NumbersConfig(values=values), inputs=inputs)


def states(events: list[Event]) -> list[str]:
    return [event.state for event in events]


def test_a_job_is_done_once_and_its_inputs_first(tmp_path: Path) -> None:
    events: list[Event] = []
    first = numbers(1.0, 2.5)
    second = numbers(1.0, first=first)
    done = Ledger(tmp_path, on_event=events.append).do(second)
    assert done.rows == [{"sum": 4.5}]
    assert (done.folder / "sum.txt").read_text() == "4.5"
    assert states(events) == ["running", "progress", "done"] * 2
    events.clear()
    assert Ledger(tmp_path, on_event=events.append).do(second) == done
    assert states(events) == ["kept", "kept"]
    assert not [
        path
        for name in ("tmp", "partial", "locks")
        for path in (tmp_path / name).glob("[!.]*")
    ]


def test_a_job_that_many_read_is_looked_at_once(tmp_path: Path) -> None:
    """Each of them reads what all before it have left."""
    jobs = [numbers(1.0)]
    for number in range(9):
        jobs.append(
            numbers(float(number), **{f"input {n}": job for n, job in enumerate(jobs)})
        )
    Ledger(tmp_path).do(jobs[-1])
    events: list[Event] = []
    Ledger(tmp_path, on_event=events.append).do(jobs[-1])
    assert states(events) == ["kept"] * 10


def test_who_reads_equal_files_is_the_same_job(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    one = numbers(1.0, 2.0)
    other = numbers(3.0)
    assert ledger.do(one).key != ledger.do(other).key
    (tmp_path / "three.txt").write_text("3.0")
    keys = {ledger.do(numbers(first=job.part("sum.txt"))).key for job in (one, other)}
    assert len(keys) == 1
    whole = {
        ledger.do(numbers(first=source)).key for source in (one, tmp_path / "three.txt")
    }
    assert len(whole | keys) == 3


def test_a_changed_output_is_an_error_wherever_it_is_used(tmp_path: Path) -> None:
    first = numbers(1.0)
    done = Ledger(tmp_path).do(first)
    (done.folder / "sum.txt").write_text("2.0")
    for job in (first, numbers(first=first)):
        with pytest.raises(
            InvalidValueError,
            match=r"expected the files that it wrote, got another sum\.txt",
        ):
            Ledger(tmp_path).do(job)


def test_a_configuration_that_can_change_or_has_no_text_is_refused(
    tmp_path: Path,
) -> None:
    with pytest.raises(
        InvalidValueError, match="expected a frozen dataclass, got dict"
    ):
        Job(kind=NUMBERS, config={})
    with pytest.raises(InvalidValueError, match=r"config\.shift\.by: expected numbers"):
        Ledger(tmp_path).do(
            Job(kind=NUMBERS, config=NumbersConfig(shift=Shift(by=tmp_path)))  # type: ignore[arg-type]
        )


# Killed at random: children and drivers. What is left is what an unkilled run leaves


def children_of(process: int) -> list[int]:
    """Numbers of the processes that a process has started, and of those that they
    have.
    """
    shown = subprocess.run(
        ["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True, check=True
    ).stdout
    pairs = [tuple(map(int, line.split())) for line in shown.splitlines()]
    family = [process]
    for number in family:
        family += [child for child, parent in pairs if parent == number]
    return family[1:]


class Killing:
    """Processes that are started again when they are not there, and killed at
    random.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self.kills = dict.fromkeys(("driver", "child"), 0)

    def keep(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        """A process of a name, started if it is not there."""
        process = self._running.get(name)
        if process is None or process.poll() is not None:
            nowhere = subprocess.DEVNULL
            process = subprocess.Popen(
                [sys.executable, *words], cwd=ROOT, stdout=nowhere, stderr=nowhere
            )
            self._running[name] = process
        return process

    def kill(self) -> None:
        """Kill a process that was started here, or one that such a process has
        started.
        """
        targets = []
        for name, process in self._running.items():
            if process.poll() is None:
                targets += [(name, process.pid)]
                targets += [("child", child) for child in children_of(process.pid)] * 2
        if targets:
            name, number = self._random.choice(targets)
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
                self.kills[name] += 1

    def wait(self, seconds: float) -> None:
        """Some time, up to twice as long as is said."""
        time.sleep(self._random.uniform(0, 2 * seconds))

    def close(self) -> None:
        """Kill all, and those that they have started."""
        for process in self._running.values():
            if process.poll() is None:
                left = [*children_of(process.pid), process.pid]
            else:
                left = []
            for number in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            process.wait()


def run_killed(
    folder: Path, count: int, kills: int, *, seed: int, every: float
) -> Killing:
    """Do a plan with a driver that is started again until all is done, and kill
    something every now and then.
    """
    with contextlib.closing(Killing(seed)) as processes:
        while True:
            driver = processes.keep(
                "driver",
                "-m",
                "tests.ledger.drive",
                str(folder),
                str(count),
                "2",
                "0.02",
            )
            processes.wait(every)
            if driver.poll() == 0:
                return processes
            if sum(processes.kills.values()) < kills:
                processes.kill()


def unkilled(folder: Path, count: int) -> dict[str, object]:
    Driver(Cluster(folder, workers=2)).run([two_levels(count)])
    return bytes_of(folder)


def test_a_run_with_kills_leaves_the_bytes_of_one_without(tmp_path: Path) -> None:
    processes = run_killed(tmp_path / "killed", 16, 8, seed=1, every=0.3)
    check(tmp_path, 16, processes, 4)


@pytest.mark.nightly
def test_200_kills(tmp_path: Path) -> None:
    # so many that an idle machine is not through with them before the last kill
    count = 1800
    processes = run_killed(tmp_path / "killed", count, 200, seed=3, every=0.4)
    check(tmp_path, count, processes, 200)


def check(folder: Path, count: int, processes: Killing, least: int) -> None:
    assert sum(processes.kills.values()) >= least, processes.kills
    assert bytes_of(folder / "killed") == unkilled(folder / "whole", count)
    for left in (folder / "killed" / "tmp").iterdir():
        os.utime(left, (time.time() - 90,) * 2)
    Store(folder / "killed").sweep()
    assert not [
        *(folder / "killed" / "tmp").iterdir(),
        *(folder / "killed" / "partial").iterdir(),
    ]
