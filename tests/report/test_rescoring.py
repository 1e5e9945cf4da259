"""Scoring again needs the splats, cameras.json and a detector."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from attacks import cli
from attacks.cloak.rates import measures
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import write_report
from attacks.objectives import Objective, hide, objective, relabel, untargeted
from attacks.observe.rates import Confidence, Measures
from attacks.observe.rows import rows
from attacks.report.checking import Check, read_result, rescore
from attacks.report.kinds.cloak import study_of
from attacks.report.kinds.detectors import threshold_charts
from attacks.report.results import kind_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.folders import write_manifest
from mi_splat.rendering import Renderer, RenderSettings
from tests.fakes import CoarseDetector, ColourDetector, camera, toy_scene
from tests.project.layers import ROOT


def result_of(folder: Path, objective: Objective, detectors: Sequence[ColourDetector] = (ColourDetector(),)) -> Path:
    scene, mask = toy_scene()
    render = Renderer(RenderSettings(near=0.3, background=(0.1, 0.1, 0.12)))
    cameras = [camera(offset=0.4 * i) for i in range(2)]
    config = DaggerConfig(eps=(12.0,), noise_draws=1, required_views=0.5)
    write_report(attack(scene, mask, cameras, detectors, objective, render=render, config=config), folder)
    return folder


def scored(folder: Path, *detectors: ColourDetector) -> list[Check]:
    result = read_result(folder)
    return rescore(result, kind_of(result).rescoring, detectors)


@pytest.mark.parametrize("aim", [relabel("person"), hide(), untargeted()], ids=lambda one: str(one.name))
def test_an_attack_is_scored_again(aim: Objective, tmp_path: Path, variant: str) -> None:
    folder = result_of(tmp_path / "result", aim, [ColourDetector(), CoarseDetector()])
    lines = scored(folder, ColourDetector(), CoarseDetector())
    assert [line.colour for line in lines] == ["green"] * 4
    assert all("moved by 0.0%" in line.words for line in lines)


def test_what_cannot_be_scored_again(tmp_path: Path, variant: str) -> None:
    own = objective(lambda candidates, target: candidates.scores.sum(), lambda detections, target: True, name="own")
    with pytest.raises(InvalidValueError, match="objective own: expected one that is known by its name, got functions"):
        scored(result_of(tmp_path / "result", own), ColourDetector())
    with pytest.raises(InvalidValueError, match="score one of its attacks again"):
        scored(ROOT / "docs" / "artifacts" / "dagger_eot_pairs", ColourDetector())


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

    monkeypatch.setattr("attacks.cli.options.load_detectors", lambda *_: [ColourDetector()])
    assert cli.main(["artifact-check", str(attacked), "--rescore"]) == 0
    assert "moved by 0.0%, may move by 2.0%" in capsys.readouterr().out
    monkeypatch.setattr("attacks.cli.options.load_detectors", lambda *_: [Blind()])
    assert cli.main(["artifact-check", str(attacked), "--rescore"]) == 1


# More than one threshold: rates over the confidence from which a detection counts, of rows that are there


SECTOR = ROOT / "docs" / "artifacts" / "cloak_car_sector_layers"


def cloak(confidence: Confidence) -> Measures:
    study = study_of(json.loads((SECTOR / "result.json").read_text())["study"])
    return measures(study, confidence=confidence)


def test_the_sector_is_missed_less_by_a_lower_confidence() -> None:
    charts, (table,) = threshold_charts(rows(SECTOR), cloak, {"trigger_miss_rate": ("missed", "attack")})
    assert [chart.title.split(",")[0] for chart in charts][:2] == ["fasterrcnn_small", "yolov8n_small"]
    (line,) = charts[1].lines
    heights = {point.x: point.y for point in line.points}
    assert 0 < heights[0.2] < heights[0.5]
    assert all(point.low is not None and point.low <= point.y <= (point.high or 0) for point in line.points)
    assert table.head == ("detector", "rate", "from 0.5", "from 0.25")
    assert [row[:2] for row in table.rows][:2] == [("fasterrcnn_small", "missed"), ("yolov8n_small", "missed")]
    assert threshold_charts(rows(SECTOR), cloak, {"target_rate": ("reported", "attack")}) == ((), ())
    assert threshold_charts(None, cloak, {"trigger_miss_rate": ("missed", "attack")}) == ((), ())
