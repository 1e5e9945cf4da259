"""Goes some steps, remembers how far it has come, may do what a job should not, and
leaves its name in the store.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tests.ledger.kinds.configs import WalkConfig

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(
    config: WalkConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, int]]:
    """A chain of numbers, which is the same however often it was interrupted."""
    try:
        return _walked(config, inputs, out)
    except KeyboardInterrupt:
        (out.partial / "interrupted").write_text("")
        raise


def _walked(
    config: WalkConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, int]]:
    kept = out.partial / "kept"
    with (out.kept.parents[1] / "runs").open("a") as runs:
        runs.write(f"{out.kept.name}\n")
    step, number = (
        map(int, kept.read_text().split()) if kept.is_file() else (0, config.start)
    )
    while step < config.steps:
        if config.trouble == "raise":
            raise ValueError("no way")
        if config.trouble == "kill":
            os.kill(os.getpid(), signal.SIGSEGV)
            time.sleep(60)  # the signal comes to another thread, a little later
        if config.trouble == "eat":
            eaten = bytearray(b"x") * 400_000_000
            number += len(eaten)
        time.sleep(config.seconds)
        step = step + 1
        number = (number * 6364136223846793005 + 1) % (1 << 64)
        (out.partial / "new").write_text(f"{step} {number}")
        os.replace(out.partial / "new", kept)
        out.progress("walking", step, config.steps)
    (out / "end.txt").write_text(str(number))
    before = sum(int((path / "end.txt").read_text()) for path in inputs.values())
    return [{"end": number % 1000, "before": before % 1000}]
