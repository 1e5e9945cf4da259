"""Results of an earlier study: gone on with by the same study, and what another has otherwise is said."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig, study_toml
from attacks.cloak.study import check_folder, differences
from mi_splat.errors import InvalidValueError

STUDY = StudyConfig(
    name="s", attack=(AttackConfig(name="above", elevation=(40.0, 90.0)),), cameras=CameraConfig(distance=7.1)
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(study_toml(asdict(STUDY)))
    return path


def test_the_same_study_goes_on(file: Path) -> None:
    check_folder(STUDY, file.parent)


def test_what_differs_is_said(file: Path) -> None:
    attack = replace(STUDY.attack[0], elevation=(30.0, 90.0))
    other = replace(STUDY, seeds=(0, 1), attack=(attack,))
    said = ["seeds (0,) and not (0, 1)", "attack.0.elevation (40.0, 90.0) and not (30.0, 90.0)"]
    assert differences(STUDY, other) == said
    with pytest.raises(InvalidValueError, match=r"results of a study with seeds \(0,\) and not \(0, 1\), attack\.0\."):
        check_folder(other, file.parent)


@pytest.mark.parametrize("text", ["", "3", "{", "name = 's'\n[scene]\nfog = 0.5"])
def test_what_is_no_study_of_this_version_is_refused(text: str, file: Path) -> None:
    file.write_text(text)
    with pytest.raises(InvalidValueError, match=r"study\.toml"):
        check_folder(STUDY, file.parent)
