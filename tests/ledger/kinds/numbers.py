"""Adds numbers up, and says so in a file and a row."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tests.ledger.kinds.configs import NumbersConfig

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = ("log/*",)


def run(
    config: NumbersConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, float]]:
    """The sum of the values, of the shift and of what the inputs say."""
    total = sum(config.values) + config.shift.by
    for path in inputs.values():
        total += float(
            path.read_text() if path.is_file() else (path / "sum.txt").read_text()
        )
    out.progress("adding", 1, 1)
    (out / "sum.txt").write_text(repr(total))
    return [{"sum": total}]
