"""An installed distribution with entry points, made in a folder: no pip is needed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest


def install(
    folder: Path, entries: Mapping[str, str], *, name: str = "plugged", **modules: str
) -> None:
    """Write a distribution that has these entry points."""
    information = folder / f"{name}-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    )
    lines = []
    for key, value in entries.items():
        group, entry = key.split("/")
        lines.append(f"[{group}]\n{entry} = {value}\n")
    (information / "entry_points.txt").write_text("\n".join(lines))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)


def on_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on sys.path for one test."""
    folder.mkdir(parents=True, exist_ok=True)
    monkeypatch.syspath_prepend(folder)
    return folder
