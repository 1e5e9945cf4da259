"""The records of a study: one JSON for each of its attacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_splat.io.parsing import read_json


def ledger(folder: Path) -> list[dict[str, Any]]:
    """Every record in a folder, by the names of the files; none where there is no such folder.

    Raises:
        InvalidValueError: A file is no JSON.
        KeyError: A record is not a whole one.
    """
    records = [read_json(path) for path in sorted(folder.glob("*.json"))] if folder.is_dir() else []
    for record in records:
        _ = record["job"], record["result"]
    return records
