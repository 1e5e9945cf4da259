"""Studies on fakes: jobs are resumable, tables say what the records say."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from attacks.dagger.config import DaggerConfig
from attacks.dagger.eot.jobs import EotJob, EotJobRunner
from attacks.dagger.jobs import AttackScene, Job, JobRunner
from attacks.dagger.study import as_json, run_jobs
from attacks.dagger.tables import by_radius, markdown, rows, write_tables
from attacks.dagger.transfer.scenes import AttackScenes
from mi_splat.cameras import Camera
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


def test_an_object_that_is_not_there_is_named() -> None:
    with pytest.raises(InvalidValueError, match="object of toy: expected one of rest, thing, got tree"):
        runner().run(dataclasses.replace(JOBS[0], object="tree"))
