"""Long commands that are killed at any moment leave nothing half-written and no
process, and can be run again.

`MI_SPLAT_KILLS` says how many kills there are, and `MI_SPLAT_SEED` repeats them.
"""

import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from tests.campaign.driving import seed_of_today
from tests.campaign.kills import COMMANDS, SHORT, half_written, trial, write_inputs
from tests.warm import Warm

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are found by /proc"
)
KILLS = int(os.environ.get("MI_SPLAT_KILLS") or 200)
EACH = -(-KILLS // len(COMMANDS))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


def kills(
    name: str, count: int, seed: int, inputs: Path, folder: Path, warm: Warm
) -> Iterator[str]:
    """What was wrong after so many kills of a command."""
    whole = folder / "whole"
    whole.mkdir()
    start = time.monotonic()
    done = warm.run("-m", "attacks", *COMMANDS[name].line(inputs), cwd=whole)
    longest = time.monotonic() - start
    assert done.returncode == 0, done.stderr
    assert half_written(whole) == []
    for number in range(count):
        working = folder / str(number)
        working.mkdir()
        random = Random(f"{seed} {name} {number}")
        yield from trial(name, inputs, working, random, longest, warm)
        shutil.rmtree(working)


@pytest.mark.nightly
@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_nothing_half_done(
    name: str, inputs: Path, tmp_path: Path, warm: Warm
) -> None:
    seed = seed_of_today()
    faults = list(kills(name, EACH, seed, inputs, tmp_path, warm))
    assert not faults, "\n".join([f"MI_SPLAT_SEED={seed}", *faults])


@pytest.mark.parametrize("name", SHORT)
def test_a_killed_short_command_leaves_nothing_half_done(
    name: str, inputs: Path, tmp_path: Path, warm: Warm
) -> None:
    assert list(kills(name, 2, 3, inputs, tmp_path, warm)) == []
