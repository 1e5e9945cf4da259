"""Every kind of file, damaged by chance: a value or an error of this project, in bounded time and memory."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.fuzz.kinds import EVERY

SECONDS = 3.0
"""For each kind; about five minutes in all."""
GROUPS = list(dict.fromkeys(name.split()[0] for name in EVERY))


@pytest.mark.nightly
@pytest.mark.parametrize("group", GROUPS)
def test_damaged_files_are_read_or_refused_in_words(group: str) -> None:
    names = [name for name in EVERY if name.split()[0] == group]
    words = [sys.executable, "-m", "tests.fuzz.campaign", str(SECONDS), *names]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60 + 20 * SECONDS * len(names))
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert not [line for line in lines if "raised" in line]
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line["kind"] for line in lines if line["mutants"]] == names
