"""Every kind of result becomes a section: its figures are those of its files, its command is the one that made it."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from attacks.cloak.config import read_study
from attacks.rate import Rate
from attacks.report.results import STORIES, read_section
from mi_splat.errors import InvalidValueError
from mi_splat.io.manifest import read_manifest
from mi_splat.provenance import running_command
from tests.project.documented_commands import ROOT
from tests.report.makers import MAKERS
from tests.report.results import STUDIED, rate, write_cloak, write_dagger


def complaint(folder: Path) -> str | None:
    """What is wrong with a folder; other errors than those that are meant for people pass."""
    try:
        read_section(folder)
    except InvalidValueError as error:
        return str(error)
    return None


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("results")
    with running_command(LINE):
        return {name: make(base / name.replace(" ", "")) for name, make in MAKERS.items()}


LINE = ["mi-splat", "some command", "a b.ply", "--out", "x"]
UNCONTROLLED = {"dagger-sanity", "compare", "detect"}
"""Kinds without a control."""


def test_every_kind_is_tried() -> None:
    assert {kind.name for kind in STORIES} == set(MAKERS)


@pytest.mark.parametrize("name", MAKERS)
def test_every_kind_is_read_and_its_command_is_stored(name: str, folders: dict[str, Path]) -> None:
    section = read_section(folders[name])
    assert section.folder == str(folders[name])
    line = shlex.join(LINE)
    assert section.command == line if name != "compare" else section.command.startswith("mi-splat compare /")
    for text in (section.done, section.conclusion, *section.warnings):
        assert text.endswith(".")
        assert "None" not in text
    assert section.configuration
    assert section.versions
    for table in section.tables:
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.head)}
    for chart in section.charts:
        assert any(line.points for line in chart.lines)
    assert (section.control is None) == (name in UNCONTROLLED)


@pytest.mark.parametrize("name", MAKERS)
def test_what_is_broken_is_told_in_one_line(name: str, folders: dict[str, Path], tmp_path: Path) -> None:
    whole, file = json.loads((folders[name] / "result.json").read_text()), tmp_path / "result.json"
    file.write_text("{")
    with pytest.raises(InvalidValueError, match="expected a JSON object"):
        read_section(tmp_path)
    wrong: tuple[Any, ...] = (None, 3, "text", {"x": []})
    for key in list(whole):
        for value in wrong:
            file.write_text(json.dumps({**whole, key: value}))
            said = complaint(tmp_path)
            assert said is None or ": expected " in said
    file.write_text("{}")
    with pytest.raises(InvalidValueError, match=r"expected .* again"):
        read_section(tmp_path)


@pytest.mark.parametrize(
    ("path", "words"),
    [("nothing", "nothing there"), ("empty", "one without a result"), ("file.json", "a file; pass ")],
)
def test_what_is_no_result_is_told(path: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.json").write_text("{}")
    with pytest.raises(InvalidValueError, match=words):
        read_section(tmp_path / path)


def test_an_attack_s_figures_and_settings(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger"])
    assert section.title == "thing to person"
    assert section.headline.rate == Rate(successes=1, total=1)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=5)
    assert section.warnings[-1].startswith("Few views: 1")
    assert [picture.path.name for picture in section.pictures] == ["detections.png", "difference.png"]
    assert dict(section.configuration)["eps"] == "12"


def test_the_manifest_stands_on_the_page(folders: dict[str, Path]) -> None:
    assert read_section(folders["dagger"]).manifest != ""
    assert read_section(folders["compare"]).manifest == read_manifest(folders["compare"]).sha256


def test_an_attack_without_a_control_says_so(tmp_path: Path) -> None:
    section = read_section(write_dagger(tmp_path / "a", noise_draws=0))
    assert section.control is None
    assert any("no control" in text for text in section.warnings)


def test_an_attack_made_from_python_has_no_command(tmp_path: Path) -> None:
    assert read_section(write_dagger(tmp_path / "a")).command == ""


def test_an_attack_on_a_region(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-eot"])
    stored = json.loads((folders["dagger-eot"] / "result.json").read_text())
    assert section.headline.rate == Rate(successes=stored["rate"]["successes"], total=8)


def test_a_study_s_file_is_the_study(folders: dict[str, Path], tmp_path: Path) -> None:
    section = read_section(folders["cloak"])
    assert section.file is not None
    (tmp_path / section.file[0]).write_text(section.file[1])
    assert read_study(tmp_path / section.file[0]) == STUDIED


def test_a_study_says_what_speaks_against_it(folders: dict[str, Path], tmp_path: Path) -> None:
    section = read_section(folders["cloak"])
    assert section.headline.rate == Rate(successes=36, total=40)
    assert section.control is not None
    assert section.control.rate == Rate(successes=1, total=40)
    said = " ".join(section.warnings)
    assert "Not stealthy" in said
    assert "The attack rear fails" in said
    assert "look at each seed" in said
    one = write_cloak(tmp_path / "one", seeds=[0], control_recall=rate(4, 40))
    said = " ".join(read_section(one).warnings)
    assert "One seed" in said
    assert "found in 4 of 40 views only" in said


def test_a_study_that_hides_nothing_has_the_target_class_as_its_figure(tmp_path: Path) -> None:
    folder = write_cloak(tmp_path / "a", trigger_miss_rate=None, control_recall=None, target_rate=rate(20, 40))
    section = read_section(folder)
    assert section.headline.rate == Rate(successes=20, total=40)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=40)


def test_resampled_intervals_stand_on_the_page() -> None:
    section = read_section(ROOT / "docs" / "artifacts" / "cloak_car_layers")
    assert section.headline.rate is not None
    record = json.loads((ROOT / "docs" / "artifacts" / "cloak_car_layers" / "result.json").read_text())
    assert list(section.headline.rate.interval) == record["trigger_miss_rate"]["interval"]
    assert section.headline.rate.resampled is not None


def test_red_lines_of_sanity_are_warnings(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-sanity"])
    assert section.headline.value == "1 of 2"
    assert len(section.warnings) == 2
