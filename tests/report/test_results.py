"""Every kind of result becomes a section: its figures are those of its files, its
command is the one that made it.
"""

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from attacks.cli.summary import show_summary
from attacks.cloak.config import recorded_study
from attacks.cloak.figures import measures
from attacks.cloak.recorded import study_of
from attacks.figures.frame import read_figures
from attacks.figures.rate import Rate, pooled
from attacks.observe.rates import Confidence, Measures
from attacks.observe.rows import packed, rows
from attacks.report.kinds.audit import angles
from attacks.report.kinds.detectors import threshold_charts
from attacks.report.results import RESULT_KINDS, read_section
from attacks.report.viewer_content import open_content
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.documents import save_png
from mi_splat.io.folders import read_manifest
from mi_splat.io.parsing import read_json
from mi_splat.provenance import running_command
from tests.cloak.tiny_study import study_in
from tests.report.results import (
    ARTIFACTS,
    FAILED,
    MAKERS,
    TWO_SEEDS,
    change,
    cloak_record,
    write_cloak,
    write_dagger,
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("results")
    with running_command(LINE):
        return {
            name: make(base / name.replace(" ", "")) for name, make in MAKERS.items()
        }


LINE = ["mi-splat", "some command", "a b.ply", "--out", "x"]
UNCONTROLLED = {"audit", "image-audit"}
"""Kinds without a control."""


def test_every_kind_is_tried() -> None:
    assert {kind.name for kind in RESULT_KINDS} == set(MAKERS)


@pytest.mark.parametrize("name", MAKERS)
def test_every_kind_is_read_and_its_command_is_stored(
    name: str, folders: dict[str, Path]
) -> None:
    section = read_section(folders[name])
    assert section.folder == str(folders[name])
    by_command = name == "evaluate"
    assert (
        section.command == shlex.join(LINE)
        if not by_command
        else section.command.startswith(f"mi-splat {name} /")
    )
    for text in (section.done, section.conclusion, *section.warnings):
        assert text.endswith(".")
        assert "None" not in text
    assert len(set(section.all_figures)) == len(section.all_figures)
    assert section.configuration
    assert section.versions
    for table in section.tables:
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.head)}
    for chart in section.charts:
        assert any(line.points for line in chart.lines)
    assert (section.control is None) == (name in UNCONTROLLED)


@pytest.mark.parametrize("name", MAKERS)
def test_what_is_broken_is_told_in_one_line(
    name: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    whole = json.loads((folders[name] / "result.json").read_text())
    file = tmp_path / "result.json"
    file.write_text("{")
    with pytest.raises(InvalidValueError, match="expected a JSON object"):
        read_section(tmp_path)
    wrong: tuple[Any, ...] = (None, 3, "text", {"x": []})
    told = list[str]()
    for key in whole:
        for value in wrong:
            file.write_text(json.dumps({**whole, key: value}))
            try:
                read_section(tmp_path)
            except InvalidValueError as error:  # no other error
                told.append(str(error))
    assert all(": expected " in text for text in told)
    file.write_text("{}")
    with pytest.raises(InvalidValueError, match=r"expected .* again"):
        read_section(tmp_path)


def test_an_attack_s_figures_and_settings(folders: dict[str, Path]) -> None:
    region = read_section(folders["dagger-eot"]).headline.rate
    assert region is not None
    assert region.total == 8
    section = read_section(folders["dagger"])
    assert section.title == "thing to person"
    assert section.headline.rate == Rate(successes=1, total=1)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=5)
    assert section.warnings[-1].startswith("Few views: 1")
    assert [picture.path.name for picture in section.pictures] == [
        "detections.png",
        "difference.png",
    ]
    assert dict(section.configuration)["eps"] == "12"


def test_an_attack_without_a_control_says_so(tmp_path: Path) -> None:
    section = read_section(write_dagger(tmp_path / "a", noise_draws=0))
    assert (section.control, section.command) == (None, "")
    assert any("no control" in text for text in section.warnings)
    assert section.manifest == read_manifest(tmp_path / "a").sha256


def test_a_study_s_file_is_the_study(folders: dict[str, Path], tmp_path: Path) -> None:
    section = read_section(folders["cloak"])
    assert section.file is not None
    (tmp_path / section.file[0]).write_text(section.file[1])
    assert study_in(tmp_path / section.file[0]) == recorded_study(
        cloak_record()["study"], "study"
    )


def test_a_study_says_what_speaks_against_it(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    section = read_section(folders["cloak"])
    shipped = read_figures(ARTIFACTS / FAILED)
    assert section.headline.rate == shipped.rate("trigger_miss_rate")
    assert section.control is not None
    assert section.control.rate == Rate(successes=1, total=338)
    for warning in ("Not stealthy", "The attack rear fails", "One seed"):
        assert warning in " ".join(section.warnings)
    several = read_section(
        write_cloak(
            tmp_path / "several",
            TWO_SEEDS,
            control_recall=Rate(successes=4, total=40),
        )
    )
    for warning in ("look at each seed", "detected in 4 of 40 views only"):
        assert warning in " ".join(several.warnings)


def test_a_study_that_hides_nothing_has_the_target_class_as_its_figure(
    tmp_path: Path,
) -> None:
    folder = write_cloak(
        tmp_path / "a",
        trigger_miss_rate=None,
        control_recall=None,
        target_rate=Rate(successes=20, total=40),
    )
    section = read_section(folder)
    assert section.headline.rate == Rate(successes=20, total=40)
    assert section.control is not None
    shipped = read_figures(ARTIFACTS / FAILED)
    assert section.control.rate == shipped.rate("control_target_rate")


@pytest.mark.parametrize(
    ("name", "axis"),
    [("cloak_car_layers", "elevation"), ("cloak_car_sector_layers", "azimuth")],
)
def test_a_study_has_resampled_intervals_and_a_chart_over_its_angle(
    name: str, axis: str
) -> None:
    section = read_section(ARTIFACTS / name)
    shipped = read_figures(ARTIFACTS / name)
    assert section.headline.rate == shipped.rate("trigger_miss_rate")
    assert section.headline.rate is not None
    assert section.headline.rate.resampled is not None
    assert any(axis in chart.x_label for chart in section.charts)


def test_an_audit_says_what_was_not_judged_and_from_where_it_contradicts_itself(
    folders: dict[str, Path],
) -> None:
    section = read_section(folders["audit"])
    assert section.headline.words == "contradicted"
    assert [picture.path.name for picture in section.pictures] == [
        "contradicted.png",
        "heat.png",
    ]
    assert "predict a car (0.80)" in section.pictures[0].caption
    (seen,) = section.charts
    inside, outside = seen.lines
    assert inside.name == "in a contradicted cone"
    heights = [point.y for point in outside.points]
    assert min(point.y for point in inside.points) > 44 > max(heights)
    for words in (
        "20% of the solid",
        "Nothing shows (1 Ga",
    ):
        assert words in " ".join(section.warnings)
    assert len(section.tables) == 2


def test_azimuths_are_from_the_file_s_x_axis() -> None:
    up = (0.0, 0.0, 1.0)
    side = (0.0, 1.0, 0.0)
    assert angles((0.0, 1.0, 0.0), up) == (90.0, 0.0)
    assert angles((1.0, 0.0, 0.0), side) == (0.0, 0.0)
    assert angles((0.0, 0.0, 1.0), side) == (270.0, 0.0)
    assert angles((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)) == (0.0, 0.0)
    assert angles(up, up)[1] == 90.0


def test_detectors_are_counted_apart_from_classifiers(folders: dict[str, Path]) -> None:
    section = read_section(folders["poison-study"])
    figures = read_figures(folders["poison-study"]).having("setting")
    named = figures.where(condition="held-out cameras", splat="clean").rates("named")
    assert section.control is not None
    assert section.control.rate == pooled(named)
    detectors = {
        figure.label.partition(" finds")[0]
        for figure in section.figures
        if " finds " in figure.label
    }
    assert detectors == {"fasterrcnn_small", "yolov8n_small"}
    heads = {column for table in section.tables for column in table.head[1:2]}
    assert heads >= {"classifier", "detector"}


def test_a_command_says_what_its_page_says(
    folders: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    show_summary(folders["cloak"], as_json=False, tables=1)
    text = capsys.readouterr().out
    assert text.startswith("From inside the trigger the ")
    assert (
        "\n## Rates by detector\n\n| rate | fasterrcnn_small | yolov8n_small |\n"
        in text
    )
    assert text.count("\n## ") == 1


SECTOR = ARTIFACTS / "cloak_car_sector_layers"


def cloak(confidence: Confidence) -> Measures:
    study = study_of(json.loads((SECTOR / "result.json").read_text()))
    return measures(study, confidence=confidence)


def test_the_sector_is_missed_less_by_a_lower_confidence() -> None:
    charts, (table,) = threshold_charts(
        rows(SECTOR), cloak, {"trigger_miss_rate": ("missed", "attack")}
    )
    assert [chart.title.split(",")[0] for chart in charts][:2] == [
        "fasterrcnn_small",
        "yolov8n_small",
    ]
    (line,) = charts[1].lines
    heights = {point.x: point.y for point in line.points}
    assert 0 < heights[0.2] < heights[0.5]
    assert all(
        point.low is not None and point.low <= point.y <= (point.high or 0)
        for point in line.points
    )
    assert table.head == ("detector", "rate", "from 0.5", "from 0.25")
    assert [row[:2] for row in table.rows][:2] == [
        ("fasterrcnn_small", "missed"),
        ("yolov8n_small", "missed"),
    ]
    assert threshold_charts(
        rows(SECTOR), cloak, {"target_rate": ("reported", "attack")}
    ) == ([], [])
    assert threshold_charts(
        None, cloak, {"trigger_miss_rate": ("missed", "attack")}
    ) == ([], [])


HOSTILE = [
    "../private",
    "/etc/hostname",
    "..",
    "a/../../private",
    "C:\\private",
    ".hidden",
    "a\nb",
]


def own(folders: dict[str, Path], name: str, tmp_path: Path) -> Path:
    """A copy of a result, with an image beside it that is none of its business."""
    save_png(np.full((8, 8, 3), 255, np.uint8), tmp_path / "private.png")
    copy: Path = shutil.copytree(folders[name], tmp_path / "result")
    return copy


@pytest.mark.parametrize("name", HOSTILE)
def test_names_in_a_record_are_names(
    name: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = own(folders, "evaluate", tmp_path)
    table = rows(folder).with_columns(detector=pl.lit(name))
    (folder / "rows.csv.xz").write_bytes(packed(table.write_csv().encode()))
    with pytest.raises(MiSplatError, match="expected names of files in its folder"):
        read_section(folder)


@pytest.mark.parametrize("name", ["../private.png", "/etc/hostname", 3])
def test_names_of_images_in_an_audit_are_names(
    name: object, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = own(folders, "audit", tmp_path)
    pictures = read_json(folder / "result.json")["pictures"]
    change(folder / "result.json", pictures=[{**pictures[0], "file": name}])
    with pytest.raises(MiSplatError, match="expected names of files in its folder"):
        read_section(folder)


def test_links_in_a_result_are_not_followed_out_of_it(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    for number, kind in enumerate(folders):
        (tmp_path / str(number)).mkdir()
        folder = own(folders, kind, tmp_path / str(number))
        (folder / "link").symlink_to("../private.png")
        for read in (read_section, open_content):
            with pytest.raises(
                MiSplatError, match="a link that leads out of the folder"
            ):
                read(folder)
        (folder / "link").unlink()
        (folder / "same.json").symlink_to("result.json")
        read_section(folder)
