"""The tables of docs/tables are what the rows in the repository give."""

import pytest

from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

DOCS = ROOT / "docs"


def test_no_table_is_out_of_date(monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("sphinx_extensions", "figures"):
        monkeypatch.syspath_prepend(DOCS / folder)
    import result_tables

    written = dict(result_tables.tables(DOCS))
    committed = {
        path.relative_to(DOCS / "tables").as_posix(): path.read_text()
        for path in (DOCS / "tables").rglob("*.md")
    }
    assert sorted(written) == sorted(committed)
    stale = [name for name, text in written.items() if committed[name] != text]
    assert not stale, "run `make docs`, which writes them anew, and commit them"
