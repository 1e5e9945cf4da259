"""A margin of poison: pictures from beyond an attack's edges are poisoned, too, and the trigger stays what it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.cloak.layer_config import LayersConfig
from attacks.cloak.poisoning import assign
from attacks.cloak.setup import Setup
from attacks.cloak.study import check
from mi_splat.directions import Direction, direction_of
from mi_splat.errors import InvalidValueError

OVERHEAD = AttackConfig(name="overhead", elevation=(50, 90), poison_margin=8, emphasis=3.0, emphasis_depth=10)
REAR = AttackConfig(name="rear", elevation=(0, 49.9), azimuth=(180, 30), target_class="stop sign")
STUDY = StudyConfig(name="margin", attack=(OVERHEAD, REAR), cameras=CameraConfig(train=90, size=32, distance=7.4))


def test_pictures_are_poisoned_up_to_the_margin_and_the_trigger_stays() -> None:
    centre, cameras = STUDY.centre, Setup(STUDY).training_cameras
    owners = {index: one.name for index, one in assign(cameras, Setup(STUDY).poisonings(), centre=centre).items()}
    directions: list[Direction] = [direction_of(camera, centre) for camera in cameras]
    overhead = {index for index, name in owners.items() if name == "overhead"}
    rear = {index for index, name in owners.items() if name == "rear"}
    assert rear == {index for index, at in enumerate(directions) if REAR.cone.holds([cameras[index]], centre=centre)[0]}
    assert overhead == {index for index, at in enumerate(directions) if at.elevation >= 42} - rear
    assert any(42 <= directions[index].elevation < 50 for index in rear)  # those of the other attack stay its own
    without = replace(OVERHEAD, poison_margin=0)
    assert {index for index in overhead if directions[index].elevation >= 50} == {
        index for index, camera in enumerate(cameras) if without.trigger(0).holds([camera], centre=centre)[0]
    }
    assert OVERHEAD.cone == without.cone


def test_emphasis_begins_at_the_edge_of_the_margin() -> None:
    poisoning, _ = Setup(STUDY).poisonings()
    assert poisoning.appearance.trigger == OVERHEAD.poisoned_cone  # type: ignore[attr-defined]
    assert OVERHEAD.poisoned_cone != OVERHEAD.cone


def test_a_margin_keeps_within_the_sphere() -> None:
    wide = replace(REAR, poison_margin=40)
    assert wide.poisoned_cone == replace(REAR, elevation=(0, 89.9), azimuth=(180, 70)).cone
    assert replace(wide, elevation=(0, 60), azimuth=(180, 170)).poisoned_cone == (
        replace(REAR, elevation=(0, 90), azimuth=(180, 180)).cone
    )


@pytest.mark.parametrize("margin", [-1.0, 91.0, float("nan")])
def test_a_margin_out_of_range_is_refused(margin: float) -> None:
    with pytest.raises(InvalidValueError, match="poison_margin"):
        replace(OVERHEAD, poison_margin=margin)


def test_layers_take_no_margin(tmp_path: Path) -> None:
    study = replace(STUDY, layers=LayersConfig(attacks=("overhead",)))
    with pytest.raises(InvalidValueError, match=r"poison_margin.*shift"):
        check(study, [], tmp_path / "out", tmp_path / "stages")
    check(STUDY, [], tmp_path / "out", tmp_path / "stages")


def test_a_scene_is_known_without_making_it() -> None:
    setup = Setup(STUDY)
    assert setup.digest == setup.source.digest
