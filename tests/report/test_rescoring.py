"""Scoring again needs the splats, cameras.json and a detector."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from attacks import cli
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import write_report
from attacks.objectives import Objective, hide, relabel, untargeted
from attacks.report.checking import Check, read_result
from attacks.report.rescoring import rescore
from attacks.report.results import story_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.manifest import write_manifest
from mi_splat.rendering import Renderer, RenderSettings
from tests.fakes import CoarseDetector, ColourDetector, camera, toy_scene
from tests.project.documented_commands import ROOT


def result_of(folder: Path, objective: Objective, detectors: Sequence[ColourDetector] = (ColourDetector(),)) -> Path:
    scene, mask = toy_scene()
    render = Renderer(RenderSettings(near=0.3, background=(0.1, 0.1, 0.12)))
    cameras = [camera(offset=0.4 * i) for i in range(2)]
    config = DaggerConfig(eps=(12.0,), noise_draws=1, required_views=0.5)
    write_report(attack(scene, mask, cameras, detectors, objective, render=render, config=config), folder)
    return folder


def scored(folder: Path, *detectors: ColourDetector) -> list[Check]:
    result = read_result(folder)
    return rescore(result, story_of(result).rescoring, detectors)


@pytest.mark.parametrize("objective", [relabel("person"), hide(), untargeted()], ids=lambda one: str(one.name))
def test_an_attack_is_scored_again(objective: Objective, tmp_path: Path, variant: str) -> None:
    folder = result_of(tmp_path / "result", objective, [ColourDetector(), CoarseDetector()])
    lines = scored(folder, ColourDetector(), CoarseDetector())
    assert [line.colour for line in lines] == ["green"] * 4
    assert all("moved by 0.0%" in line.words for line in lines)


@pytest.mark.parametrize(
    ("key", "value"),
    [("cameras", []), ("cameras", [{}]), ("near", "x"), ("near", -1), ("background", [1]), ("background", None)],
)
def test_broken_cameras_are_refused(key: str, value: object, attacked: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(attacked, tmp_path / "copy"))
    path = folder / "cameras.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    write_manifest(folder)
    with pytest.raises(InvalidValueError, match=r"cameras\.json: expected .* get the result again"):
        scored(folder, ColourDetector())


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    return result_of(tmp_path_factory.mktemp("attacked") / "result", relabel("person"))


def test_the_command_scores_again(
    attacked: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Blind(ColourDetector):
        min_confidence = 2.0

    monkeypatch.setattr("attacks.cli.names.load_detectors", lambda names, weights: [ColourDetector()])
    assert cli.main(["artifact-check", str(attacked), "--rescore"]) == 0
    assert "moved by 0.0%, may move by 2.0%" in capsys.readouterr().out
    monkeypatch.setattr("attacks.cli.names.load_detectors", lambda names, weights: [Blind()])
    assert cli.main(["artifact-check", str(attacked), "--rescore"]) == 1


def test_a_study_of_many_attacks_is_not_scored_again() -> None:
    with pytest.raises(InvalidValueError, match="score one of its attacks again"):
        scored(ROOT / "docs" / "artifacts" / "dagger_eot_pairs", ColourDetector())
