"""What a method costs: the time of a picture, alone and with its gradient, and the memory that it takes meanwhile."""

import contextlib
import gc
import re
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mi_splat.variant import release_memory

Run = Callable[[], None]
_MIB = 2.0**20
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What one kind of call of one method costs.

    Attributes:
        seconds: Of each round.
        ratio: Median over the rounds of this method's time over that of the first method in the same round.
        memory: MiB that the process grew by at most during a call; None where that is not known.
    """

    seconds: tuple[float, ...]
    ratio: float
    memory: float | None

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        middle = statistics.median(self.seconds)
        return {"seconds": middle, "rounds": list(self.seconds), "ratio": self.ratio, "memory_mib": self.memory}


def seconds_of(run: Run) -> float:
    """Wall time of one call."""
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


def costs_of(runs: Mapping[str, Run], *, rounds: int, on_step: Callable[[str], None]) -> dict[str, Cost]:
    """The cost of each method.

    In each round all take their turn, since a machine that others use changes its speed within minutes.
    """
    memory, seconds = {}, {name: list[float]() for name in runs}
    for name, run in runs.items():
        on_step(f"{name}: memory")
        run()
        memory[name] = peak_memory(run)
    for number in range(1, rounds + 1):
        for name, run in runs.items():
            on_step(f"{name}: time, round {number} of {rounds}")
            seconds[name].append(seconds_of(run))
    first = next(iter(seconds.values()), [])
    return {
        name: Cost(
            seconds=tuple(times),
            ratio=statistics.median(time / base for time, base in zip(times, first, strict=True)),
            memory=memory[name],
        )
        for name, times in seconds.items()
    }


def peak_memory(run: Run) -> float | None:
    """MiB by which a call made the process grow at most; of a GPU's memory, if one was used, what torch took there.

    Linux keeps the most memory that a process ever had, and forgets it when asked. What was in use before the call is
    not counted, so the scene itself is not.
    """
    gc.collect()
    release_memory()
    on_gpu = torch.cuda.is_available()
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    before = _resident_after_reset()
    gpu_before = torch.cuda.memory_allocated() if on_gpu else 0
    run()
    gpu = (torch.cuda.max_memory_allocated() - gpu_before) / _MIB if on_gpu else 0.0
    if gpu > 0:
        return gpu
    after = _status("VmHWM")
    return None if before is None or after is None else max(0.0, (after - before) / _MIB)


def _resident_after_reset() -> float | None:
    """Bytes that the process has now, from where its peak counts again; None where that cannot be had."""
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")
        return _status("VmRSS")
    return None


def _status(key: str) -> float | None:
    """A figure of this process in bytes."""
    with contextlib.suppress(OSError):
        match = re.search(rf"^{key}:\s*(\d+) kB", _STATUS.read_text(), flags=re.MULTILINE)
        return None if match is None else 1024.0 * int(match[1])
    return None
