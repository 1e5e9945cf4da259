"""Whoever edits, cuts or breaks an artifact is found out, and told in words."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.artifacts.checking import Checked, check_artifact, check_pages
from attacks.artifacts.figures import Figure, compared, flat
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import sha256
from tests.artifacts.conftest import PAGE


def red(checked: Checked) -> list[str]:
    return [line.name for line in (*checked.files, *checked.figures) if line.passed is False]


def edit_record(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    values = json.loads((folder / "artifact.json").read_text())
    change(values)
    (folder / "artifact.json").write_text(json.dumps(values))


def edit_rows(folder: Path, change: Callable[[list[dict[str, str]]], Any], name: str = "rows") -> None:
    """Edit a table, and hide it from the hashes."""
    path = folder / f"{name}.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    head = list(rows[0])
    change(rows)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, head, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    entry = {"sha256": sha256(path), "bytes": path.stat().st_size}
    edit_record(folder, lambda values: values["files"].update({path.name: entry}))


def test_an_artifact_as_it_was_packed_is_green(packed: Path) -> None:
    assert red(check_artifact(packed)) == []


def test_other_bytes_are_seen(artifact: Path) -> None:
    path = artifact / "rows.csv"
    first, second = path.read_text().splitlines()[1:3]
    path.write_text(path.read_text().replace(f"{first}\n{second}\n", f"{second}\n{first}\n"))
    assert red(check_artifact(artifact)) == ["rows.csv"]  # the order has no part in the figures
    (artifact / "study.toml").unlink()
    (artifact / "splats" / "more.ply").write_text("")
    assert red(check_artifact(artifact)) == ["rows.csv", "study.toml", "splats/more.ply"]


def test_a_link_counts_as_missing(artifact: Path, packed: Path) -> None:
    (artifact / "study.toml").unlink()
    (artifact / "study.toml").symlink_to(packed / "study.toml")
    assert red(check_artifact(artifact)) == ["study.toml"]


def test_an_edited_row_moves_figures(artifact: Path) -> None:
    def lower(rows: list[dict[str, str]]) -> None:
        seen = (row for row in rows if row["splat"] == "clean" and float(row["score: car"]) > 0.5)
        next(row for row in seen if float(row["depth: overhead"]) > 0)["score: car"] = "0.1"

    edit_rows(artifact, lower)
    found = red(check_artifact(artifact))
    assert "by_detector/redness/control_recall" in found
    assert "rows.csv" not in found


def test_edited_comparisons_move_figures(artifact: Path) -> None:
    edit_rows(artifact, lambda rows: rows[0].update(psnr="31.5"), "fidelity")
    edit_rows(artifact, lambda rows: rows[-2].update(fraction="0.4"), "transition")
    found = red(check_artifact(artifact))
    assert {"benign_psnr/clean", "benign_psnr_drop", "transition_degrees"} <= set(found)


def test_edited_detections_move_rates(artifact: Path) -> None:
    edit_rows(artifact, lambda rows: [row.update(score="0.01") for row in rows], "detections")
    assert red(check_artifact(artifact)) == ["detections of redness"]


def test_a_figure_that_is_off_is_seen(artifact: Path) -> None:
    def change(values: dict[str, Any]) -> None:
        figures = {one["name"]: one for one in values["figures"]}
        figures["gaussians/clean/0"]["value"] += 1
        figures["benign_psnr/clean"]["value"] += 1e-5
        figures["benign_psnr/cloaked"]["value"] += 1e-7
        figures["stealth/stealthy"]["value"] = not figures["stealth/stealthy"]["value"]
        values["figures"] = [one for one in values["figures"] if one["name"] != "gaussians_ratio"]
        values["figures"].append({"name": "made up", "value": 1, "tolerance": 0})

    edit_record(artifact, change)
    expected = {"gaussians/clean/0", "benign_psnr/clean", "stealth/stealthy", "gaussians_ratio", "made up"}
    assert set(red(check_artifact(artifact))) == expected


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows.pop(), "one row for each detector and camera, got none for redness, view"),
        (lambda rows: rows.append(rows[0]), "one row for each detector and camera, got others, or one twice"),
        (lambda rows: rows[0].update(seed="7"), "table rows: expected rows of the study's splats, got others"),
        (lambda rows: rows[0].update(elevation="inf"), "expected a finite number, got 'inf' in column elevation"),
    ],
)
def test_rows_that_are_not_the_study_s_are_refused(
    change: Callable[[list[dict[str, str]]], Any], said: str, artifact: Path
) -> None:
    edit_rows(artifact, change)
    with pytest.raises(InvalidValueError, match="again") as error:
        check_artifact(artifact)
    assert said in str(error.value)


def test_a_missing_table_is_refused(artifact: Path) -> None:
    edit_record(artifact, lambda values: values["files"].pop("rows.csv"))
    with pytest.raises(InvalidValueError, match=r"expected a table rows\.csv, got none"):
        check_artifact(artifact)


@pytest.mark.parametrize(
    "name", ["../../outside.csv", "/etc/passwd", "splats/../../x", ".hidden", "a/b.csv", "C:\\x", ""]
)
def test_files_outside_of_the_artifact_are_not_touched(name: str, artifact: Path) -> None:
    entry = {"sha256": "0", "bytes": 1}
    edit_record(artifact, lambda values: values["files"].update({name: entry}))
    with pytest.raises(InvalidValueError, match="expected names of files in the artifact"):
        check_artifact(artifact)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "Expecting value"),
        ("[]", "got a list"),
        ("{", "Expecting property name"),
        ("[" * 100_000, "at most 64 levels"),
        ('{"artifact": 2}', "expected an artifact of format 1, got 2; read it with the version"),
        ('{"artifact": 1, "x": NaN}', "x: expected a finite number, got nan"),
        ('{"artifact": 1, "x": 1e999}', "x: expected a finite number, got inf"),
        ('{"artifact": 1}', "expected pages, a list, got None"),
    ],
    ids=str,
)
def test_a_broken_record_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "artifact.json").write_text(text)
    with pytest.raises(InvalidValueError, match="; ") as error:
        check_artifact(tmp_path)
    assert said in str(error.value)


@pytest.mark.parametrize("value", [None, "x", [[]], {"x": 1}])
def test_no_record_ends_in_anything_but_an_error_in_words(value: object, packed: Path, tmp_path: Path) -> None:
    """Whatever stands under a key, a check tells lines or raises the project's error."""
    record = json.loads((packed / "artifact.json").read_text())
    for path in packed.glob("*.csv"):
        (tmp_path / path.name).symlink_to(path)
    for key in record:
        (tmp_path / "artifact.json").write_text(json.dumps({**record, key: value}))
        try:
            checked = check_artifact(tmp_path)
        except InvalidValueError:
            continue
        check_pages(checked, tmp_path)
        assert not checked.passed  # its files are links, and some are missing


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("scene", "object"), ["car"]),
        (("scene",), 3),
        (("attack",), []),
        (("evaluation", "confidence"), "high"),
        (("evaluation", "detectors"), ["another"]),
        (("seeds",), [0, 1]),
        (("name",), None),
    ],
    ids=str,
)
def test_an_edited_configuration_is_seen(place: tuple[str, ...], value: object, artifact: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        table = record["configuration"]
        for key in place[:-1]:
            table = table[key]
        table[place[-1]] = value

    edit_record(artifact, change)
    with pytest.raises(InvalidValueError, match=r"expected .* got .*;"):
        check_artifact(artifact)


def test_a_mesh_file_has_no_part_in_a_rate(artifact: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["configuration"]["scene"].update(object="truck.glb", label="car", front="+x")

    edit_record(artifact, change)
    assert red(check_artifact(artifact)) == []


@pytest.mark.parametrize(
    "entry", [{}, {"name": "a", "value": 1, "tolerance": 0.5}, {"name": "a", "value": [1], "tolerance": 0}, 7]
)
def test_figures_that_are_none_are_refused(entry: object, artifact: Path) -> None:
    edit_record(artifact, lambda values: values["figures"].append(entry))
    with pytest.raises(InvalidValueError, match="get the artifact again"):
        check_artifact(artifact)


def test_figures_have_names_and_tolerances() -> None:
    rate = {"rate": 0.5, "successes": 1, "total": 2, "interval": [0.1, 0.9]}
    bands = [{"from": 0.0, "to": 5.0, "clean": rate}, {"from": 5.0, "to": 10.0, **rate}]
    found = list(flat({"rate": rate, "bands": bands, "widths": [1.5, None], "words": {"a": "b"}}))
    assert found == [
        Figure(name="rate", value=(1, 2)),
        Figure(name="bands/0 to 5/clean", value=(1, 2)),
        Figure(name="bands/5 to 10", value=(1, 2)),
        Figure(name="widths/0", value=1.5, tolerance=1e-6),
        Figure(name="widths/1", value=None),
        Figure(name="words/a", value="b"),
    ]
    assert all(line.passed for line in compared(found, found))
    assert compared([Figure(name="a", value=True)], [Figure(name="a", value=1)])[0].colour == "red"


def test_a_page_shows_these_figures_or_is_red(artifact: Path, tmp_path: Path) -> None:
    from attacks.artifacts.cloak import page

    checked, path = check_artifact(artifact), tmp_path / PAGE
    assert [line.words for line in check_pages(checked, tmp_path)] == ["no such page"]
    path.parent.mkdir()
    table = page(checked.derived, checked.contents)
    fraction = next(one for one in table.split() if "/" in one)
    total = fraction.split("/")[1]
    for text, passed in (
        (f"# Page\n\n{table}\nmore", True),
        (f"found in {fraction}, or in 5 of 6; see a/b, 1/2.5 and docs/3/4", True),
        (f"found in {fraction} and 999/{total}", False),
        ("no figures at all", False),
    ):
        path.write_text(text)
        assert [line.passed for line in check_pages(checked, tmp_path)] == [passed], text


def test_the_command_tells_each_line(artifact: Path, packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["artifact-check", str(packed)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert all(line.startswith("green  ") for line in said[:-1])
    assert said[-1] == f"{packed}: 0 of {len(said) - 1} lines are red."
    (artifact / "artifact.json").write_text("{")
    assert cli.main(["artifact-check", str(artifact), str(packed), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [line["colour"] for line in found[str(artifact)]] == ["red"]
    assert {line["colour"] for line in found[str(packed)]} == {"green"}


def test_the_command_packs(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli.main(["artifact", str(result), "--out", str(out), "--page", PAGE, "docs/other.md"]) == 0
    assert "figures that follow from them" in capsys.readouterr().out
    assert cli.main(["artifact", str(result), "--out", str(out)]) == 1
    assert "(--force)" in capsys.readouterr().err
    assert cli.main(["artifact", str(result), "--out", str(out), "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "cloak"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["artifact", "{result}", "--weights", "a.pt"], "--weights: expected --detections beside it"),
        (["artifact-check", "{packed}", "--splats", "."], "--splats: expected --rescore beside it"),
        (["artifact-check"], "expected folders of artifacts, got none"),
        (["artifact-check", "{packed}", "--every", "2"], "--every: expected --rescore beside it"),
        (
            ["artifact-check", "{packed}", "--detectors", "fasterrcnn_small"],
            "--detectors: expected --rescore beside it",
        ),
    ],
)
def test_flags_that_would_mean_nothing_are_refused(
    words: list[str], said: str, result: Path, packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [word.format(result=result, packed=packed) for word in words]
    out = ["--out", str(tmp_path / "out")] if words[0] == "artifact" else []
    assert cli.main([*given, *out]) == 2
    assert said in capsys.readouterr().err
