"""Studies on fakes: jobs are resumable, tables say what the records say."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.cli import dagger_study
from attacks.dagger.config import DaggerConfig
from attacks.dagger.eot.jobs import EotJob, EotJobRunner
from attacks.dagger.jobs import AttackScene, Job, JobRunner, jittered
from attacks.dagger.study import CAMERAS, PAIRS, as_json, run_jobs, study_jobs
from attacks.dagger.tables import TITLES, by_radius, markdown, rows, write_tables
from attacks.dagger.transfer.scenes import AttackScenes
from attacks.limits import NORM_NAMES
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras import Camera, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from tests.fakes import ColourDetector, blobs, camera, toy_scene

RANDOM = DaggerConfig(eps=(12.0,), seed=1, random_start=True)
JOBS = [
    Job(group="pairs", scene="toy", object="thing", target="person", config=DaggerConfig(eps=(12.0,))),
    Job(
        group="pairs",
        scene="toy",
        object="thing",
        target="person",
        config=DaggerConfig(eps=(12.0,), seed=1, random_start=True),
    ),
    Job(group="curve", scene="toy", object="thing", target="person", config=DaggerConfig(eps=(0.5,))),
    Job(group="hide", scene="toy", object="thing", target=None, config=DaggerConfig(eps=(12.0,))),
    Job(group="views", scene="toy", object="thing", target="stop sign", config=DaggerConfig(eps=(12.0,)), views=0),
]


def toy() -> AttackScene:
    scene, _ = toy_scene()
    return AttackScene(
        scene=scene,
        objects={"rest": slice(0, 10), "thing": slice(10, 40)},
        cameras=(camera(), camera(offset=0.4)),
        render=blobs,
    )


def runner() -> JobRunner:
    return JobRunner(lambda name: toy(), ColourDetector())


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    one = runner()
    return run_jobs(JOBS, tmp_path_factory.mktemp("study"), one.run, fingerprint=one.fingerprint)


def nudged(by: float) -> tuple[Camera, ...]:
    pose = camera().to_world.clone()
    pose[0, 3] += by
    return (dataclasses.replace(camera(), to_world=pose), camera(offset=0.4))


SETTINGS = RenderSettings()
CHANGES: dict[str, dict[str, Any]] = {
    "a camera that moved by less than is printed": {"cameras": nudged(4e-5)},
    "a camera less": {"cameras": (camera(),)},
    "other rows": {"objects": {"rest": slice(0, 11), "thing": slice(11, 40)}},
    "another background": {"render": Renderer(dataclasses.replace(SETTINGS, background=(1.0, 0.0, 0.0)))},
    "another near plane": {"render": Renderer(dataclasses.replace(SETTINGS, near=0.5))},
    "another method": {"render": Renderer(dataclasses.replace(SETTINGS, method="ray"))},
    "other Gaussians": {"scene": toy().scene.replace(opacities=toy().scene.opacities * 0.99)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_result_belongs_to_all_that_the_attack_saw(change: str) -> None:
    before = dataclasses.replace(toy(), render=Renderer(SETTINGS))
    after = dataclasses.replace(before, **CHANGES[change])
    eot = EotJob(group="pairs", scene="toy", object="thing", target="person", detectors=("fake_colour",))

    def keys(place: AttackScene) -> list[str]:
        colour = ColourDetector()
        scenes = AttackScenes(lambda name: place)
        return [
            JobRunner(lambda name: place, colour).fingerprint(JOBS[0]),
            EotJobRunner(lambda name: place, lambda name: colour).fingerprint(eot),
            scenes.fingerprint("toy", "thing", colour),
        ]

    assert keys(before) == keys(dataclasses.replace(before, render=Renderer(SETTINGS)))
    assert all(one != other for one, other in zip(keys(before), keys(after), strict=True))


def test_attacks_that_differ_in_anything_have_files_of_their_own() -> None:
    first = JOBS[0]
    others = [dataclasses.replace(first, config=dataclasses.replace(first.config, steps=steps)) for steps in (11, 40)]
    others += [dataclasses.replace(first, views=2), dataclasses.replace(first, scene="other")]
    assert len({job.name for job in others}) == 4


def test_the_study_holds_what_the_paper_leaves_open() -> None:
    jobs = study_jobs(3)
    assert len({job.name for job in jobs}) == len(jobs)
    paper = [job for job in jobs if job.group == "pairs"]
    assert len(paper) == 18
    assert {(job.scene, job.object, job.target) for job in paper} == set(PAIRS)
    assert {job.config for job in paper} == {DaggerConfig(seed=seed, random_start=seed > 0) for seed in range(3)}
    assert {job.config.eps for job in jobs if job.group == "curve"} == {(0.5,), (1.0,), (2.0,)}
    assert {job.config.attributes for job in jobs} == {(name,) for name in ATTRIBUTES}
    assert {job.config.norm for job in jobs} == set(NORM_NAMES)
    assert {job.group for job in jobs} == set(TITLES)
    assert {job.object for job in jobs if job.target is None} == {"car", "stop_sign"}
    assert len(study_jobs(1)) * 3 == len(jobs)


@pytest.mark.parametrize("scene", sorted({scene for scene, _, _ in PAIRS}))
def test_every_camera_of_the_scenes_is_studied(scene: str) -> None:
    path = Path(__file__).parents[2] / "scenes" / f"{scene}.xml"
    assert path.read_text().count("<sensor ") == CAMERAS
    looked = {job.camera for job in study_jobs(1) if job.scene == scene and job.views == 1}
    assert looked == set(range(CAMERAS))


def test_records_are_complete(records: list[dict[str, Any]]) -> None:
    assert [record["job"] for record in records] == [as_json(job) for job in JOBS]
    assert [record["result"]["success"] for record in records] == [True, True, False, True, True]
    assert [len(record["result"]["views"]) for record in records] == [1, 1, 1, 1, 2]
    assert [record["result"]["config"]["random_start"] for record in records] == [False, True, False, False, False]


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    done: list[str] = []

    def run(job: Job) -> dict[str, Any]:
        done.append(job.name)
        if job.config.seed == 1 and len(done) == 2:
            raise KeyboardInterrupt
        return {"seed": job.config.seed}

    with pytest.raises(KeyboardInterrupt):
        run_jobs(JOBS[:3], tmp_path, run, fingerprint=lambda job: "a")
    first = list(done)
    heard: list[Job] = []
    again = run_jobs(JOBS[:3], tmp_path, run, fingerprint=lambda job: "a", on_job=heard.append)
    assert done[2:] == [first[1], JOBS[2].name]
    assert heard == JOBS[:3]
    assert run_jobs(JOBS[:3], tmp_path, run, fingerprint=lambda job: "a") == again
    assert len(done) == 4
    (tmp_path / "jobs" / f"{JOBS[0].name}.json").write_text('{"job": 1')
    run_jobs(JOBS[:3], tmp_path, run, fingerprint=lambda job: "a")
    assert done[4:] == [JOBS[0].name]
    run_jobs(JOBS[:3], tmp_path, run, fingerprint=lambda job: "b")
    assert len(done) == 8


@pytest.mark.parametrize("change", [{"steps": 12}, {"step_factor": 1.0}, {"sh_degree": None}, {"early_stop": False}])
def test_a_job_with_another_setting_is_done_beside_the_first(change: dict[str, Any], tmp_path: Path) -> None:
    """Settings that nobody would put into a name count too, and neither result overwrites the other."""
    done: list[DaggerConfig] = []

    def run(job: Job) -> dict[str, Any]:
        done.append(job.config)
        return {}

    other = dataclasses.replace(JOBS[0], config=dataclasses.replace(JOBS[0].config, **change))
    for job in (JOBS[0], other, other, JOBS[0]):
        run_jobs([job], tmp_path, run, fingerprint=lambda job: "a")
    assert done == [JOBS[0].config, other.config]


def test_the_fingerprint_follows_the_scene_the_cameras_and_the_detector() -> None:
    class Other(ColourDetector):
        fingerprint = "another"

    place = toy()
    another, _ = toy_scene(seed=1)
    places = [place, place, dataclasses.replace(place, scene=another)]
    places.append(dataclasses.replace(place, cameras=place.cameras[:1]))
    found = [JobRunner({"toy": one}.__getitem__, ColourDetector()).fingerprint(JOBS[0]) for one in places]
    assert found[0] == found[1] == runner().fingerprint(JOBS[1])
    assert len({*found, JobRunner({"toy": place}.__getitem__, Other()).fingerprint(JOBS[0])}) == 4


def test_rows_and_radii_count_right(records: list[dict[str, Any]]) -> None:
    table = rows(records)
    assert [(row["group"], row["successes"], row["runs"]) for row in table] == [
        ("pairs", 2, 2),
        ("curve", 0, 1),
        ("hide", 1, 1),
        ("views", 1, 1),
    ]
    assert table[0]["noise_draws"] == 10
    assert table[0]["score_least"] <= table[0]["score"]
    radii = {(line["group"], line["eps"]): line for line in by_radius(records)}
    assert radii["pairs", 12.0]["pairs_reached"] == 1
    assert radii["pairs", 0.5]["pairs_reached"] == 0
    assert ("curve", 0.5) not in radii


def test_tables_are_written(records: list[dict[str, Any]], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    paths = write_tables(records, tmp_path)
    assert [path.name for path in paths] == ["table.md", "table.json", "curve.png"]
    text = paths[0].read_text()
    assert text == markdown(records)
    assert "| thing to person | l2 | 12 | 2/2 |" in text
    assert "thing to nothing" in text
    assert json.loads(paths[1].read_text())["by_radius"][0]["runs"] == 1
    assert paths[2].read_bytes().startswith(b"\x89PNG")


def test_jitter_keeps_the_object_in_the_middle() -> None:
    centre = torch.tensor([0.0, 0.0, 0.0])
    assert jittered(camera(), centre, seed=0) is not None
    assert torch.equal(jittered(camera(), centre, seed=0).to_world, camera().to_world)
    moved = [jittered(camera(), centre, seed=seed) for seed in (1, 1, 2)]
    assert torch.equal(moved[0].to_world, moved[1].to_world)
    assert not torch.equal(moved[0].to_world, moved[2].to_world)
    for view in moved:
        pixel, depth = project_points(centre[None].double(), view)
        assert pixel[0].tolist() == pytest.approx([16.0, 16.0], abs=1e-6)
        assert 3 * 0.95 - 1e-6 <= float(depth[0]) <= 3 * 1.05 + 1e-6
        turn = math.degrees(math.acos(min(1.0, float(view.to_world[:3, 2] @ camera().to_world[:3, 2]))))
        assert turn <= 6.0 + 1e-6


def test_jitter_uses_the_whole_of_its_range() -> None:
    centre, start = torch.zeros(3), camera()
    distance = float(start.position.norm())
    turns, moves = [], []
    for seed in range(1, 201):
        moved = jittered(start, centre, seed=seed)
        turns.append(math.degrees(math.acos(min(1.0, float(moved.to_world[:3, 2] @ start.to_world[:3, 2])))))
        moves.append(float(moved.position.norm()) / distance - 1)
    assert 5.9 < max(turns) <= 6.0 + 1e-6
    assert 0.048 < max(moves) <= 0.05 + 1e-6
    assert -0.05 - 1e-6 <= min(moves) < -0.048


def test_an_object_that_is_not_there_is_named() -> None:
    with pytest.raises(InvalidValueError, match="object of toy: expected one of rest, thing, got tree"):
        runner().run(dataclasses.replace(JOBS[0], object="tree"))


def test_the_command_runs_the_tables_that_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dagger_study, "study_jobs", lambda seeds: JOBS[:1] * seeds + JOBS[3:4])
    monkeypatch.setattr(dagger_study, "load_detector", lambda name, weights: ColourDetector())
    monkeypatch.setattr(dagger_study, "read_attack_scene", lambda path: toy())
    words = ["dagger-study", "--seeds", "1", "--groups", "hide", "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["jobs"] == 1
    assert str(tmp_path / "table.md") in document["files"]
    assert [path.stem for path in (tmp_path / "jobs").iterdir()] == [JOBS[3].name]


def test_the_command_refuses_unknown_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dagger-study", "--groups", "colours"]) == 1
    assert "groups: expected some of pairs, curve" in capsys.readouterr().err
