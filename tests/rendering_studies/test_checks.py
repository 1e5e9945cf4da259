"""What cannot be is found before the first attack of a rendering study, by its file or by the command."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.cli import rendering_study
from attacks.cli.attack_scenes import read_attack_scene
from attacks.dagger.jobs import AttackScene
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.rendering_studies.config import read_rendering_study
from attacks.rendering_studies.jobs import StudyAttack, StudyRunner, attacks_of
from mi_splat.errors import InvalidValueError
from tests.dagger.test_study import toy
from tests.fakes import ColourDetector

HEAD = 'name = "s"\nquestion = "Q?"\nseeds = 1\n'
PAIR = '[[pairs]]\nscene = "toy"\nobject = "car"\ntarget = "person"\n'
TABLE = '[[attacks]]\neps = [1.0]\nsteps = 1\nrenderers = ["tile"]\n'
OWN = "[judge]\nown_renderer = true\n"
SUN = '[judge.sun]\nscene = "{}"\nhours = [12.0]\n'


@pytest.mark.parametrize(
    ("attacks", "judge", "match"),
    [
        ("eps = []", "own_renderer = true", "eps: expected at least one, got none"),
        ("renderers = []", "own_renderer = true", "renderers: expected at least one, got none"),
        ("gradients = []", "own_renderer = true", "gradients: expected at least one, got none"),
        ("", 'files = [".spz", ".obj"]', r"files: expected one of \.ply, .* got \.obj; did you mean"),
        ("", "sh_degrees = [0, 4]", r"sh_degrees: expected a number in \[0, 3\], got 4"),
        ("", '[judge.sun]\nscene = "a"\nhours = []', "hours: expected at least one, got none"),
        ("", '[judge.sun]\nscene = "a"\nhours = [12.0, 3.0]', "hour: expected an hour when the sun is up, got 3"),
        ("", '[judge.sun]\nscene = "a"\nhours = [12.0, 12.001]', "hours: expected different minutes, got 12:00, 12:00"),
        ("", '[judge.sun]\nscene = "a"\nhours = [nan]', "hours/0: expected a finite number, got nan"),
        ("", '[judge.sun]\nscene = "a"\nhours = [12.0]\nsamples = 0', "samples: expected a number >= 1"),
    ],
)
def test_a_table_that_cannot_be_is_refused(attacks: str, judge: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(f"{HEAD}{PAIR}[[attacks]]\n{attacks}\n[judge]\n{judge}\n")
    with pytest.raises(InvalidValueError, match=match):
        read_rendering_study(path)


def test_one_object_in_two_scenes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(f"{HEAD}{PAIR}{PAIR.replace('toy', 'other')}{TABLE}{OWN}")
    with pytest.raises(InvalidValueError, match='pairs: expected different objects, got "car" in toy and in other'):
        attacks_of(read_rendering_study(path))


def read(path: Path) -> AttackScene:
    """The toy scene by its name, and what is in a file by another one."""
    scene = toy()
    car = dataclasses.replace(scene, objects={"car": scene.objects["thing"]})
    return car if path.stem == "toy" else read_attack_scene(path)


def load(name: str) -> Detector:
    """The fake detector by its name, and one of the project by another one."""
    return ColourDetector() if name == ColourDetector.name else load_detector(name)


def wrong(pair: str = "", table: str = "", judge: str = OWN, detectors: str = '"fake_colour"') -> str:
    """A study with another pair and another group of attacks after the right ones."""
    pairs = PAIR + (f"[[pairs]]\n{pair}\n" if pair else "")
    tables = TABLE + (f"[[attacks]]\n{table}\n" if table else "")
    return f"{HEAD}detectors = [{detectors}]\n{pairs}{tables}{judge}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (wrong(table='renderers = ["tile", "unreal"]'), "renderer: expected one of tile, "),
        (wrong(table='gradients = ["own", "unreal"]'), "renderer: expected one of tile, "),
        (wrong(judge='[judge]\nrenderers = ["tile", "unreal"]\n'), "renderer: expected one of tile, "),
        (wrong(judge=SUN.format("none.xml")), "scene: expected a Mitsuba XML file, got no file none.xml"),
        (wrong(judge=SUN.format("{here}/s.toml")), "s.toml: expected a Mitsuba XML file"),
        (wrong('scene = "none"\nobject = "bus"\ntarget = "person"'), "got no file scenes/none.xml"),
        (wrong('scene = "toy"\nobject = "bus"\ntarget = "person"'), "object of toy: expected one of car, got bus"),
        (wrong('scene = "toy"\nobject = "car"\ntarget = "person"\ncamera = 2'), "camera: expected 0 to 1, got 2"),
        (wrong('scene = "toy"\nobject = "car"\ntarget = "bus"'), "target for fake_colour: expected one of car, person"),
        (wrong(detectors='"fake_colour", "unreal"'), "detector: expected"),
        (wrong(table="sh_degree = 4"), "sh_degree: expected a number in [0, 3], got 4"),
    ],
)
def test_the_command_checks_all_before_the_first_attack(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    attacked: list[str] = []

    def attack(self: StudyRunner, job: StudyAttack) -> dict[str, Any]:
        attacked.append(job.name)
        return {}

    monkeypatch.setattr(StudyRunner, "attack", attack)
    monkeypatch.setattr(rendering_study, "load_detector", load)
    monkeypatch.setattr(rendering_study, "read_attack_scene", read)
    file = tmp_path / "s.toml"
    file.write_text(text.replace("{here}", str(tmp_path)))
    assert cli.main(["rendering-study", str(file), "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert said in error.replace("\n", " ")
    assert attacked == []
