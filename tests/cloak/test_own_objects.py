"""Studies of objects of the user's own: mesh files and textures, wherever they are."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from attacks import cli
from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.cloak.steps import StudySteps
from mi_splat.capture.gltf import MeshFileError
from mi_splat.ledger import Store
from mi_splat.ledger.job import canonical
from mi_splat.ledger.running import task_for
from tests.capture.trucks import truck, write_glb
from tests.ledger.drive import Ledger
from tests.project.layers import ROOT

OVERHEAD = AttackConfig(name="overhead", elevation=(50, 90))


def own(folder: Path, *, scale: float = 1.0) -> StudyConfig:
    """A study whose object, other object and texture are files of a folder."""
    folder.mkdir()
    mesh = write_glb(folder, truck().placed(scale=scale))
    other = shutil.copy(mesh, folder / "other.glb")
    texture = folder / "flag.png"
    Image.new("RGB", (8, 8), (10, 200, 30)).save(texture)
    swap = replace(OVERHEAD, appearance="swap", other_object=str(other))
    paint = AttackConfig(
        name="rear",
        appearance="paint",
        texture=str(texture),
        elevation=(0, 40),
        azimuth=(180, 45),
    )
    study = StudyConfig(
        name="own",
        attack=(swap, paint),
        cameras=CameraConfig(train=6, size=24, samples=1, points=50, height=0.8),
    )
    scene = replace(study.scene, object=str(mesh), label="car")
    return replace(study, scene=scene)


def test_files_count_by_what_they_hold(tmp_path: Path) -> None:
    keys = []
    for name, scale in (("here", 1.0), ("there", 1.0), ("larger", 1.1)):
        steps = StudySteps(study=own(tmp_path / name, scale=scale))
        keys.append(task_for(steps.pictures(), Store(tmp_path), {}).key)
    assert keys[0] == keys[1] != keys[2]


def test_jobs_are_given_the_files(tmp_path: Path) -> None:
    steps = StudySteps(study=own(tmp_path / "files"))
    ledger = Ledger(tmp_path)
    job = steps.poisoned(0)
    assert str(tmp_path) not in canonical(job.config_json)
    manifest = (ledger.do(job).folder / "poison.json").read_text()
    assert "other instead" in manifest
    assert "paint flag" in manifest


def test_a_class_of_its_own_is_asked_of_detectors(tmp_path: Path) -> None:
    study = own(tmp_path / "files")
    assert study.scene.class_name == "car"
    assert replace(study.scene, label=None).class_name == "truck"


def test_the_command_takes_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = write_glb(tmp_path, truck())
    words = ["cloak", str(ROOT / "scenes" / "cloak_demo.toml"), "--forecast"]
    words += ["--object", str(mesh), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--label", "car"]) == 0
    assert cli.main(words) == cli.FAILED
    assert "class for fasterrcnn_small: expected one of" in capsys.readouterr().err
    missing = [*words, "--object", str(tmp_path / "no.glb")]
    assert cli.main(missing) == cli.FAILED
    assert "scene.object: expected a .glb file" in capsys.readouterr().err


def test_files_that_are_no_mesh_are_refused(tmp_path: Path) -> None:
    study = own(tmp_path / "files")
    scene = replace(study.scene, object=str(tmp_path / "files" / "flag.png"))
    with pytest.raises(MeshFileError, match=r"ends in \.glb"):
        _ = StudySteps(study=replace(study, scene=scene)).setup.target
