"""Real detectors and scenes: a splat attacked for one detector, judged by it and by another; gradients of the chain."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from attacks.cli.attack_scenes import read_attack_scene
from attacks.dagger.config import DaggerConfig
from attacks.dagger.sanity import checks
from attacks.dagger.sanity.runs import Case, Runs
from attacks.dagger.transfer.jobs import SourceJob, TransferRunner
from attacks.dagger.transfer.matrix import cells, looked_rows
from attacks.dagger.transfer.study import run_transfer
from attacks.detectors import load_detector
from attacks.objectives import relabel

SCENES = Path(__file__).parents[2] / "scenes"

pytestmark = pytest.mark.slow


def test_an_attack_is_judged_by_the_detector_attacked_and_by_another(tmp_path: Path) -> None:
    config = DaggerConfig(eps=(5.0,), steps=8, early_stop=False, noise_draws=0)
    job = SourceJob(sources=("fasterrcnn_small",), scene="car_street", object="car", target="person", config=config)
    judges = ["fasterrcnn_small"]
    if importlib.util.find_spec("ultralytics") is not None:
        judges.append("yolov8n_small")
    runner = TransferRunner(lambda name: read_attack_scene(SCENES / f"{name}.xml"), load_detector, tmp_path)
    (record,) = run_transfer([job], judges, tmp_path, runner)
    matrix = {cell.detector: cell for cell in cells(looked_rows([record]))}
    own = matrix["fasterrcnn_small"]
    assert (own.targeted.successes, own.targeted.total) == (1, 1)
    assert own.noise_targeted.successes == own.noise_untargeted.successes == 0
    for detector in judges[1:]:  # it does not find the clean car from there, but nor does it see a person
        assert matrix[detector].runs == 1
        assert (
            record["judged"][detector]["attacked"]["target_score"]
            < 0.5
            > record["judged"][detector]["noise"]["target_score"]
        )


def test_the_gradients_of_the_shipped_scene_are_those_of_the_chain() -> None:
    place = read_attack_scene(SCENES / "car_street.xml")
    case = Case(
        scene=place.scene,
        mask=place.objects["car"],
        cameras=place.cameras[:1],
        detector=load_detector("fasterrcnn_small"),
        objective=relabel("person"),
        render=place.render,
        config=DaggerConfig(),
    )
    renderer, chain = (check(Runs(case)) for check in (checks.renderer_gradient, checks.gradient))
    assert renderer.passed, renderer.figures
    assert renderer.values["cosine"] > 0.9999
    assert chain.passed, chain.figures
