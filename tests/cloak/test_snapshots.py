"""Results of an earlier study: gone on with after an upgrade, and what differs is said setting by setting."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import asdict
from pathlib import Path

import pytest

from attacks.cloak.config import AttackConfig, StudyConfig
from attacks.cloak.study import check_folder, differences
from mi_splat.errors import InvalidValueError

STUDY = StudyConfig(name="s", attack=(AttackConfig(name="above", elevation=(40.0, 90.0)),))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "study.json"
    path.write_text(json.dumps(asdict(STUDY)))
    return path


def test_the_same_study_goes_on(file: Path) -> None:
    assert differences(file, STUDY) == []
    check_folder(STUDY, file.parent)


def test_what_differs_is_said(file: Path) -> None:
    attack = dataclasses.replace(STUDY.attack[0], elevation=(30.0, 90.0))
    other = dataclasses.replace(STUDY, seeds=(0, 1), attack=(attack,))
    said = ["seeds [0] and not [0, 1]", "attack.0.elevation [40.0, 90.0] and not [30.0, 90.0]"]
    assert differences(file, other) == said
    with pytest.raises(InvalidValueError, match=r"results of a study with seeds \[0\] and not \[0, 1\], attack\.0\."):
        check_folder(other, file.parent)


def test_a_setting_of_a_newer_version_is_named(file: Path) -> None:
    newer = json.loads(file.read_text())
    newer["scene"]["fog"] = 0.5
    file.write_text(json.dumps(newer))
    assert differences(file, STUDY) == ["scene.fog 0.5 and not None"]


@pytest.mark.parametrize("text", ["", "[]", "3", "{"])
def test_what_is_no_study_is_refused(text: str, file: Path) -> None:
    file.write_text(text)
    with pytest.raises(InvalidValueError, match="expected a study"):
        differences(file, STUDY)
