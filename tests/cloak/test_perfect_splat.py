"""What detectors report in path-traced pictures of what a study's attacks want to show."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from attacks import cli
from attacks.cloak import setup
from attacks.cloak.config import AttackConfig
from attacks.cloak.path_traced import measure_perfect_splat
from mi_splat.errors import InvalidValueError
from tests.cloak.tiny_study import STUDY, Redness, steps_of

# A red car, which the detector finds by its colour; it does so where the car has a red sign on it, too.
HIDING = replace(STUDY.attack[0], reach=2)
PAINTING = AttackConfig(name="red", appearance="paint", texture="stop_sign", elevation=(38.2, 90), reach=2)


def test_the_rates_are_those_of_the_appearance(tmp_path: Path) -> None:
    """A car that is gone is missed from everywhere; one that is painted red is found as often as it was, or more."""
    gone, painted = (
        measure_perfect_splat(steps_of(tmp_path, replace(STUDY, attack=(attack,))), [Redness()])[0]
        for attack in (HIDING, PAINTING)
    )
    study = replace(STUDY, attack=(HIDING,))
    inside = [
        camera
        for camera in setup.held_out_cameras(study, setup.target_of(study.scene))
        if HIDING.cone.angle_to_edge(camera, centre=setup.centre_of(study)) >= 0
    ]
    assert gone["cameras"] == gone["control_recall"]["total"] == len(inside) > 2
    assert gone["trigger_miss_rate"]["total"] > 0
    assert gone["trigger_miss_rate"]["rate"] == gone["nothing_reported"]["rate"] == 1.0
    assert painted["control_recall"] == gone["control_recall"]
    assert painted["trigger_miss_rate"]["rate"] < 1.0
    assert "target_rate" not in gone


def test_an_attack_with_a_target_class_has_the_rate_of_that_class(tmp_path: Path) -> None:
    found = measure_perfect_splat(steps_of(tmp_path), [Redness()], every=2)
    assert [row["attack"] for row in found] == ["overhead", "rear"]
    assert found[1]["target_rate"]["total"] == found[1]["cameras"] > 0
    assert found[1]["target_rate"]["successes"] == 0  # the detector calls everything a car
    assert "trigger_miss_rate" not in found[1]


def test_what_cannot_be_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InvalidValueError, match="every: expected a positive number"):
        measure_perfect_splat(steps_of(tmp_path), [], every=0)
    few = replace(STUDY, evaluation=replace(STUDY.evaluation, cameras=1))
    with pytest.raises(InvalidValueError, match="held-out cameras in the trigger"):
        measure_perfect_splat(steps_of(tmp_path, few), [])
    path = tmp_path / "small.toml"
    path.write_text("name = 'small'\n[cameras]\ntrain = 60\n[[attack]]\nname = 'a'\nelevation = [50, 90]\n")
    assert cli.main(["cloak-experiment", "perfect-splat", str(path), "--detectors", "yolov8n_small"]) == 1
    assert "--stages: expected a folder" in capsys.readouterr().err


def test_the_command_keeps_its_pictures(tmp_path: Path) -> None:
    path, out, stages = tmp_path / "small.toml", tmp_path / "perfect.json", tmp_path / "stages"
    path.write_text(
        "name = 'small'\n[cameras]\ntrain = 12\nsize = 64\nsamples = 1\npoints = 100\n"
        "[[attack]]\nname = 'a'\nelevation = [50, 90]\nreach = 2\n[evaluation]\ncameras = 8\n"
    )
    words = ["cloak-experiment", "perfect-splat", str(path), "--detectors", "yolov8n_small"]
    assert cli.main([*words, "--every", "1", "--stages", str(stages), "--out", str(out)]) == 0
    document = json.loads(out.read_text())
    assert document["settings"] == {"every": 1, "detectors": ["yolov8n_small"], "stages": str(stages)}
    assert set(document["detectors"]) == {"yolov8n_small"}
    (row,) = document["found"]
    assert row["cameras"] == row["control_recall"]["total"] == sum(1 for _ in stages.glob("jobs/*/*/files/*.png")) / 2
