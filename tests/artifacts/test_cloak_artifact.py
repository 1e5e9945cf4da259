"""A study of CLOAK becomes an artifact from which all of its figures follow."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks.artifacts.checking import check_artifact
from attacks.artifacts.cloak_rows import held_out, study_rows, tables_of
from attacks.artifacts.packing import pack_artifact
from attacks.artifacts.study_results import observed_splats
from attacks.cloak import setup
from attacks.cloak.config import LayersConfig, read_study
from attacks.cloak.observations import StudyRows
from attacks.cloak.study.cache import content_of
from attacks.detectors.base import Detector
from attacks.report.study_toml import study_toml
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.camera_records import recorded_cameras
from tests.artifacts.conftest import PAGE, STUDY
from tests.cloak.tiny_study import Redness


def summary(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return found


def test_observations_go_through_the_rows_unchanged(result: Path, packed: Path) -> None:
    before = observed_splats(summary(result), result / "stages")
    read = check_artifact(packed).contents
    found, expected = study_rows(STUDY, read.splats, read.tables), StudyRows.of(before)
    assert found.rows.select(expected.rows.columns).equals(expected.rows)
    assert found.fidelity.equals(expected.fidelity)
    assert found.transition.equals(expected.transition)
    assert found.gaussians == expected.gaussians
    again = tables_of(STUDY, before, held_out(STUDY, setup.target_of(STUDY.scene)))
    assert all(read.tables[name] == table for name, table in again.items())


def test_it_holds_what_others_need(result: Path, packed: Path) -> None:
    names = {path.relative_to(packed).as_posix() for path in packed.rglob("*") if path.is_file()}
    tables = {"rows.csv", "fidelity.csv", "transition.csv", "detections.csv"}
    splats = {"splats/clean_0.ply", "splats/cloaked_0.ply"}
    assert names == {"artifact.json", "cameras.json", "study.toml", *tables, *splats}
    record = json.loads((packed / "artifact.json").read_text())
    assert set(record["files"]) == names - {"artifact.json"}
    assert record["pages"] == [PAGE]
    assert record["seeds"] == [0]
    assert record["versions"] == summary(result)["versions"]
    assert record["detectors"] == {"redness": Redness.fingerprint}
    assert all(column["meaning"] for columns in record["tables"].values() for column in columns)
    rates = [one for one in record["figures"] if isinstance(one["value"], dict)]
    assert all(one["tolerance"] == 0 for one in rates)
    assert len(rates) > 40
    cameras = recorded_cameras(packed / "cameras.json")  # as --cameras of other commands reads it
    assert cameras is not None
    for camera, place in zip(cameras.values(), held_out(STUDY, setup.target_of(STUDY.scene)), strict=True):
        assert torch.equal(camera.to_world, place.camera.to_world)
        assert (camera.fx, camera.fy) == (place.camera.fx, place.camera.fy)


def test_nothing_in_it_names_a_folder_of_this_machine(result: Path, packed: Path) -> None:
    for path in packed.rglob("*.*"):
        if path.suffix in (".json", ".toml", ".csv"):
            assert str(result.parent) not in path.read_text()


def test_the_same_result_gives_the_same_bytes(result: Path, packed: Path, tmp_path: Path) -> None:
    pack_artifact(result, tmp_path / "again", pages=[PAGE], splats=True, detectors=[Redness()])
    for path in packed.rglob("*"):
        if path.is_file():
            assert (tmp_path / "again" / path.relative_to(packed)).read_bytes() == path.read_bytes(), path


def test_its_study_is_the_study(packed: Path, tmp_path: Path) -> None:
    assert read_study(packed / "study.toml") == STUDY
    layered = replace(STUDY, name='a "name"', seeds=(1, 2), layers=LayersConfig(attacks=("overhead",)))
    (tmp_path / "study.toml").write_text(study_toml(asdict(layered)))
    assert read_study(tmp_path / "study.toml") == layered


def test_every_figure_of_the_summary_is_checked(result: Path, packed: Path) -> None:
    checked = check_artifact(packed)
    assert checked.passed
    found = json.loads(json.dumps(checked.derived))
    assert found == {key: value for key, value in summary(result).items() if key in found}
    rest = {*("files", "splats", "detectors", "seeds", "study"), *("versions", "commit", "variant", "seconds")}
    assert set(summary(result)) - set(found) == rest
    assert checked.figures[-1].name == "detections of redness"


def unfinished(result: Path, folder: Path) -> Path:
    shutil.copytree(result, folder)
    return folder


def test_without_its_observations_it_cannot_be_packed(result: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="expected the observations of the clean splat, seed 0") as error:
        pack_artifact(result, tmp_path / "out", stages=tmp_path)
    assert error.value.hint == "--stages"
    assert not (tmp_path / "out").exists()


def test_observations_that_were_changed_are_refused(result: Path, tmp_path: Path) -> None:
    folder = unfinished(result, tmp_path / "study")
    path = folder / "stages" / "observations-clean" / "observations.json"
    path.write_text(path.read_text().replace('"view": 3,', '"view": 4,'))
    with pytest.raises(InvalidValueError, match="expected what the study wrote, got other bytes"):
        pack_artifact(folder, tmp_path / "out")


def other_looks(folder: Path, *splats: str) -> None:
    """Observations of the same splats by a study with other pictures to compare with; they sort before the study's."""
    for name in splats:
        own, other = (folder / "stages" / f"observations-{prefix}{name}" for prefix in ("", "another-"))
        shutil.copytree(own, other)
        done = json.loads((other / "done.json").read_text())
        if name == "clean":
            values = json.loads((other / "observations.json").read_text())
            values["blends"] = [{**one, "appearance_psnr": 1.0} for one in values["blends"]]
            (other / "observations.json").write_text(json.dumps(values))
            done["content"] = content_of(other, ("observations.json",))
        done["depends_on"]["true_pictures"] = ["other"]
        (other / "done.json").write_text(json.dumps(done))


def test_a_clean_splat_that_other_studies_share_is_as_its_own_study_saw_it(result: Path, tmp_path: Path) -> None:
    folder = unfinished(result, tmp_path / "study")
    other_looks(folder, "clean")
    pack_artifact(folder, tmp_path / "out")  # it raises unless the figures of the summary follow
    assert (tmp_path / "out" / "artifact.json").is_file()
    shutil.rmtree(folder / "stages" / "observations-clean")
    with pytest.raises(InvalidValueError, match="compared with the same pictures"):
        pack_artifact(folder, tmp_path / "other")


def test_a_summary_of_other_observations_is_refused(result: Path, tmp_path: Path) -> None:
    folder = unfinished(result, tmp_path / "study")
    values = summary(folder)
    values["by_detector"]["redness"]["control_recall"]["successes"] -= 1
    (folder / "summary.json").write_text(json.dumps(values))
    with pytest.raises(InvalidValueError, match="by_detector/redness/control_recall: expected") as error:
        pack_artifact(folder, tmp_path / "out")
    assert "make the result again" in str(error.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("key", ["study", "splats", "seeds", "versions"])
def test_a_summary_that_lacks_something_is_refused(key: str, result: Path, tmp_path: Path) -> None:
    folder = unfinished(result, tmp_path / "study")
    values = summary(folder)
    del values[key]
    (folder / "summary.json").write_text(json.dumps(values))
    with pytest.raises(InvalidValueError, match=f"expected a summary of a study, got KeyError.*{key}"):
        pack_artifact(folder, tmp_path / "out")


def test_other_folders_are_refused(result: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="expected a finished result of mi-splat cloak, dagger-eot, dagger"):
        pack_artifact(tmp_path, tmp_path / "out")
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "letter.txt").write_text("dear")
    with pytest.raises(MiSplatError, match="delete the folder yourself"):
        pack_artifact(result, tmp_path / "precious", force=True)


def test_an_artifact_is_replaced_only_when_forced(result: Path, artifact: Path) -> None:
    (artifact / "rows.csv").write_text("")
    with pytest.raises(MiSplatError, match="replace this result with force"):
        pack_artifact(result, artifact)
    pack_artifact(result, artifact, force=True)
    assert check_artifact(artifact).passed
    assert not (artifact / "splats").exists()


def test_splats_that_are_gone_are_missed(result: Path, tmp_path: Path) -> None:
    folder = unfinished(result, tmp_path / "study")
    (folder / "clean.ply").unlink()
    pack_artifact(folder, tmp_path / "without")
    detectors: list[list[Detector]] = [[], [Redness()]]
    for chosen in detectors:
        with pytest.raises(InvalidValueError, match=r"clean.*got none; pass the folder of stages"):
            pack_artifact(folder, tmp_path / "out", splats=not chosen, detectors=chosen)
        assert not (tmp_path / "out").exists()


def test_pages_lead_nowhere_else(result: Path, tmp_path: Path) -> None:
    for page in ("/etc/passwd.md", "docs/../../a.md", "docs/a.txt"):
        with pytest.raises(InvalidValueError, match=r"expected a page such as docs/cloak\.md"):
            pack_artifact(result, tmp_path / "out", pages=[page])
