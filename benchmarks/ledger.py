"""What does the ledger cost?

For one job, for a plan of 10,000, and for the status and the rows of 100,000.

    python benchmarks/ledger.py [--folder out/ledger] [--jobs 100000] [--json]

The jobs add two numbers, so that all is overhead: what a job costs in one process with
every byte brought to the disk, what it costs in two child processes, a plan in which
nothing is done, and the status and the rows of a store in which all is done. (The
folders of the large store are written without the ledger, as fast as the disk takes
them.)
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from mi_splat.ledger import Job, Store
from mi_splat.ledger.engines import Cluster
from mi_splat.ledger.plans import Driver, grid, plan, status
from mi_splat.ledger.running import task_for
from mi_splat.ledger.store import record_text
from tests.ledger.drive import Ledger
from tests.ledger.kinds.configs import NumbersConfig

NUMBERS = "tests.ledger.kinds.numbers"
FEW = 200
MANY = 10_000


def numbers(count: int) -> dict[str, Job]:
    """Jobs that add two numbers."""
    return {
        f"sum-{number}": Job(
            kind=NUMBERS, config=NumbersConfig(values=(1.0, float(number)))
        )
        for number in range(count)
    }


def timed(what: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    begun = time.perf_counter()
    what()
    return time.perf_counter() - begun


def fill(store: Store, jobs: dict[str, Job]) -> None:
    """Write the store as if all jobs had been done."""
    for label, job in jobs.items():
        task = task_for(job, store, {})
        folder = store.folder_of(task.key)
        folder.mkdir(parents=True)
        rows = [
            {
                "sum": sum(job.config.values),
                "first": job.config.values[0],
                "name": label,
            }
        ]
        record = {
            "kind": task.kind,
            "config": task.config,
            "inputs": {},
            "code": task.code,
            "seconds": 0.0,
        }
        (folder / "job.json").write_text(
            record_text({**record, "varies": [], "rows": rows}, {})
        )


def table(store: Store, jobs: dict[str, Job]) -> polars.DataFrame:
    """The rows of a plan with their labels."""
    labels = {entry.key: entry.labels[0] for entry in status(store, jobs)}
    return polars.DataFrame(
        [
            {"label": labels[key], **row}
            for key in labels
            for row in store.record(key)["rows"]
        ]
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("out/ledger"))
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    shutil.rmtree(options.folder, ignore_errors=True)
    results: dict[str, float] = {}
    ledger = Ledger(options.folder / "one")
    few = list(numbers(2 * FEW).values())
    timed(lambda: [ledger.do(job) for job in few[:10]])
    results["ms a job in one process"] = (
        timed(lambda: [ledger.do(job) for job in few[10 : 10 + FEW]]) / FEW * 1e3
    )
    engine = Cluster(options.folder / "two", workers=2)
    driver = Driver(engine)
    results["ms a job in two child processes, their start with it"] = (
        timed(lambda: driver.run([grid(numbers(FEW))])) / FEW * 1e3
    )
    store = Store(options.folder / "many")
    results[f"s to plan {MANY:,}"] = timed(lambda: plan(store, "few", numbers(MANY)))
    many = numbers(options.jobs)
    fill(store, many)
    results[f"s for the status of {options.jobs:,}"] = timed(
        lambda: status(store, many)
    )
    results[f"s for the rows of {options.jobs:,}"] = timed(lambda: table(store, many))
    shutil.rmtree(options.folder)
    if options.json:
        sys.stdout.write(json.dumps(results, indent=2) + "\n")
    else:
        for name, value in results.items():
            sys.stdout.write(f"{value:8.2f}  {name}\n")


if __name__ == "__main__":
    main()
