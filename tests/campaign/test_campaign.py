"""Files of every kind, damaged by chance: a value or an error of this project, in bounded time, memory and space.

The seed moves with the clock, and a failure names it: `MI_SPLAT_SEED=... python -m tests.campaign KIND NUMBER` repeats
one, and `MI_SPLAT_MUTANTS` says how many of each kind there are.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.campaign.driving import Driver, mutants, seed_of_today
from tests.campaign.kinds import KINDS, Kind
from tests.campaign.mutations import mutant
from tests.io.format_files import valid

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the limits are those of Linux")


@pytest.fixture(scope="module")
def driver() -> Iterator[Driver]:
    """One process for all kinds, as long as it lives."""
    made = Driver()
    yield made
    made.close()


@pytest.mark.nightly
@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused(name: str, driver: Driver) -> None:
    seed, kind = seed_of_today(), KINDS[name]
    account = driver.run(kind, seed=seed, count=mutants())
    assert not account.faults, f"{account.in_words(seed)}"
    assert account.read == mutants()
    modules = {function.partition(":")[0] for function in account.called}
    missing = [reader for reader in kind.readers if reader not in account.called | modules]
    assert not missing, f"readers that the valid file does not reach: {missing}"


# The campaign itself notices: readers that do what none may do


def _crash(path: Path) -> None:
    os.abort()


def _wait(path: Path) -> None:
    if path.read_bytes() != b"whole":
        while True:
            pass
