"""Many jobs: a plan, the status and the rows of a store. What they cost is measured by benchmarks/ledger.py."""

from __future__ import annotations

from pathlib import Path

from mi_splat.ledger import Job, Ledger
from mi_splat.ledger.index import plan, status
from tests.ledger.kinds.configs import NumbersConfig

NUMBERS = "tests.ledger.kinds.numbers"


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
