"""What does the ledger cost?

For one job, for a plan of 10,000, and for the status and the rows of 100,000.

    python benchmarks/ledger.py [--folder out/ledger] [--jobs 100000] [--json]

The jobs add two numbers, so that all is overhead: what a job costs in one process with
every byte brought to the disk, what it costs on a Dask cluster of this machine once
that has started, a plan in which nothing is done, and the status and the rows of a
store in which all is done. (The folders of the large store are written without the
ledger, as fast as the disk takes them.)
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

from mi_splat.ledger import Event, Job, Store
from mi_splat.ledger.engines import Cluster
from mi_splat.ledger.plans import Driver, grid
from mi_splat.ledger.running import task_for
from mi_splat.ledger.states import status
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


def on_cluster(folder: Path, workers: int) -> tuple[float, float]:
    """Seconds until the first job is done, and then for each of the others."""
    ends: list[float] = []

    def note(event: Event) -> None:
        if event.state == "done":
            ends.append(time.perf_counter())

    begun = time.perf_counter()
    engine = Cluster(folder, workers=workers, on_event=note)
    Driver(engine).run([grid(numbers(FEW))])
    return ends[0] - begun, (ends[-1] - ends[0]) / (len(ends) - 1)


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
        record = {**task.as_json, "seconds": 0.0}
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
    plain = timed(lambda: [ledger.do(job) for job in few[10 : 10 + FEW]]) / FEW
    results["ms a job in one process"] = plain * 1e3
    for workers in (1, 2):
        start, each = on_cluster(options.folder / str(workers), workers)
        results[f"s to start a cluster of {workers}"] = start
        results[f"ms a job on a cluster of {workers}"] = each * 1e3
        results[f"times that of one process, on {workers}"] = each / plain
    store = Store(options.folder / "many")
    results[f"s to plan {MANY:,}"] = timed(lambda: status(store, numbers(MANY)))
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
