"""Pages of detectors; and that the commands store what is shown."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.rate import Rate
from attacks.report.page import page_text
from attacks.report.results import read_section
from mi_splat.io import save_splat
from tests.fakes import ColourDetector, toy_scene
from tests.report.further_results import write_detections, write_evaluated
from tests.report.results import write_cloak


def said(section: Any) -> str:
    return " ".join(section.warnings)


def test_what_detectors_report(tmp_path: Path) -> None:
    section = read_section(write_detections(tmp_path / "seen"))
    assert section.headline.rate == Rate(successes=2, total=4)
    assert not section.attacked
    assert "there is no control" in said(section)
    assert [picture.path.name for picture in section.pictures] == ["photo-one.png"]
    classes, each = section.tables
    assert classes.rows[0][:3] == ("one", "car", "2 of 2 = 100\u00a0% (34.2 to 100\u00a0%)")
    assert classes.rows[1][:2] == ("two", "nothing")
    assert [row[0] for row in each.rows] == ["photo.png", "photo.png", "a.ply from orbit-00", "a.ply from orbit-00"]


def test_detect_stores_what_its_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("attacks.cli.names.load_detectors", lambda names, weights: [ColourDetector()])
    monkeypatch.chdir(tmp_path)
    save_splat(toy_scene()[0], tmp_path / "a.ply")
    words = ["a.ply", "--cameras", "orbit:2@0", "--distance", "3", "--size", "24", "--background", "1", "1", "1"]
    assert cli.main(["detect", *words, "--out", "seen"]) == 0
    section = read_section(Path("seen"))
    assert section.versions
    assert section.command == shlex.join(["mi-splat", "detect", *words, "--out", "seen"])
    assert len(section.pictures) == 2


def test_a_detector_s_figures(tmp_path: Path) -> None:
    section = read_section(write_evaluated(tmp_path / "x"))
    assert section.headline.rate == Rate(successes=2, total=4)
    assert section.control is not None
    assert section.control.rate == Rate(successes=2, total=16)
    assert "Few objects (path traced; car)" in said(section)
    words = {figure.label: figure.words for figure in section.figures}
    assert words["mean average precision at an overlap of 0.5, path traced"] == "0.500"
    assert words["false positives per picture, pictures without objects"].startswith("0.12 (2 in 16; ")
    chart = next(chart for chart in section.charts if chart.title.endswith("by elevation"))
    assert [point.y for point in chart.lines[0].points] == [0.5]


def test_detectors_side_by_side(tmp_path: Path) -> None:
    section = read_section(write_evaluated(tmp_path / "x", "one", "two"))
    assert section.title == "one and two at 0.5"
    assert section.headline.words == "50\u00a0%"
    assert [line.name for line in section.charts[0].lines] == ["one", "two"]


def test_a_page_calls_only_figures_of_attacks_attacks(tmp_path: Path) -> None:
    pytest.importorskip("jinja2", reason="pages need the extra report")
    pytest.importorskip("matplotlib", reason="pages need the extra report")
    page = page_text([read_section(write_evaluated(tmp_path / "x")), read_section(write_cloak(tmp_path / "cloak"))])
    assert page.count('<p class="role">Result</p>') == 1
    assert page.count('<p class="role">Attack</p>') == 1
    assert f"folder <code>{tmp_path / 'x'}</code>" in page
