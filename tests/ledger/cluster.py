"""A Dask cluster as others start it: each process in a folder of its own."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import Popen

from distributed import Client

from mi_splat.io.parsing import read_json
from tests.project.layers import ROOT


def until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, Popen[bytes]]]:
    """A scheduler, and workers each with a working directory of its own: the address
    and the process of the scheduler.
    """
    file = folder / "scheduler.json"
    variables = {**os.environ, "PYTHONPATH": str(ROOT)}
    found = ["--scheduler-file", str(file), "--no-dashboard"]
    module = "distributed.cli.dask"

    def started(name: str, *words: str) -> Popen[bytes]:
        place = folder / name
        place.mkdir()
        command = [sys.executable, "-m", f"{module}_{words[0]}", *words[1:], *found]
        return Popen(command, cwd=place, env=variables, stderr=subprocess.DEVNULL)

    here = ["--host", "127.0.0.1"]
    scheduler = started("scheduler", "scheduler", *here, "--port", "0")
    processes = [scheduler]
    try:
        until(file.is_file)
        for number in range(workers):
            worker = started(f"worker-{number}", "worker", "--nthreads", "1", *here)
            processes.append(worker)
        address = read_json(file)["address"]
        with Client(address, set_as_default=False) as client:
            if workers:
                client.wait_for_workers(workers, timeout=60)
        yield address, scheduler
    finally:
        for process in reversed(processes):
            process.kill()  # its children end with it
        for process in processes:
            process.wait(30)
