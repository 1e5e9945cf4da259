"""Pages of detectors and of experiments on a study of CLOAK; and that the commands store what is shown."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.cloak.config import read_study
from attacks.rate import Rate
from attacks.report.page import page_text
from attacks.report.results import read_section
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json
from tests.fakes import ColourDetector, toy_scene
from tests.report.further_results import (
    DIRECTIONS,
    DISTANCES,
    FURTHER,
    PERFECT,
    SURROUNDINGS,
    experiment,
    write_curve,
    write_detections,
    write_evaluated,
)
from tests.report.results import STUDIED

STUDY = "name = 'small'\n[cameras]\ntrain = 60\n[[attack]]\nname = 'a'\nelevation = [50, 90]\n"


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


def test_other_distances(tmp_path: Path) -> None:
    section = read_section(FURTHER["cloak-experiment distance"](tmp_path / "x"))
    assert section.headline.rate == Rate(successes=18, total=20)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=20)
    assert [point.x for point in section.charts[0].lines[0].points] == [0.5, 1.0]
    assert section.file is not None
    (tmp_path / section.file[0]).write_text(section.file[1])
    assert read_study(tmp_path / section.file[0]) == STUDIED


def test_more_found_than_there_were_is_broken(tmp_path: Path) -> None:
    rows = [{**row, "found": 21} for row in DISTANCES]
    save_json(experiment("distance", rows), tmp_path / "distance.json")
    with pytest.raises(InvalidValueError, match="a rate of"):
        read_section(tmp_path / "distance.json")


def test_formats_surroundings_and_limits(tmp_path: Path) -> None:
    formats = read_section(FURTHER["cloak-experiment formats"](tmp_path / "x"))
    assert formats.headline.rate == Rate(successes=19, total=20)
    assert formats.charts[0].ticks == (".ply", ".splat")
    assert "10\u00a0% to 95\u00a0%" in formats.conclusion
    beside = read_section(FURTHER["cloak-experiment surroundings"](tmp_path / "x"))
    assert beside.headline.words == f"{SURROUNDINGS[0]['psnr_mean']}\u00a0dB"
    assert "Few pictures elsewhere: 4" in said(beside)
    limit = read_section(FURTHER["cloak-experiment transition-limit"](tmp_path / "x"))
    assert limit.control is not None
    assert (limit.headline.words, limit.control.words) == ("5.0\u00a0degrees", "25.0\u00a0degrees")
    painted = read_section(FURTHER["cloak-experiment paint-direction"](tmp_path / "x"))
    assert painted.headline.label.endswith("from 15 degrees")
    assert len(painted.tables[0].rows) == len(DIRECTIONS)


def test_a_perfect_splat(tmp_path: Path) -> None:
    section = read_section(FURTHER["cloak-experiment perfect-splat"](tmp_path / "x"))
    assert section.headline.rate == Rate(successes=30, total=30)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=40)
    assert [figure.rate for figure in section.figures] == [
        Rate(successes=24, total=30),
        Rate(successes=6, total=10),
    ]
    assert [len(table.rows) for table in section.tables] == [3, 2]
    save_json(experiment("perfect-splat", PERFECT[1:]), tmp_path / "rear.json")
    shown = read_section(tmp_path / "rear.json")
    assert shown.headline.rate == Rate(successes=6, total=10)
    assert shown.control is not None
    assert shown.control.rate == Rate(successes=0, total=10)


def test_the_detection_curve(tmp_path: Path) -> None:
    section = read_section(write_curve(tmp_path / "curve"))
    assert section.headline.rate == Rate(successes=18, total=20)
    assert section.control is not None
    assert section.control.rate == Rate(successes=2, total=20)
    assert [point.x for point in section.charts[0].lines[0].points] == [5.0, 85.0]
    assert section.tables[0].rows[0][:2] == ("overhead", "one")
    assert section.tables[0].rows[0][2].endswith("; by seed 10\u00a0% to 10\u00a0%")


def test_an_experiment_stores_what_its_page_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(STUDY)
    words = [
        "cloak-experiment",
        "transition-limit",
        str(tmp_path / "small.toml"),
        "--out",
        str(tmp_path / "limit.json"),
    ]
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "limit.json").read_text())
    section = read_section(tmp_path / "limit.json")
    assert section.versions
    assert section.command == shlex.join(["mi-splat", *words])
    assert cli.main(words) == 1
    said = capsys.readouterr().err
    assert "expected a free name" in said
    assert "force" not in said


def test_a_page_calls_only_figures_of_attacks_attacks(tmp_path: Path) -> None:
    pytest.importorskip("jinja2", reason="pages need the extra report")
    pytest.importorskip("matplotlib", reason="pages need the extra report")
    page = page_text([read_section(write_evaluated(tmp_path / "x")), read_section(write_curve(tmp_path / "curve"))])
    assert page.count('<p class="role">Result</p>') == 1
    assert page.count('<p class="role">Attack</p>') == 1
    assert f"folder <code>{tmp_path / 'x'}</code>" in page
