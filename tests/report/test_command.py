"""`mi-splat report`: what it refuses, what it writes and says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from attacks import cli
from tests.report.results import write_dagger, write_evaluation

pytest.importorskip("jinja2", reason="pages need the extra report")
pytest.importorskip("matplotlib", reason="pages need the extra report")


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_evaluation(tmp_path / "judged")
    (tmp_path / "old.html").write_text("an older page")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "results: expected one folder or more"),
        (["judged", "--out", "page.txt"], "ends in .html"),
        (["judged", "--out", "old.html"], "--force"),
        (["judged", "--out", "none/page.html"], "make the folder first"),
        (["nothing", "--out", "page.html"], "check the path"),
        (["judged", "empty", "--out", "page.html"], "empty: expected a folder that one of mi-splat dagger,"),
        (["judged/result.json", "--out", "page.html"], "pass judged"),
    ],
)
def test_errors_in_one_line(words: list[str], reason: str, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(results.iterdir())
    assert cli.main(["report", *words]) == 1
    error = capsys.readouterr().err
    assert reason in error
    assert len(error.splitlines()) == 1
    assert sorted(results.iterdir()) == before


def test_a_page_is_written_and_replaced_by_force_alone(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["report", "judged", "--out", "old.html", "--title", "A & B", "--force"]
    assert cli.main(words) == 0
    said = capsys.readouterr()
    assert "fake_colour reports person on the attacked splat: " in said.out
    assert "1 warning on the page" in said.err
    page = (results / "old.html").read_bytes()
    assert b"<h1>A &amp; B</h1>" in page
    assert cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["out"], len(document["results"])) == ("old.html", 1)
    assert (results / "old.html").read_bytes() == page


def test_several_results(results: Path) -> None:
    write_dagger(results / "attack")
    assert cli.main(["report", "attack", "judged", "--out", "page.html"]) == 0
    page = (results / "page.html").read_text("utf-8")
    assert "<h1>thing to person and attacked.ply against clean.ply</h1>" in page
    assert page.count("<article") == 2
