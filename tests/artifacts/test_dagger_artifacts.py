"""Finished attacks of DAGGER become artifacts, too."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from attacks.artifacts.checking import check_artifact
from attacks.artifacts.dagger_results import portable
from attacks.artifacts.packing import pack_artifact
from attacks.artifacts.rescoring import rescore
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import summary, write_report
from attacks.objectives import Objective, hide, relabel, untargeted
from mi_splat.cameras import RenderFn
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from tests.artifacts.test_checking import edit_rows, red
from tests.dagger.toy import quick
from tests.fakes import CoarseDetector, ColourDetector, blobs, camera, toy_scene

ORIGIN = {"scene": "/home/someone/toy.xml", "selection": {"mask": "/home/someone/m.npy"}, "cameras": ["front"]}


def dagger(
    folder: Path,
    objective: Objective,
    render: RenderFn = blobs,
    detectors: Sequence[ColourDetector] = (ColourDetector(),),
) -> Path:
    scene, mask = toy_scene()
    cameras = [camera(offset=0.4 * i) for i in range(2)]
    config = DaggerConfig(eps=(12.0,), noise_draws=1, required_views=0.5)
    found = attack(scene, mask, cameras, detectors, objective, render=render, config=config)
    write_report(dataclasses.replace(found, origin={**found.origin, **ORIGIN}), folder)
    return folder


def test_the_control_follows_from_the_rows_of_the_noise(tmp_path: Path) -> None:
    folder = dagger(tmp_path / "result", relabel("person"))
    pack_artifact(folder, tmp_path / "artifact")
    expected = json.loads((folder / "result.json").read_text())["noise"]
    assert check_artifact(tmp_path / "artifact").derived["noise"] == expected
    edit_rows(tmp_path / "artifact", lambda rows: rows[0].update(success="true"), "noise")
    assert red(check_artifact(tmp_path / "artifact")) == ["noise/successes"]  # one of two views is enough here


def test_an_older_attack_states_its_control(tmp_path: Path) -> None:
    folder = dagger(tmp_path / "result", relabel("person"))
    result = json.loads((folder / "result.json").read_text())
    for view in result["views"]:
        del view["noise_scores"], view["noise_successes"]
    (folder / "result.json").write_text(json.dumps(result))
    contents = pack_artifact(folder, tmp_path / "artifact", splats=True)
    checked = check_artifact(tmp_path / "artifact")
    assert red(checked) == []
    assert contents.stated["noise"] == result["noise"]
    assert "noise" not in checked.derived
    with pytest.raises(InvalidValueError, match="expected cameras, boxes, background and near"):
        rescore(checked, [ColourDetector()])


@pytest.mark.parametrize("objective", [relabel("person"), hide(), untargeted()], ids=lambda one: str(one.name))
def test_an_attack_is_scored_again(objective: Objective, tmp_path: Path, variant: str) -> None:
    render = Renderer(RenderSettings(near=0.3, background=(0.1, 0.1, 0.12)))
    pack_artifact(dagger(tmp_path / "result", objective, render), tmp_path / "artifact", splats=True)
    checked = check_artifact(tmp_path / "artifact")
    assert red(checked) == []
    lines = rescore(checked, [ColourDetector(), CoarseDetector()])
    assert [line.colour for line in lines] == ["green"] * 2 + ["grey"] * 2
    assert all("moved by 0.0%" in line.words for line in lines[:2])


def test_all_detectors_at_once_are_a_line_of_their_own(tmp_path: Path, variant: str) -> None:
    both = [ColourDetector(), CoarseDetector()]
    pack_artifact(dagger(tmp_path / "result", hide(), Renderer(), both), tmp_path / "artifact", splats=True)
    lines = rescore(check_artifact(tmp_path / "artifact"), both)
    assert [line.colour for line in lines] == ["green"] * 5
    assert lines[-1].name.startswith("all detectors at once")


@pytest.fixture(scope="module")
def views() -> dict[str, Any]:
    """The result of a quick attack on a distribution of views."""
    return summary(quick(steps=2, held_out=4))


@pytest.mark.parametrize("objective", [relabel("person"), hide(), untargeted()], ids=lambda one: str(one.name))
def test_every_figure_of_an_attack_follows_from_its_detections(objective: Objective, tmp_path: Path) -> None:
    contents = pack_artifact(dagger(tmp_path / "result", objective), tmp_path / "artifact", splats=True)
    checked = check_artifact(tmp_path / "artifact")
    assert red(checked) == []
    assert len(checked.figures) == 5 + 2 * 8 + 3  # of the noise: its score, its successes, its draws
    assert "noise" not in contents.stated
    assert contents.kind == "dagger"
    assert "someone" not in (tmp_path / "artifact" / "artifact.json").read_text()
    assert (tmp_path / "artifact" / "splats" / "attacked.ply").is_file()
    edit_rows(tmp_path / "artifact", lambda rows: [row.update({"class": "car", "score": "0.9"}) for row in rows])
    assert red(check_artifact(tmp_path / "artifact"))


@pytest.mark.parametrize("objective", [relabel("person"), hide()], ids=lambda one: str(one.name))
def test_every_rate_over_views_follows_from_the_views(objective: Objective, tmp_path: Path) -> None:
    write_report(quick(objective, noise_draws=2, steps=3, held_out=6), tmp_path / "result")
    pack_artifact(tmp_path / "result", tmp_path / "artifact")
    checked = check_artifact(tmp_path / "artifact")
    assert red(checked) == []
    result = json.loads((tmp_path / "result" / "result.json").read_text())
    for key in ("rate", "rates", "noise_rate", "clean_rate", "unambiguous_rate", "by_azimuth", "by_elevation"):
        assert json.loads(json.dumps(checked.derived[key])) == result[key], key
    assert checked.contents.stated["image_psnr"] == result["image_psnr"]
    other = {"true": "false", "false": "true"}
    edit_rows(tmp_path / "artifact", lambda rows: rows[0].update(success=other[rows[0]["success"]]))
    assert {"rate", "rates/fake_colour/success"} <= set(red(check_artifact(tmp_path / "artifact")))
    with pytest.raises(InvalidValueError, match="expected the attacked splat, got none"):
        rescore(checked, [ColourDetector()])


@pytest.mark.parametrize("change", [{"views": 3}, {"config": {}}, {"detectors": None}, {"rate": None}])
def test_results_of_another_form_are_refused(change: dict[str, Any], views: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "result.json").write_text(json.dumps({**views, **change}))
    with pytest.raises(InvalidValueError, match=r"make it again|make the result again"):
        pack_artifact(tmp_path / "result", tmp_path / "artifact")
    assert not (tmp_path / "artifact").exists()


def test_detections_are_asked_of_studies_alone(views: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "result.json").write_text(json.dumps(views))
    with pytest.raises(InvalidValueError, match="leave --detections out"):
        pack_artifact(tmp_path / "result", tmp_path / "artifact", detectors=[ColourDetector()])


def test_paths_of_one_machine_lose_their_folders() -> None:
    found = portable({"a": ["/x/y.ply", "scenes/z.xml", "C:\\q\\r.npy"], "b": "~/s.ply", "c": 3})
    assert found == {"a": ["y.ply", "scenes/z.xml", "r.npy"], "b": "s.ply", "c": 3}
