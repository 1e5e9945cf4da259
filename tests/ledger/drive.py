"""A driver as a process of its own:
`python -m tests.ledger.drive STORE JOBS WORKERS SECONDS` does a plan of walks.
"""

import sys
from pathlib import Path

from mi_splat.ledger.engines import Cluster, InProcess
from mi_splat.ledger.job import Done, Job, OnEvent, nobody
from mi_splat.ledger.plans import Driver, Plan, grid
from mi_splat.ledger.store import Store
from tests.ledger.kinds.configs import WalkConfig

WALK = "tests.ledger.kinds.walk"


class Ledger:
    """Does single jobs, and those before them, in this process."""

    def __init__(self, folder: Path, *, on_event: OnEvent = nobody) -> None:
        self.store = Store(folder)
        self._on_event = on_event

    def do(self, job: Job) -> Done:
        engine = InProcess(self.store.folder, on_event=self._on_event)
        done = Driver(engine).run([grid({"job": job})])["job"]
        assert isinstance(done, Done), done
        return done


def walk(
    start: int,
    *,
    steps: int = 3,
    seconds: float = 0.0,
    trouble: str = "",
    **inputs: Job,
) -> Job:
    return Job(
        kind=WALK,
        config=WalkConfig(start=start, steps=steps, seconds=seconds, trouble=trouble),
        inputs=inputs,
    )


def two_levels(count: int, *, steps: int = 4, seconds: float = 0.02) -> Plan:
    """Walks, then walks that read two of them, and then one whose start is what another
    has found.
    """
    first = [walk(number, steps=steps, seconds=seconds) for number in range(count)]
    second = {
        f"second-{n}": walk(
            n, steps=steps, seconds=seconds, one=first[n], other=first[n - 1]
        )
        for n in range(count // 2)
    }
    results = yield second | {
        f"first-{number}": job for number, job in enumerate(first)
    }
    ends = [
        result.rows[0]["end"]
        for result in (results or {}).values()
        if isinstance(result, Done)
    ]
    yield {"last": walk(sum(ends), steps=steps)}


def main(store: Path, count: int, workers: int, seconds: float) -> int:
    results = Driver(Cluster(store, workers=workers), name="walks").run(
        [two_levels(count, seconds=seconds)]
    )
    return sum(isinstance(result, str) for result in results.values())


if __name__ == "__main__":
    sys.exit(
        min(
            100,
            main(
                Path(sys.argv[1]),
                int(sys.argv[2]),
                int(sys.argv[3]),
                float(sys.argv[4]),
            ),
        )
    )
