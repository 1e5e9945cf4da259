"""Studies of many attacks become artifacts: every rate again of the rows, and their tables word for word."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.artifacts.checking import check_artifact, check_pages
from attacks.artifacts.kinds import KINDS, kind_of
from attacks.artifacts.packing import pack_artifact
from attacks.artifacts.rescoring import rescore
from attacks.artifacts.studies.settings import configuration_of, settings_of
from attacks.dagger.jobs import AttackScene, JobRunner
from attacks.dagger.pairs import ledger, run_pairs, write_summary
from attacks.dagger.study import OBJECTS
from attacks.dagger.transfer.tables import write_held_out
from attacks.detectors.base import Candidates
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json
from tests.artifacts.test_checking import edit_record, edit_rows, red
from tests.fakes import ColourDetector, blobs, camera, toy_scene
from tests.report.makers import write_eot_study, write_study, write_transfer

PAGE = "docs/page.md"


class AllClasses(ColourDetector):
    """Knows every target of the six pairs; what the other one does not know it never reports."""

    classes = ("car", "person", "stop sign", "elephant", "tv", "train", "bird")

    def candidates(self, images: Tensor) -> list[Candidates]:
        found = []
        for one in super().candidates(images):
            boxes, scores = one.boxes[:, :1].expand(-1, 4, -1), 0.01 * one.scores[:, 1:2].expand(-1, 4)
            found.append(Candidates(torch.cat([one.boxes, boxes], 1), torch.cat([one.scores, scores], 1)))
        return found


def write_pairs(folder: Path) -> Path:
    folder.mkdir()

    def read(name: str) -> AttackScene:
        objects = {part: slice(10, 40) for place, part in OBJECTS if place == name}
        return AttackScene(scene=toy_scene()[0], objects=objects, cameras=(camera(),), render=blobs)

    attack = ledger(JobRunner(read, AllClasses()), folder / "fake_colour")
    found = run_pairs({"fake_colour": attack}, eps=(12.0,), steps=2, seeds=(0,), radii=(0.5, 12.0))
    write_summary(found, folder)
    return folder


def write_views(folder: Path) -> Path:
    """What a look at splats of other studies leaves: made up, with one detector that has other weights by now."""
    (folder / "held_out").mkdir(parents=True)
    records = []
    for attack, mark in (("first", "0123456789"), ("second", "abcdef0123")):
        for detector in ("one", "two"):
            views = [
                {
                    kind: {"original_score": 0.9 - 0.3 * i, "target_score": score}
                    for kind, score in (("clean", 0.0), *later)
                }
                for i, later in enumerate([(("attacked", 0.8), ("noise", 0.1)), (("attacked", 0.2), ("noise", 0.6))])
            ]
            job = {"attack": attack, "sources": ["one"], "weights": [mark], "seed": 7, "views": 2}
            job |= {"splat": "0", "scene": "toy", "detector": detector}
            save_json({"job": job, "result": {"views": views}}, folder / "held_out" / f"{attack}-by-{detector}.json")
            name = "one" if attack == "first" else f"one, weights {mark[:6]}"
            records += [{"job": {"sources": [name]}, "judged": {detector: view}} for view in views]
    origin = {"study": "/home/someone/study", "weights": {"one": "0123456789", "two": "0"}, "versions": {"python": "3"}}
    write_held_out(records, folder, attacks=2, views=2, origin=origin)
    return folder


MAKERS: Mapping[str, tuple[Callable[[Path], Path], str]] = {
    "dagger-eot-study": (write_eot_study, "table.md"),
    "dagger-study": (write_study, "table.md"),
    "dagger-pairs": (write_pairs, "table.md"),
    "dagger-transfer": (write_transfer, "transfer.md"),
    "dagger-transfer --eot-study": (write_views, "held_out.md"),
}
"""By kind: a folder of results, and the file of its tables."""


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("studies")
    return {name: make(base / name.replace(" ", "")) for name, (make, _) in MAKERS.items()}


@pytest.fixture(scope="module")
def packed(studies: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("packed")
    for folder in studies.values():
        pack_artifact(folder, base / folder.name, pages=[PAGE])
    return {name: base / folder.name for name, folder in studies.items()}


def copied(folder: Path, to: Path) -> Path:
    """A copy of an artifact, for a test to break."""
    to.mkdir()
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


def test_every_kind_of_study_is_tried() -> None:
    assert set(MAKERS) == {name for name, kind in KINDS.items() if not kind.rescored}


@pytest.mark.parametrize("name", MAKERS)
def test_every_figure_follows_and_the_tables_stand_on_the_page(
    name: str, studies: dict[str, Path], packed: dict[str, Path], tmp_path: Path
) -> None:
    assert kind_of(studies[name]) == name
    checked = check_artifact(packed[name])
    assert red(checked) == []
    assert checked.figures
    (tmp_path / "docs").mkdir()
    page = (studies[name] / MAKERS[name][1]).read_text()
    (tmp_path / PAGE).write_text(page)
    (line,) = check_pages(checked, tmp_path)
    assert line.words == "holds the tables that the rows give, word for word"
    row = next(text for text in page.splitlines() if re.search(r"\| \d+/\d+", text))
    (tmp_path / PAGE).write_text(page.replace(row, re.sub(r"\| (\d+/\d+)", r"| 9\1", row, count=1)))
    (line,) = check_pages(checked, tmp_path)
    assert "word for word" not in line.words


@pytest.mark.parametrize("name", MAKERS)
def test_no_file_names_a_machine(name: str, packed: dict[str, Path]) -> None:
    assert "/home/" not in (packed[name] / "artifact.json").read_text()


@pytest.mark.parametrize(
    ("name", "change", "figure"),
    [
        ("dagger-eot-study", {"success": "true", "noise_success_0": "true"}, "noise_rate"),
        ("dagger-study", {"score": "0.001"}, "success"),
        ("dagger-pairs", {"score": "0.001"}, "success"),
        ("dagger-transfer", {"attacked_target": "0.0", "attacked_original": "0.0"}, "targeted"),
        ("dagger-transfer --eot-study", {"attacked_target": "0.0"}, "targeted"),
    ],
)
def test_other_rows_give_other_figures(
    name: str, change: dict[str, str], figure: str, packed: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(packed[name], tmp_path / "artifact")

    def edit(rows: list[dict[str, str]]) -> None:
        for row in rows:
            row.update({key: value for key, value in change.items() if row[key]})

    edit_rows(folder, edit)
    assert any(figure in line for line in red(check_artifact(folder)))


@pytest.mark.parametrize("name", MAKERS)
def test_a_study_is_not_scored_again(name: str, packed: dict[str, Path]) -> None:
    with pytest.raises(InvalidValueError, match="pack one of its attacks"):
        rescore(check_artifact(packed[name]), [ColourDetector()])


def test_what_is_missing_or_strange_is_told(studies: dict[str, Path], packed: dict[str, Path], tmp_path: Path) -> None:
    folder = copied(packed["dagger-study"], tmp_path / "strange")
    edit_rows(folder, lambda rows: rows[0].update(attack="unheard of"))
    with pytest.raises(InvalidValueError, match="unheard of"):
        check_artifact(folder)
    folder = copied(packed["dagger-study"], tmp_path / "bare")
    edit_record(folder, lambda values: values["configuration"].pop("attacks"))
    with pytest.raises(InvalidValueError, match="expected shared and attacks"):
        check_artifact(folder)
    (tmp_path / "empty").mkdir()
    save_json({"by_radius": []}, tmp_path / "empty" / "table.json")
    with pytest.raises(InvalidValueError, match="expected JSONs of attacks"):
        pack_artifact(tmp_path / "empty", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_table_of_other_attacks_is_not_packed(studies: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "study"
    (folder / "jobs").mkdir(parents=True)
    for path in (studies["dagger-study"] / "jobs").iterdir():
        (folder / "jobs" / path.name).write_bytes(path.read_bytes())
    table = json.loads((studies["dagger-study"] / "table.json").read_text())
    table["by_radius"][0]["successes"] += 1
    save_json(table, folder / "table.json")
    with pytest.raises(InvalidValueError, match="expected the figures that its rows give"):
        pack_artifact(folder, tmp_path / "out")


def test_what_attacks_share_is_kept_once() -> None:
    several = {
        "a": {"job": {"eps": [1.0], "seed": 0, "judged": None}, "same": {"x": 1}},
        "b": {"job": {"eps": [2.0], "seed": 0, "judged": {"jpeg": 40}}, "same": {"x": 1}},
    }
    made = configuration_of(several)
    assert made["shared"] == {"job": {"seed": 0}, "same": {"x": 1}}
    assert made["attacks"]["a"] == {"job": {"eps": [1.0], "judged": None}}
    assert settings_of(made) == several
    assert settings_of(configuration_of({"a": several["a"]})) == {"a": several["a"]}


def test_an_older_look_names_the_weights_of_the_detectors_attacked_alone(
    studies: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "older"
    (folder / "held_out").mkdir(parents=True)
    source = studies["dagger-transfer --eot-study"]
    for path in (source / "held_out").iterdir():
        (folder / "held_out" / path.name).write_bytes(path.read_bytes())
    found: dict[str, Any] = json.loads((source / "held_out.json").read_text())
    save_json({"cells": found["cells"]}, folder / "held_out.json")
    contents = pack_artifact(folder, tmp_path / "artifact")
    assert dict(contents.detectors) == {"one": "0123456789"}
    assert (dict(contents.versions), contents.commit) == ({}, None)
