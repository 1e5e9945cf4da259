"""The six pairs on several detectors: which attacks are done, what is kept of them, and the smallest ball."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene, Job, JobRunner
from attacks.dagger.pairs import SEARCHES, ledger, pair_job, pairs_table, run_pairs, smallest_radius, write_summary
from attacks.dagger.study import OBJECTS, PAIRS
from attacks.objectives import Relabel
from mi_splat.errors import InvalidValueError
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def summary_of(job: Job) -> dict[str, Any]:
    """What an attack would say that succeeds in balls of 2 and more; the larger the seed, the larger the ball."""
    success = job.config.eps[0] >= 2 + job.config.seed
    return {
        "success": success,
        "unambiguous": success,
        "target_confidence": 0.75 if success else 0.25,
        "steps": 7,
        "used": {"sh": 1.5},
        "image_psnr": 33.0 + job.config.seed,
        "config": {"objective": {"confidence": 0.5}},
        "noise": {"successes": 0, "draws": 5, "scores": [0.0, 0.125]},
        "views": [{"original": "car", "clean_confidence": 0.9}],
    }


@pytest.mark.parametrize("wanted", [0.5, 1.0, 2.5, 3.0, 9.0])
def test_the_smallest_radius_is_found_in_few_attacks(wanted: float) -> None:
    radii, tried = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0), list[float]()

    def succeeds(radius: float) -> bool:
        tried.append(radius)
        return radius >= wanted

    assert smallest_radius(radii, succeeds) == min((r for r in radii if r >= wanted), default=None)
    assert len(tried) <= 3


def test_every_pair_is_attacked_with_every_radius_and_seed() -> None:
    asked = []

    def attack(job: Job) -> dict[str, Any]:
        asked.append(job)
        return summary_of(job)

    found = run_pairs({"a": attack, "b": attack}, eps=(2.0, 5.0), steps=40, seeds=(0, 1), search="strong")
    assert len(found["pairs"]) == len(asked) == 2 * 6 * 2 * 2
    assert {(job.scene, job.object, job.target) for job in asked} == set(PAIRS)
    assert all(job.config.steps == 40 and job.config.momentum == 0.5 for job in asked)
    assert [job.config.random_start for job in asked[:4]] == [False, True, False, True]
    row = found["pairs"][0]
    wanted = {"detector", "object", "target", "success", "confidence", "eps", "steps", "image_psnr"}
    assert wanted | {"control_success", "control_draws", "control_confidence"} <= set(row)
    assert row["control_confidence"] == 0.125
    assert found["smallest"] == []


def test_the_table_counts_over_seeds(tmp_path: Path) -> None:
    found = run_pairs({"a": summary_of}, eps=(2.0,), steps=11, seeds=(0, 1), radii=(1.0, 2.0, 2.5))
    assert found["smallest"][0] == {"detector": "a", "object": "car", "target": "person", "eps": [2.0, None]}
    table = pairs_table(found)
    assert "| a | car to person | 2 | 1/2 | 0.25 to 0.75 | 7 | 33.0 to 34.0 | 0/10, 0.12 |" in table
    assert "| a | stop_sign to bird | 2, none |" in table
    paths = write_summary(found, tmp_path)
    assert json.loads(paths[0].read_text())["pairs"] == found["pairs"]
    assert paths[1].read_text() == table


def _runner(**objective: Any) -> JobRunner:
    def read(name: str) -> AttackScene:
        objects = {part: slice(10, 40) for place, part in OBJECTS if place == name}
        return AttackScene(scene=toy_scene()[0], objects=objects, cameras=(camera(),), render=blobs)

    return JobRunner(read, ColourDetector(), objective=objective)


def test_the_ledger_keeps_a_picture_and_does_nothing_twice(tmp_path: Path) -> None:
    runner, job, done = _runner(confidence=0.4), pair_job(PAIRS[0], 0, 1.0, 2), list[str]()
    attack = ledger(runner, tmp_path, on_job=lambda one: done.append(one.name))
    first = attack(job)
    (picture,) = tmp_path.glob("pictures/*.png")
    picture.unlink()
    assert attack(job) == json.loads(json.dumps(first))
    assert not picture.exists()
    assert len(done) == 2
    assert first["config"]["objective"]["confidence"] == 0.4


def test_the_objective_s_settings_reach_the_attack_and_the_ledger() -> None:
    job = pair_job(PAIRS[0], 0, 1.0, 1)
    plain, strong = _runner(), _runner(**SEARCHES["strong"].objective)
    objective = strong.attack(job).objective
    assert isinstance(objective, Relabel)
    assert (objective.near, objective.top, objective.tightness, objective.suppression) == (0.85, 1, 0.0, 0.3)
    assert plain.fingerprint(job) != strong.fingerprint(job)


@pytest.mark.parametrize("change", [{"momentum": 1.0}, {"schedule": "rising"}, {"gradient_power": 1.5}])
def test_what_a_step_cannot_be_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(change))):
        DaggerConfig(**change)
