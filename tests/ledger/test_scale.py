"""Many jobs: a plan, the status and the rows of a store grow no faster than the number of jobs."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mi_splat.ledger import Job, Ledger
from mi_splat.ledger.index import plan, status
from tests.ledger.kinds.configs import NumbersConfig
from tests.project.layers import ROOT

NUMBERS = "tests.ledger.kinds.numbers"


def test_a_thousand_jobs_are_planned_looked_at_and_read_at_once(tmp_path: Path) -> None:
    ledger, first = Ledger(tmp_path), Job(kind=NUMBERS, config=NumbersConfig())
    jobs = {
        str(number): Job(kind=NUMBERS, config=NumbersConfig(values=(float(number),)), inputs={"first": first})
        for number in range(1000)
    }
    for job in list(jobs.values())[:100]:
        ledger.do(job)
    begun = time.process_time()
    entries = plan(ledger.store, "many", jobs)
    assert [entry.state for entry in entries] == ["done"] * 101 + ["ready"] * 900
    assert status(ledger.store, "many") == entries
    rows = dict(ledger.store.rows([entry.key for entry in entries if entry.state == "done"]))
    assert [rows[entry.key] for entry in entries[1:101]] == [[{"sum": 1.0 + number}] for number in range(100)]
    assert time.process_time() - begun < 3.0


@pytest.mark.nightly
def test_the_ledger_costs_as_little_as_it_should(tmp_path: Path) -> None:
    command = [sys.executable, "benchmarks/ledger.py", "--folder", str(tmp_path / "ledger"), "--json"]
    costs = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)
    most = {
        "ms a job in one process": 8.0,
        "ms a job in two child processes, their start with it": 8.0,
        "s to plan 10,000": 5.0,
        "s for the status of 100,000": 2.0,
        "s for the rows of 100,000": 5.0,
    }
    assert costs.keys() == most.keys()
    assert {name: cost for name, cost in costs.items() if cost > most[name]} == {}
