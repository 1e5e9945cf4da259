"""Who does a job: told by the system on the same machine, and elsewhere by signs of life and one's own clock."""

import json
import os
import platform
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from mi_splat.ledger import HeldError
from mi_splat.ledger import leases as module
from mi_splat.ledger.leases import HEARTBEAT, STALE, Leases, boot_id, start_of

KEY = "0" * 32
DAY = 24 * 3600.0


@pytest.fixture
def leases(tmp_path: Path) -> Leases:
    return Leases(folder=tmp_path)


def lease(leases: Leases, **changes: Any) -> Path:
    """A lease that this process did not take."""
    values = {
        "host": platform.node(),
        "boot": boot_id(),
        "process": os.getppid(),
        "start": start_of(os.getppid()),
        "token": "a",
    }
    path = leases.folder / KEY
    path.write_text(json.dumps(values | changes))
    return path


def ended() -> int:
    """Number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_job_is_held_until_the_body_ends(leases: Leases) -> None:
    with leases.held(KEY):
        assert leases.live() == {KEY}
        with pytest.raises(HeldError, match=f"expected one that nobody does, got process {os.getpid()} of"):
            leases.held(KEY).__enter__()
    assert not leases.live()
    assert leases.free(KEY)


def test_on_the_same_machine_the_system_says_who_lives(leases: Leases) -> None:
    lease(leases)
    assert leases.holder(KEY) is not None
    assert not leases.free(KEY)
    for dead in ({"process": ended()}, {"start": "another"}):  # its number may be another process's by now
        lease(leases, **dead)
        with leases.held(KEY):
            pass


def test_one_that_has_ended_and_is_not_waited_for_is_dead(leases: Leases) -> None:
    process = subprocess.Popen([sys.executable, "-c", ""], stdout=subprocess.PIPE)
    start = start_of(process.pid)
    assert process.stdout is not None
    process.stdout.read()
    for _ in range(100):
        if start_of(process.pid) is None:
            break
        time.sleep(0.02)
    lease(leases, process=process.pid, start=start)
    assert leases.holder(KEY) is None
    process.communicate()


@pytest.mark.parametrize("clock", [0.0, DAY, -DAY])
@pytest.mark.parametrize("elsewhere", [{"host": "other"}, {"boot": "other"}, {"host": "other", "process": None}])
def test_elsewhere_it_is_dead_after_two_minutes_without_a_sign(
    clock: float, elsewhere: dict[str, Any], leases: Leases, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("mi_splat.ledger.leases.time.monotonic", lambda: now)
    path = lease(leases, **elsewhere)
    for _ in range(3):  # each sign of life begins the two minutes anew, whatever the other machine's clock says
        os.utime(path, (time.time() + clock + now, time.time() + clock + now))
        assert leases.holder(KEY) is not None
        now += STALE - 1
        assert leases.holder(KEY) is not None
    now += 2
    assert leases.holder(KEY) is None
    assert leases.free(KEY)
    assert not path.exists()


def test_a_broken_lease_is_that_of_another_machine(leases: Leases, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("mi_splat.ledger.leases.time.monotonic", lambda: now)
    (leases.folder / KEY).write_text('{"host": ')
    assert leases.holder(KEY) is not None
    now = STALE
    assert leases.holder(KEY) is None


def test_of_many_that_take_a_dead_ones_job_one_has_it(leases: Leases) -> None:
    for _ in range(20):
        lease(leases, start="another")
        holders, refused = list[int](), threading.Semaphore(0)

        def take(number: int, holders: list[int] = holders, refused: threading.Semaphore = refused) -> None:
            try:
                with Leases(folder=leases.folder).held(KEY):
                    holders.append(number)
                    for _ in range(7):  # all others come while it is held
                        refused.acquire(timeout=60)
            except HeldError:
                refused.release()

        threads = [threading.Thread(target=take, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(holders) == 1
        (leases.folder / KEY).unlink(missing_ok=True)


def test_a_lease_shows_signs_of_life(leases: Leases, monkeypatch: pytest.MonkeyPatch) -> None:
    path = leases.folder / KEY
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 2:
            raise InterruptedError

    with leases.held(KEY):
        os.utime(path, (0, 0))
        monkeypatch.setattr("mi_splat.ledger.leases.time.sleep", wait)
        with pytest.raises(InterruptedError):
            module._beat()
        assert time.time() - path.stat().st_mtime < DAY
    assert waits == [HEARTBEAT] * 2
    assert 3 * HEARTBEAT < STALE
