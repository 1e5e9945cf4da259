"""Files of every kind, damaged by chance: a value or an error of this project, in
bounded time, memory and space.

The seed moves with the clock, and a failure names it:
`MI_SPLAT_SEED=... python -m tests.campaign KIND NUMBER` repeats one, and
`MI_SPLAT_MUTANTS` says how many of each kind there are.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.campaign.bad import BAD, FAULTS, IN_PROCESS
from tests.campaign.driving import Driver, mutants, seed_of_today
from tests.campaign.kinds import KINDS
from tests.campaign.reading import fault, mutated, whole
from tests.io.format_files import valid

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="the limits are those of Linux"
)


@pytest.fixture(scope="module")
def driver() -> Iterator[Driver]:
    """One process for all kinds, as long as it lives."""
    made = Driver()
    yield made
    made.close()


@pytest.mark.nightly
@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused(name: str, driver: Driver) -> None:
    seed = seed_of_today()
    kind = KINDS[name]
    account = driver.run(kind, seed=seed, count=mutants())
    assert not account.faults, f"{account.in_words(seed)}"
    assert account.read == mutants()
    modules = {function.partition(":")[0] for function in account.called}
    missing = [
        reader for reader in kind.readers if reader not in account.called | modules
    ]
    assert not missing, f"readers that the valid file does not reach: {missing}"


@pytest.mark.nightly
@pytest.mark.parametrize("name", BAD)
def test_whatever_none_may_do_is_noticed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MI_SPLAT_CPU_SECONDS", "4")
    driver = Driver()
    try:
        account = driver.run(BAD[name], seed=1, count=2)
    finally:
        driver.close()
    assert account.read == 2
    assert account.faults.keys() == {0, 1}
    assert FAULTS[name] in account.faults[1]
    assert f"MI_SPLAT_SEED=1 python -m tests.campaign {name!r} 1: " in account.in_words(
        1
    )


@pytest.mark.parametrize("name", IN_PROCESS)
def test_what_is_no_error_in_words_is_a_fault(name: str, tmp_path: Path) -> None:
    path, data = whole(BAD[name], tmp_path)
    assert fault(BAD[name], path, data) is None
    assert FAULTS[name] in str(fault(BAD[name], path, data[:-1]))


def test_a_seed_and_a_number_make_the_same_mutant() -> None:
    for kind in (
        KINDS["splat a.glb"],
        KINDS["splat v3.spz"],
        KINDS["cameras cameras.json"],
    ):
        if "splat" in kind.name:
            data = valid(kind.name.split()[1])
        else:
            data = b'[{"id": 0, "fx": 50.0}]'
        mutants_of_kind = [mutated(kind, 7, number, data) for number in range(30)]
        assert mutants_of_kind == [
            mutated(kind, 7, number, data) for number in range(30)
        ]
        assert len({*mutants_of_kind}) > 20
        assert mutated(kind, 8, 3, data) != mutants_of_kind[3]
