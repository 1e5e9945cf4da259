"""Studies of distributions of views on fakes: searches, the ledger, tables, reports and the commands."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.cli import dagger_eot, dagger_eot_study
from attacks.dagger.config import EotConfig
from attacks.dagger.eot.jobs import EotJob, EotJobRunner
from attacks.dagger.eot.study import GROUPS, MARGIN, PSNR_CURVE, PSNRS, RADII, StudySetup, smallest
from attacks.dagger.eot.tables import markdown, row, smallest_radii, write_eot_tables
from attacks.dagger.jobs import AttackScene
from attacks.dagger.report import summary, write_report
from attacks.dagger.study import run_jobs
from attacks.transformations.config import Transformations
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from tests.dagger.toy import QUICK, REGION, quick
from tests.fakes import ColourDetector, blobs, camera, toy_scene

PAIR = ("toy", "thing", "person")
SETUP = StudySetup(
    detectors=("fake_colour",),
    config=EotConfig(**{**QUICK, "steps": 4, "held_out": 4}),
    transformations=Transformations(cameras=REGION),
    pairs=(PAIR,),
)


def toy() -> AttackScene:
    return AttackScene(scene=toy_scene()[0], objects={"thing": slice(10, 40)}, cameras=(camera(),), render=blobs)


def runner(keep: Path | None = None) -> EotJobRunner:
    return EotJobRunner(lambda name: toy(), lambda name: ColourDetector(), keep=keep)


def asked(group: str, answer: Any) -> list[EotJob]:
    """The attacks that a part of the study asks for, answered by a function of the job."""
    jobs: list[EotJob] = []

    def ask(job: EotJob) -> Mapping[str, Any]:
        jobs.append(job)
        found: Mapping[str, Any] = answer(job)
        return found

    GROUPS[group](ask, SETUP)
    return jobs


@pytest.mark.parametrize("needed", [*RADII, math.inf])
def test_the_smallest_radius_is_found_by_bisection(needed: float) -> None:
    found: dict[float, bool] = {}

    def ask(job: EotJob) -> Mapping[str, Any]:
        found[job.config.eps[0]] = job.config.eps[0] >= needed
        return {"success": found[job.config.eps[0]]}

    smallest(ask, SETUP)
    assert len(found) <= 5
    assert min((eps for eps, success in found.items() if success), default=math.inf) == needed


def test_every_part_asks_for_attacks_with_different_names() -> None:
    jobs = [
        job
        for group in GROUPS
        for job in asked(group, lambda job: {"success": True, "image_psnr": 30 - 8 * job.config.eps[0]})
    ]
    assert len({job.name for job in jobs}) == len(jobs)
    assert {job.config.pool for job in jobs if job.group == "pool"} == {1, 8, 64, 0}
    assert {job.config.sh_degree for job in jobs if job.group == "degree"} == {0, 1, 2, 3}
    assert len([job for job in jobs if job.judged is not None]) == 4
    for limit in PSNRS:
        compared = [job for job in jobs if job.group == f"attributes{limit:.0f}"]
        assert {job.config.image_psnr for job in compared} == {limit + MARGIN}
        assert {"sh", "means", "scales", "rotations", "opacities"} == set().union(
            *(j.config.attributes for j in compared)
        )
    assert [job.config.image_psnr for job in jobs if job.group == "psnr"] == [one + MARGIN for one in PSNR_CURVE]
    assert all(job.config.image_psnr is None for job in jobs if job.group in ("smallest", "curve"))


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    one = runner()
    jobs = [
        SETUP.job("pairs"),
        SETUP.job("smallest", eps=(0.01,)),
        SETUP.job("smallest", eps=(2.0,)),
        SETUP.job("attributes30", attributes=("means",), eps=(0.3,), image_psnr=30.3),
    ]
    return run_jobs(jobs, tmp_path_factory.mktemp("study"), one.run, fingerprint=one.fingerprint)


def test_tables_say_what_the_records_say(records: list[dict[str, Any]], tmp_path: Path) -> None:
    first = row(records[0])
    assert (first["object"], first["target"], first["successes"], first["views"]) == ("thing", "person", 4, 4)
    (line,) = smallest_radii(records)
    assert (line["smallest"], line["not_enough"]) == (2.0, 0.01)
    text = markdown(records)
    assert "| thing to person | fake_colour | linf: sh 2 | - | -120 to -60 | 6 | 1 | plain, plain | 4/4 |" in text
    assert "linf: means 0.3 | 30.3 |" in text
    document = json.loads(write_eot_tables(records, tmp_path)[1].read_text())
    assert len(document["rows"]) == 4


def test_a_stored_result_is_not_made_again(tmp_path: Path) -> None:
    one, job = runner(tmp_path / "kept"), SETUP.job("pairs")
    (first,) = run_jobs([job], tmp_path / "study", one.run, fingerprint=one.fingerprint)

    def fails(job: EotJob) -> dict[str, Any]:
        raise AssertionError("done again")

    (second,) = run_jobs([job], tmp_path / "study", fails, fingerprint=one.fingerprint)
    assert second == json.loads(json.dumps(first))
    assert sorted(path.name for path in (tmp_path / "kept" / job.name).iterdir()) == [
        "attacked.ply",
        "detections.csv.gz",
        "held_out.png",
        "result.json",
        "rows.csv.gz",
    ]


def test_an_object_that_is_not_there_is_named() -> None:
    job = dataclasses.replace(SETUP.job("pairs"), object="tree")
    with pytest.raises(InvalidValueError, match="object of toy: expected one of thing, got tree"):
        runner().run(job)


def test_the_report_has_every_number_and_the_splat(tmp_path: Path) -> None:
    found = quick()
    paths = write_report(found, tmp_path / "out")
    document = json.loads(paths["result.json"].read_text())
    assert document == json.loads(json.dumps(summary(found)))
    assert document["rate"] == {"rate": 1.0, "successes": 8, "total": 8, "interval": list(found.rate.interval)}
    assert len(document["views"]) == 8
    assert document["redraws"] == {"held_out": 0, "validation": 0, "attacked": 0}
    assert document["trace"][1] == {"index": 1, "loss": found.trace[1].loss}
    assert torch.equal(load_splat(paths["attacked.ply"]).sh, found.scene.sh)


def test_the_command_attacks_and_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_splat(toy_scene()[0], tmp_path / "a.ply")
    monkeypatch.setattr(dagger_eot, "load_detectors", lambda names, weights: [ColourDetector()])
    words = "--box -0.5 -0.5 -0.5 0.5 0.5 0.5 --azimuth 270 --elevation 0 --distance 3 --size 32 --fov 45"
    words += " --azimuths 250 290 --elevations 0 20 --eps 2 --steps 6 --step-factor 4 --pool 6 --validation 2"
    words += " --image-psnr None"
    out = tmp_path / "out"
    line = ["dagger-eot", str(tmp_path / "a.ply"), *words.split(), "--held-out", "4", "--out", str(out)]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    assert said.startswith("SUCCESS: fasterrcnn_small sees a person in place of the selection in 4 of 4")
    names = sorted(path.name for path in out.iterdir())
    assert names[:3] == ["attacked.ply", "detections.csv.gz", "held_out.png"]
    assert names[3:] == ["manifest.json", "mask.npy", "result.json", "rows.csv.gz"]
    assert not (tmp_path / "out.checkpoint").exists()
    assert cli.main(line) == 1  # the folder is in use
    assert "--force" in capsys.readouterr().err
    assert cli.main([*line, "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate"]["successes"] == 4


def test_another_up_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dagger-eot", "--up", "0", "-1", "0"]) == 1
    assert "up: expected 0 0 1" in capsys.readouterr().err


def test_the_study_s_command_runs_what_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dagger_eot_study, "load_detector", lambda name: ColourDetector())
    monkeypatch.setattr(dagger_eot_study, "read_attack_scene", lambda path: toy())
    monkeypatch.setattr(dagger_eot_study, "_setup", lambda options: SETUP)
    assert cli.main(["dagger-eot-study", "--groups", "pairs", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["jobs"] == 1
    assert cli.main(["dagger-eot-study", "--groups", "colours", "--out", str(tmp_path)]) == 1
    assert "groups: expected some of pairs, smallest" in capsys.readouterr().err
