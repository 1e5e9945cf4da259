"""Whoever edits, cuts or breaks a result is found out, and told in words."""

import csv
import json
import lzma
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.figures.frame import (
    MEASURE,
    Figures,
    Number,
    key_of,
    read_figures,
    write_figures,
)
from attacks.figures.rate import Rate
from attacks.figures.result import read_result
from attacks.report.checking import Check, agree, check_files, check_result, pack
from attacks.report.results import kind_of
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.folders import MANIFEST, RECORD, read_manifest, write_manifest
from tests.project.documented_commands import ROOT
from tests.report.results import write_dagger

pytestmark = pytest.mark.shipped

Rows = list[dict[str, str]]


def checks(folder: Path, *, manifest: str | None = None) -> list[Check]:
    result = read_result(folder)
    return check_result(result, kind_of(result).derive, manifest=manifest)


def red(folder: Path, *, manifest: str | None = None) -> list[str]:
    return [
        line.name for line in checks(folder, manifest=manifest) if line.passed is False
    ]


def edit_record(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Edit result.json, and hide it from the manifest."""
    values = json.loads((folder / RECORD).read_text())
    change(values)
    (folder / RECORD).write_text(json.dumps(values))
    write_manifest(folder)


def edit_rows(folder: Path, change: Callable[[Rows], Any], name: str = "rows") -> None:
    """Edit a table, and hide it from the manifest."""
    path = folder / f"{name}.csv.xz"
    with lzma.open(path, "rt", newline="") as file:
        rows = list(csv.DictReader(file))
    head = list(rows[0])
    change(rows)
    with lzma.open(path, "wt", newline="") as file:
        writer = csv.DictWriter(file, head, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_manifest(folder)


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of an attack from two cameras, which no test changes."""
    return write_dagger(
        tmp_path_factory.mktemp("attacked") / "result", views=2, noise_draws=2
    )


@pytest.fixture
def attack(attacked: Path, tmp_path: Path) -> Path:
    """A copy of it, for a test to break."""
    return Path(shutil.copytree(attacked, tmp_path / "attack"))


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A copy of a study of CLOAK, for a test to break."""
    return Path(
        shutil.copytree(
            ROOT / "docs" / "artifacts" / "cloak_car_layers_shadow", tmp_path / "study"
        )
    )


def test_a_result_as_it_was_written_is_green(attacked: Path) -> None:
    lines = checks(attacked, manifest=read_manifest(attacked).sha256)
    assert {line.passed for line in lines} == {True}
    names = {
        "succeeded",
        "score, splat attacked",
        "success, splat attacked",
        "reached, splat noise",
        "target_confidence, detector fake_colour",
        "success, splat noise, detector fake_colour",
    }
    assert names <= {line.name for line in lines}


def test_other_bytes_are_seen(attack: Path) -> None:
    (attack / "before.png").write_bytes(b"other")
    assert red(attack) == ["before.png"]
    (attack / "detections.csv.xz").unlink()
    (attack / "more.ply").write_text("")
    assert red(attack) == ["before.png", "detections.csv.xz", "more.ply"]
    (attack / "attacked.ply").unlink()  # splats may be left out
    (line,) = (line for line in check_files(attack) if line.name == "attacked.ply")
    assert (line.colour, line.words) == ("grey", "left out")


def test_what_lies_behind_a_link_counts_as_missing(
    attack: Path, tmp_path: Path
) -> None:
    (attack / "more").mkdir()
    (attack / "more" / "notes.json").write_text("{}")
    write_manifest(attack)
    assert red(attack) == []
    (attack / "more").rename(tmp_path / "private")
    (attack / "more").symlink_to(tmp_path / "private")
    assert red(attack) == ["more/notes.json", "more"]
    (attack / "rows.csv.xz").rename(tmp_path / "private" / "rows.csv.xz")
    (attack / "rows.csv.xz").symlink_to(tmp_path / "private" / "rows.csv.xz")
    with pytest.raises(MiSplatError, match="a link that leads out of the folder"):
        checks(attack)


def test_a_link_counts_as_missing(attack: Path, attacked: Path) -> None:
    (attack / "cameras.json").unlink()
    (attack / "cameras.json").symlink_to(attacked / "cameras.json")
    assert red(attack) == ["cameras.json"]


@pytest.mark.parametrize("key", ["detectors", "command"])
def test_what_made_it_cannot_be_changed_unseen(key: str, attack: Path) -> None:
    name = read_manifest(attack).sha256
    record = json.loads((attack / RECORD).read_text())
    fake: object = "another"
    if key == "detectors":
        fake = [{**one, "detector_fingerprint": "0"} for one in record["detectors"]]
    (attack / RECORD).write_text(json.dumps({**record, key: fake}))
    assert RECORD in red(attack)
    # who hides it from the manifest has a result of another name
    write_manifest(attack)
    assert red(attack) == []
    assert red(attack, manifest=name) == [MANIFEST]


def turn(rows: Rows) -> None:
    row = next(row for row in rows if row["splat"] == "attacked")
    row["success"] = {"true": "false", "false": "true"}[row["success"]]


@pytest.mark.parametrize(
    ("table", "change", "moved"),
    [
        (
            "rows",
            turn,
            {
                "success, splat attacked",
                "success, splat attacked, detector fake_colour",
            },
        ),
        (
            "rows",
            lambda rows: [
                row.update(success="true") for row in rows if row["draw"] == "1"
            ],
            {"success, splat noise"},
        ),
        (
            "detections",
            lambda rows: [row.update(score="0.011") for row in rows],
            {"detections"},
        ),
    ],
    ids=["a row", "noise", "detections"],
)
def test_edited_tables_move_figures(
    table: str, change: Callable[[Rows], Any], moved: set[str], attack: Path
) -> None:
    edit_rows(attack, change, table)
    assert moved <= set(red(attack))


def edit_figures(folder: Path, change: Callable[[dict[Any, Any]], Any]) -> None:
    """Edit figures.csv, and hide it from the manifest."""
    figures = dict(read_figures(folder))
    change(figures)
    write_figures(Figures(figures), folder)
    write_manifest(folder)


RATE = key_of({MEASURE: "success", "splat": "attacked"})
STRICT = key_of({MEASURE: "reached_strictly", "splat": "attacked"})
SCORE = key_of({MEASURE: "score", "splat": "attacked"})
CONFIDENCE = key_of({MEASURE: "target_confidence"})
MADE_UP = key_of({MEASURE: "made_up"})


def test_a_figure_that_is_off_is_seen_and_not_packed(
    attack: Path, tmp_path: Path
) -> None:
    def change(figures: dict[Any, Any]) -> None:
        rate = figures[RATE]
        figures[RATE] = Rate(successes=rate.successes - 1, total=rate.total)
        figures[CONFIDENCE] = Number(value=figures[CONFIDENCE].value + 1e-5)
        figures[SCORE] = Number(value=figures[SCORE].value + 1e-8)
        del figures[STRICT]
        figures[MADE_UP] = Rate(successes=1, total=2)

    edit_figures(attack, change)
    assert set(red(attack)) == {
        "success, splat attacked",
        "target_confidence",
        "reached_strictly, splat attacked",
        "made_up",
    }
    edit_record(attack, lambda record: record.update(success=not record["success"]))
    assert "success in result.json" in red(attack)
    derive = kind_of(read_result(attack)).derive
    for words in (
        r"reached_strictly.*: figures\.csv has nothing, the rows give",
        r"before\.png: other bytes",
    ):
        with pytest.raises(InvalidValueError, match=words):
            pack(attack, tmp_path / "copy", derive)
        (attack / "before.png").write_bytes(b"other")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    "line",
    [
        "success,attacked,0.5,1,,0,1",
        "success,attacked,3,2,,0,1",
        "success,attacked,-1,2,,0,1",
        "success,attacked,1,2,,0.9,0.1",
        "success,attacked,1,2,,,",
        "score,attacked,,,,,",
        "score,attacked,,,nan,,",
        "score,attacked,,,1,,\nscore,attacked,,,1,,",
        "score",
        "",
    ],
)
def test_figures_that_are_none_are_refused_in_words(line: str, attack: Path) -> None:
    head = "measure,splat,successes,total,value,low,high"
    (attack / "figures.csv").write_text(f"{head}\n{line}\n")
    try:
        lines = red(attack)
    except InvalidValueError:
        return
    assert "figures.csv" in lines


@pytest.mark.parametrize("value", [None, 3, "x", [[]], {"x": 1}])
def test_no_record_ends_in_anything_but_an_error_in_words(
    value: object, attacked: Path, attack: Path
) -> None:
    """Whatever stands under a key, a check tells lines or raises the project's
    error.
    """
    record = json.loads((attacked / RECORD).read_text())
    for key in record:
        if record[key] == value:
            continue
        (attack / RECORD).write_text(json.dumps({**record, key: value}))
        try:
            lines = red(attack)
        except InvalidValueError:
            continue
        assert RECORD in lines


def test_edited_rows_of_a_study_move_its_figures(study: Path) -> None:
    def lower(rows: Rows) -> None:
        seen = (
            row
            for row in rows
            if row["splat"] == "clean" and float(row["original_score"]) > 0.5
        )
        next(row for row in seen if float(row["depth: overhead"]) > 0)[
            "original_score"
        ] = "0.1"

    edit_rows(study, lower)
    edit_rows(study, lambda rows: rows[0].update(psnr="31.5"), "fidelity")
    edit_rows(
        study,
        lambda rows: [row.update(fraction="0.4") for row in rows[-9:]],
        "transition",
    )
    moved = set(red(study))
    assert {
        "control_recall, detector fasterrcnn_small",
        "benign_psnr, splat clean",
        "transition_degrees",
    } <= moved


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda rows: rows.pop(),
            "one row for each detector and camera, got none for yolov8n_small, view",
        ),
        (
            lambda rows: rows.append(rows[0]),
            "one row for each detector and camera, got others, or one twice",
        ),
        (
            lambda rows: rows[0].update(seed="7"),
            "table rows: expected rows of the study's splats, got others",
        ),
        (
            lambda rows: rows[0].update(elevation="inf"),
            "expected a number in column elevation, got inf",
        ),
    ],
)
def test_rows_that_are_not_the_study_s_are_refused(
    change: Callable[[Rows], Any], message: str, study: Path
) -> None:
    edit_rows(study, change)
    with pytest.raises(InvalidValueError, match="get the result again") as error:
        checks(study)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("table", "values"),
    [
        ("scene", {"object": ["car"]}),
        ("evaluation", {"detectors": ["another"]}),
        ("cameras", {"colour": 3}),
    ],
)
def test_an_edited_configuration_is_seen(
    table: str, values: dict[str, Any], study: Path
) -> None:
    edit_record(study, lambda record: record["study"][table].update(values))
    with pytest.raises(MiSplatError, match=r"expected .* got .*;"):
        checks(study)


def test_figures_have_tolerances() -> None:
    half = Rate(successes=1, total=2)
    assert agree(half, Rate(successes=1, total=2))
    assert not agree(half, Rate(successes=1, total=3))
    assert not agree(half, Rate(successes=1, total=2, resampled=(0.1, 0.9)))
    assert not agree(half, Number(value=0.5))
    assert agree(Number(value=0.5), Number(value=0.5 + 1e-7))
    assert not agree(Number(value=0.5), Number(value=0.51))
    assert not agree(Number(value=0.5), Number(value=0.5, least=0.5))


def test_an_interval_a_median_and_a_number_of_no_rows_are_seen(study: Path) -> None:
    width = key_of({MEASURE: "transition_degrees"})

    def change(figures: dict[Any, Any]) -> None:
        for key, figure in figures.items():
            if isinstance(figure, Rate):
                figures[key] = replace(figure, resampled=(0.99, 1.0))
        figures[width] = Number(value=figures[width].value + 0.1)
        figures[MADE_UP] = Number(value=40.0)

    wide = sum(
        figure.interval[0] < 0.98
        for _, figure in read_figures(study)
        if isinstance(figure, Rate)
    )
    edit_figures(study, change)
    found = red(study)
    assert len(found) >= wide + 2
    assert {"transition_degrees", "made_up"} <= set(found)


def test_a_copy_has_the_same_name_and_says_what_was_left_out(
    attacked: Path, tmp_path: Path
) -> None:
    derive = kind_of(read_result(attacked)).derive
    copy = pack(attacked, tmp_path / "copy", derive)
    assert copy.manifest == read_manifest(attacked)
    assert {path.name for path in copy.folder.iterdir()} == {
        RECORD,
        MANIFEST,
        "cameras.json",
        "figures.csv",
        "rows.csv.xz",
        "detections.csv.xz",
    }
    assert {line.name for line in checks(copy.folder) if line.passed is None} > {
        "attacked.ply",
        "before.png",
    }
    assert red(copy.folder, manifest=read_manifest(attacked).sha256) == []
    whole = pack(attacked, tmp_path / "whole", derive, whole=True)
    assert not [line for line in checks(whole.folder)[1:] if line.passed is None]
    with pytest.raises(MiSplatError, match="replace this result with force"):
        pack(attacked, copy.folder, derive)


def test_the_commands(
    attacked: Path, attack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    name = read_manifest(attacked).sha256

    def told(*words: str | Path, status: int = 0) -> str:
        assert cli.main(list(map(str, words))) == status
        captured = capsys.readouterr()
        return captured.out + captured.err

    printed = told("artifact", attacked, "--out", out)
    assert "figures that follow from them" in printed
    assert (
        printed.splitlines()[-1] == f"mi-splat artifact-check {out} --manifest {name}"
    )
    assert "(--force)" in told("artifact", attacked, "--out", out, status=1)
    assert (
        json.loads(told("artifact", attacked, "--out", out, "--force", "--json"))[
            "manifest"
        ]
        == name
    )
    lines = told("artifact-check", out, "--manifest", name).splitlines()
    assert {line[:5].strip() for line in lines[:-1]} == {"green", "grey"}
    assert lines[-1] == f"{out}: 0 of {len(lines) - 1} lines are red."
    told("artifact-check", out, "--manifest", "0" * 64, status=1)
    (attack / RECORD).write_text("{")
    document = json.loads(told("artifact-check", attack, out, "--json", status=1))
    assert [line["colour"] for line in document[str(attack)]] == ["red"]
    assert "red" not in {line["colour"] for line in document[str(out)]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected folders of results, got none"),
        (
            ["{it}", "--manifest", "a", "b"],
            "--manifest: expected one for each of the 1 folders, got 2",
        ),
    ],
)
def test_flags_that_would_mean_nothing_are_refused(
    words: list[str], message: str, attacked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        cli.main(["artifact-check", *(word.format(it=attacked) for word in words)]) == 2
    )
    assert message in capsys.readouterr().err
