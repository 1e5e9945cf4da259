"""The figures of the documentation follow from the raw rows in docs/artifacts."""

from __future__ import annotations

from pathlib import Path

import pytest

from attacks.artifacts.checking import check_artifact, check_pages
from attacks.artifacts.contents import RECORD
from tests.artifacts.test_docs_figures import SENTENCES
from tests.project.documented_commands import ROOT

FOLDERS = sorted(path.parent for path in (ROOT / "docs" / "artifacts").glob(f"*/{RECORD}"))
MOST_BYTES = 1_500_000
"""Of an artifact; the largest has the rows of six splats, four detectors and 871 cameras."""


def test_there_are_artifacts() -> None:
    assert FOLDERS
    assert {path.name for path in FOLDERS} == {path.name for path in (ROOT / "docs" / "artifacts").iterdir()}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: str(path.name))
def test_every_figure_follows_from_the_rows_and_stands_on_its_pages(folder: Path) -> None:
    checked = check_artifact(folder)
    pages = check_pages(checked, ROOT)
    assert pages or folder.name in {name for name, _, _ in SENTENCES}, "name the pages that show its figures"
    lines = [*checked.files, *checked.figures, *pages]
    assert [(line.name, line.words) for line in lines if line.passed is False] == []


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: str(path.name))
def test_it_is_small_and_names_no_machine(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    for path in files:
        if path.suffix in (".json", ".toml"):
            text = path.read_text()
            assert not [word for word in ('"/', "/home/", "/tmp/", "/Users/") if word in text]
