"""Drives the process that reads damaged files, and starts another one when a mutant has
ended it.
"""

import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from mi_splat.process_group import GroupEndedError, Limits, ProcessGroup
from tests.campaign.kind import Kind

START = Limits(seconds=300.0, megabytes=4000.0)
"""Until the process can read, on a machine that does much else."""
LIMITS = Limits(seconds=120.0, megabytes=2500.0)
"""For one mutant; what the process has imported takes 700 MB."""
MOST_FAULTS = 10


@dataclass
class Account:
    """What became of the mutants of a kind."""

    kind: str
    read: int = 0
    called: set[str] = field(default_factory=set)
    faults: dict[int, str] = field(default_factory=dict)

    def in_words(self, seed: int) -> str:
        """Each fault, and the command that repeats it."""
        repeat = f"MI_SPLAT_SEED={seed} python -m tests.campaign {self.kind!r}"
        return "\n".join(
            f"{repeat} {number}: {text}" for number, text in self.faults.items()
        )


class Driver:
    """Reads mutants of one kind after the other in one process, as long as it lives."""

    def __init__(self) -> None:
        self._group: ProcessGroup | None = None

    def run(self, kind: Kind, *, seed: int, first: int = 0, count: int) -> Account:
        """Read mutants, whatever becomes of the process."""
        account = Account(kind.name)
        number = first
        end = first + count
        while number < end and len(account.faults) < MOST_FAULTS:
            reached = number - 1
            try:
                for message in self._answers(kind, seed, (number, end)):
                    reached = _note(message, account, reached)
                break
            except GroupEndedError as error:
                self.close()
                account.faults[reached] = f"the process {error}"
                number = reached + 1
            if reached < first:
                break  # it ended over the valid file
        return account

    def _answers(
        self, kind: Kind, seed: int, numbers: tuple[int, int]
    ) -> Iterator[dict[str, Any]]:
        group = self._started()
        request = {"kind": kind.name, "seed": seed, "numbers": numbers}
        group.pipe.send_bytes(json.dumps(request).encode())
        limits = START
        while (message := _received(group, limits))["state"] != "done":
            limits = LIMITS
            yield message

    def _started(self) -> ProcessGroup:
        if self._group is None:
            environment = {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
            self._group = ProcessGroup(
                "tests.campaign.reading", environment=environment
            )
            _received(self._group, START)
        return self._group

    def close(self) -> None:
        """End the process."""
        if self._group is not None:
            self._group.close()
            self._group = None


def _received(group: ProcessGroup, limits: Limits) -> dict[str, Any]:
    group.wait(limits, time.monotonic())
    try:
        message: dict[str, Any] = json.loads(group.pipe.recv_bytes())
    except (EOFError, OSError) as error:
        raise group.ended() from error
    return message


def _note(message: dict[str, Any], account: Account, reached: int) -> int:
    """Enter a message into an account; the number of the last mutant that was begun."""
    match message["state"]:
        case "made":
            account.called |= set(message["called"])
        case "at":
            account.read += 1
            return int(message["number"])
        case "fault":
            account.faults.setdefault(message["number"], message["fault"])
    return reached


def seed_of_today() -> int:
    """The seed that `MI_SPLAT_SEED` gives, or a new one."""
    return int(os.environ.get("MI_SPLAT_SEED") or time.time())


def mutants() -> int:
    """How many mutants of each kind are read; `MI_SPLAT_MUTANTS` may say another
    number.
    """
    return int(os.environ.get("MI_SPLAT_MUTANTS") or 100)
