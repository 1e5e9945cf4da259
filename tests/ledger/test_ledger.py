"""Jobs in one process: done once, found again, made anew when anything that counts has changed, and looked at."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Event, Job, Ledger, Part
from mi_splat.ledger.index import plan, status
from tests.ledger.drive import walk
from tests.ledger.kinds.configs import NumbersConfig, Shift

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
    assert not [path for name in ("tmp", "partial", "leases") for path in (tmp_path / name).glob("[!.]*")]


def test_a_job_that_many_read_is_looked_at_once(tmp_path: Path) -> None:
    """As surrogates of CLOAK, each of which reads what all before it have left."""
    jobs = [numbers(1.0)]
    for number in range(9):
        jobs.append(numbers(float(number), **{f"input {n}": job for n, job in enumerate(jobs)}))
    Ledger(tmp_path).do(jobs[-1])
    events: list[Event] = []
    Ledger(tmp_path, on_event=events.append).do(jobs[-1])
    assert states(events) == ["kept"] * 10


def test_who_reads_equal_files_is_the_same_job(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    one, other = numbers(1.0, 2.0), numbers(3.0)
    assert ledger.do(one).key != ledger.do(other).key
    (tmp_path / "three.txt").write_text("3.0")
    keys = {ledger.do(numbers(first=job.part("sum.txt"))).key for job in (one, other)}
    assert len(keys) == 1
    whole = {ledger.do(numbers(first=source)).key for source in (one, tmp_path / "three.txt")}
    assert len(whole | keys) == 3


def test_a_changed_output_is_an_error_wherever_it_is_used(tmp_path: Path) -> None:
    first = numbers(1.0)
    done = Ledger(tmp_path).do(first)
    (done.folder / "sum.txt").write_text("2.0")
    for job in (first, numbers(first=first)):
        with pytest.raises(InvalidValueError, match=r"expected the files that it wrote, got another sum\.txt"):
            Ledger(tmp_path).do(job)


def test_a_configuration_that_can_change_or_has_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="expected a frozen dataclass, got dict"):
        Job(kind=NUMBERS, config={})
    with pytest.raises(InvalidValueError, match=r"config\.shift\.by: expected numbers"):
        Ledger(tmp_path).do(Job(kind=NUMBERS, config=NumbersConfig(shift=Shift(by=tmp_path))))  # type: ignore[arg-type]


def test_who_asks_for_a_job_that_has_failed_tries_it_again(tmp_path: Path) -> None:
    events: list[Event] = []
    for _ in range(4):
        with pytest.raises(ValueError, match="no way"):
            Ledger(tmp_path, on_event=events.append).do(walk(0, trouble="raise"))
    tries = [event.text for event in events if event.state == "failed"]
    assert tries == [f"try {number} of 3: no way" for number in (1, 2, 3, 1)]


def test_a_thousand_jobs_are_planned_looked_at_and_read_at_once(tmp_path: Path) -> None:
    ledger, first = Ledger(tmp_path), Job(kind=NUMBERS, config=NumbersConfig())
    jobs = {
        str(number): Job(kind=NUMBERS, config=NumbersConfig(values=(float(number),)), inputs={"first": first})
        for number in range(1000)
    }
    for job in list(jobs.values())[:100]:
        ledger.do(job)
    entries = plan(ledger.store, "many", jobs)
    assert [entry.state for entry in entries] == ["done"] * 101 + ["ready"] * 900
    assert status(ledger.store, "many") == entries
    rows = dict(ledger.store.rows([entry.key for entry in entries if entry.state == "done"]))
    assert [rows[entry.key] for entry in entries[1:101]] == [[{"sum": 1.0 + number}] for number in range(100)]
