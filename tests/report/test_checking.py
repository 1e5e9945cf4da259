"""Whoever edits, cuts or breaks a result is found out, and told in words."""

import csv
import json
import lzma
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.rate import Rate
from attacks.report.checking import (
    Check,
    agree,
    check_files,
    check_result,
    flat,
    pack,
    read_result,
)
from attacks.report.results import kind_of
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.folders import MANIFEST, RECORD, read_manifest, write_manifest
from tests.project.documented_commands import ROOT
from tests.report.results import write_dagger

pytestmark = pytest.mark.shipped

Rows = list[dict[str, str]]


def checks(folder: Path, *, manifest: str | None = None) -> list[Check]:
    result = read_result(folder)
    kind = kind_of(result)
    return check_result(result, kind.figures, kind.given, manifest=manifest)


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
        "success",
        "score",
        "rate",
        "noise/successes",
        "views/1/target_confidence",
        "rates/fake_colour/noise",
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
        read_result(attack)


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
        ("rows", turn, {"rate", "rates/fake_colour/success", "views/0/success"}),
        (
            "rows",
            lambda rows: [
                row.update(success="true") for row in rows if row["draw"] == "1"
            ],
            {"noise_rate"},
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


def test_a_figure_that_is_off_is_seen_and_not_packed(
    attack: Path, tmp_path: Path
) -> None:
    def change(record: dict[str, Any]) -> None:
        record["rate"]["successes"] -= 1
        record["target_confidence"] += 1e-5
        record["views"][0]["score"] += 1e-8
        del record["strict"]
        record["made_up"] = {"successes": 1, "total": 2}

    edit_record(attack, change)
    made_up = {"made_up", "made_up/interval/0", "made_up/interval/1"}
    assert set(red(attack)) == {"rate", "target_confidence", "strict", *made_up}
    kind = kind_of(read_result(attack))
    for words in (
        r"strict: result\.json has none, the rows give yes",
        r"before\.png: other bytes",
    ):
        with pytest.raises(InvalidValueError, match=words):
            pack(attack, tmp_path / "copy", kind.figures, kind.given)
        (attack / "before.png").write_bytes(b"other")
    assert not (tmp_path / "copy").exists()


RATES_THAT_ARE_NONE = [
    {"successes": 0.5, "total": 1},
    {"successes": 3, "total": 2},
    {"successes": -1, "total": 2},
]


@pytest.mark.parametrize("value", [None, 3, "x", [[]], {"x": 1}, *RATES_THAT_ARE_NONE])
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
        "by_detector/fasterrcnn_small/control_recall",
        "benign_psnr/clean",
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


def test_figures_have_names_and_tolerances() -> None:
    rate = {"rate": 0.5, "successes": 1, "total": 2, "interval": [0.1, 0.9]}
    bands = [{"from": 0.0, "to": 5.0, "clean": rate}, {"from": 5.0, "to": 10.0, **rate}]
    assert flat(
        {"rate": rate, "bands": bands, "widths": [1.5, None], "words": {"a": "b"}}
    ) == {
        "rate": (1, 2),
        "rate/rate": 0.5,
        "rate/interval/0": 0.1,
        "rate/interval/1": 0.9,
        "bands/0 to 5/clean": (1, 2),
        "bands/0 to 5/clean/rate": 0.5,
        "bands/0 to 5/clean/interval/0": 0.1,
        "bands/0 to 5/clean/interval/1": 0.9,
        "bands/5 to 10": (1, 2),
        "bands/5 to 10/rate": 0.5,
        "bands/5 to 10/interval/0": 0.1,
        "bands/5 to 10/interval/1": 0.9,
        "widths/0": 1.5,
        "widths/1": None,
        "words/a": "b",
    }
    assert agree(0.5, 0.5 + 1e-7)
    assert not agree(0.5, 0.51)
    assert not agree(3, 4)
    assert not agree(True, 1)


def rates_in(value: Any) -> Iterator[dict[str, Any]]:
    """Every rate in a record, to be edited."""
    if isinstance(value, dict) and "successes" in value:
        yield value
    elif isinstance(value, (dict, list)):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from rates_in(entry)


def test_an_interval_a_median_and_a_number_of_no_rows_are_seen(study: Path) -> None:
    before = json.loads((study / RECORD).read_text())

    def change(record: dict[str, Any]) -> None:
        for rate in rates_in(record):
            rate.update(interval=[0.99, 1.0])
        record["transition_degrees"] += 0.1
        record["stealth"]["made_up"] = 40.0

    edit_record(study, change)
    found = red(study)
    lower_ends = [name for name in found if name.endswith("/interval/0")]
    assert len(lower_ends) >= sum(
        Rate.of(rate).interval[0] < 0.98 for rate in rates_in(before)
    )
    assert {"transition_degrees", "stealth/made_up"} <= set(found)


def test_a_copy_has_the_same_name_and_says_what_was_left_out(
    attacked: Path, tmp_path: Path
) -> None:
    kind = kind_of(read_result(attacked))
    copy = pack(attacked, tmp_path / "copy", kind.figures, kind.given)
    assert copy.manifest == read_manifest(attacked)
    assert {path.name for path in copy.folder.iterdir()} == {
        *(RECORD, MANIFEST, "cameras.json", "rows.csv.xz", "detections.csv.xz")
    }
    assert {line.name for line in checks(copy.folder) if line.passed is None} > {
        "attacked.ply",
        "before.png",
    }
    assert red(copy.folder, manifest=read_manifest(attacked).sha256) == []
    whole = pack(attacked, tmp_path / "whole", kind.figures, kind.given, whole=True)
    assert not [line for line in checks(whole.folder)[1:] if line.passed is None]
    with pytest.raises(MiSplatError, match="replace this result with force"):
        pack(attacked, copy.folder, kind.figures, kind.given)


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
