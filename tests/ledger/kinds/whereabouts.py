"""Says where it runs: in which process, on how many cores, with which weights."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.ledger.kinds.configs import WalkConfig

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(
    config: WalkConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, Any]]:
    """One row, after some time."""
    time.sleep(config.seconds)
    row = {
        "process": os.getpid(),
        "cores": len(os.sched_getaffinity(0)),
        "weights": os.environ.get("MI_SPLAT_WEIGHTS"),
    }
    return [row]
