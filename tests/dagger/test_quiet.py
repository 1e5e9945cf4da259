"""DAGGER within a PSNR of the object's pixels, and the thresholds that its success is
counted at.
"""

import dataclasses
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.dagger.attack import attack
from attacks.dagger.config import BALL, VIEWS, DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.search import at_limit
from attacks.detectors.registry import DETECTORS, operating_threshold
from attacks.objectives.base import Target
from attacks.objectives.relabel import relabel
from attacks.objectives.suppression import hide
from attacks.observe.comparison import evaluate
from attacks.observe.rates import confidence_words
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, OPERATING
from attacks.search.budget import Budget
from mi_splat.errors import InvalidValueError
from tests.dagger.toy import quick
from tests.fakes import CoarseDetector, ColourDetector, blobs, camera, toy_scene

LIMIT = 9.0
"""dB at which the toy object can become another one: its detector knows only
colours.
"""


class Unsure(ColourDetector):
    """Whose detections count from less."""

    threshold = 0.3


def run(detector: ColourDetector | None = None, **settings: Any) -> Result:
    scene, mask = toy_scene(degree=0)
    cameras = [camera(), camera(offset=0.4)]
    return attack(
        scene,
        mask,
        cameras,
        detector or ColourDetector(),
        relabel("person", strict=True),
        render=blobs,
        config=DaggerConfig.for_views(
            **{"object_psnr": LIMIT, "eps": (9.0,)} | settings
        ),
    )


def test_an_attack_ends_at_the_psnr_of_the_object() -> None:
    result = run()
    assert result.success
    psnr = result.image.psnr_object
    assert psnr is not None
    assert LIMIT - 0.02 <= psnr < LIMIT + 0.15
    for change in result.control_images.values():
        assert change.psnr_object == pytest.approx(psnr, abs=0.5)
    assert result.figures.rate("success", splat=NOISE).successes == 0


def test_a_budget_that_is_too_small_is_kept_and_fails() -> None:
    result = run(object_psnr=34.0, steps=20)
    psnr = result.image.psnr_object
    assert psnr is not None
    assert psnr == pytest.approx(34.0, abs=0.15)
    assert not result.success


def test_only_what_is_the_same_from_everywhere_changes() -> None:
    scene, mask = toy_scene(degree=1)
    result = attack(
        scene,
        mask,
        camera(),
        ColourDetector(),
        relabel("person", strict=True),
        render=blobs,
    )
    assert result.config == DaggerConfig.for_views()
    assert result.scene.degree == scene.degree
    assert not torch.equal(result.scene.sh[mask, 0], scene.sh[mask, 0])
    assert torch.equal(result.scene.sh[:, 1:], scene.sh[:, 1:])


def test_a_region_keeps_the_psnr_of_the_object_in_the_views_that_decide() -> None:
    result = quick(object_psnr=20.0)
    psnr = result.image.psnr_object
    assert psnr is not None
    assert 18 < psnr < 24
    plain = quick()
    assert plain.image.psnr_object is not None
    assert plain.image.psnr_object < 15


@pytest.mark.parametrize("factor", [0.01, 0.7, 1.0, 40.0])
def test_a_point_is_scaled_to_the_limit(factor: float) -> None:
    reference = {"sh": torch.ones(2)}
    point = {"sh": 1 + factor * torch.tensor([1.0, 2.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float((one["sh"] - reference["sh"]).square().sum())

    ball = Budget(radius={"sh": 100.0}, norm="linf")
    scaled = at_limit(point, reference, ball, 5.0, error)
    assert 0.985 * 5 <= error(scaled) <= 5.0
    way = scaled["sh"] - 1
    assert float(way[1] / way[0]) == pytest.approx(2.0, rel=1e-4)
    assert at_limit(reference, reference, ball, 5.0, error) is reference


def test_a_point_at_the_edge_of_its_ball_stays_in_it() -> None:
    reference = {"sh": torch.zeros(2)}
    ball = Budget(radius={"sh": 2.0}, norm="linf")
    point = {"sh": torch.tensor([1.0, 2.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float(one["sh"].square().sum())

    assert float(at_limit(point, reference, ball, 50.0, error)["sh"].abs().max()) <= 2


@pytest.mark.parametrize(
    ("flags", "defaults"),
    [
        ("", VIEWS),
        ("--object-psnr 38", VIEWS),
        ("--eps 2 --object-psnr 38", VIEWS),
        ("--attributes sh", VIEWS),
        ("--eps 2", BALL),
        ("--eps=2 --object-psnr none", BALL),
        ("--norm l2", BALL),
        ("--attributes means --eps 0.1", BALL),
        ("--attributes means", BALL),
    ],
)
def test_a_ball_is_the_budget_where_it_is_asked_for(
    flags: str, defaults: dict[str, Any]
) -> None:
    config = cli.parse("dagger", ["a.ply", *flags.split()]).config
    assert config.steps == defaults.get("steps", 11)
    assert config.sh_degree == defaults.get("sh_degree", 3)
    assert (config.object_psnr is None) is (defaults is BALL)
    if "--object-psnr 38" in flags:
        assert config.object_psnr == 38


def test_one_psnr_takes_the_place_of_the_other() -> None:
    words = ["a.ply", "--object-psnr", "30"]
    region = cli.parse("dagger --region", words).config
    assert (region.object_psnr, region.image_psnr) == (30, None)
    views = DaggerConfig.for_views(image_psnr=40.0)
    assert (views.object_psnr, views.image_psnr) == (None, 40)
    with pytest.raises(InvalidValueError, match="image_psnr"):
        DaggerConfig(image_psnr=40.0, object_psnr=30.0)


def test_a_class_that_is_seen_before_the_attack_is_known_at_its_start() -> None:
    scene, mask = toy_scene()
    result = attack(
        scene, mask, camera(), ColourDetector(), relabel("car"), render=blobs
    )
    assert len(result.trace) == 1
    assert "the aim is reached without any attack" in result.warnings


def test_success_counts_from_the_threshold_of_each_detector() -> None:
    target = Target(
        box=torch.zeros(4), label="person", classes=("person",), threshold=0.3
    )
    assert relabel("person", strict=True).needed(target) == 0.3
    assert relabel("person", strict=True, confidence=0.6).needed(target) == 0.6
    assert relabel("person").needed(target) == 0.7
    low = dataclasses.replace(target, threshold=0.2)
    assert [hide().needed(one) for one in (target, low)] == [0.3, 0.2]
    plain = run()
    unsure = run(Unsure())
    for result, threshold in ((plain, 0.5), (unsure, 0.3)):
        assert set(result.looked.rows[OPERATING]) == {threshold}
        assert set(result.looked.rows["threshold"]) == {threshold}
    # what is left of the own class has to be less, too
    rows = unsure.looked.rows.filter(splat=ATTACKED)
    assert (rows["original_score"] < 0.3).all()
    assert unsure.figures.rate("found_clean", detector="fake_colour").total == len(rows)
    clean = unsure.looked.rows.filter(splat=CLEAN)
    assert (clean["target_score"] < 0.3).all()


def test_a_judge_counts_from_the_threshold_of_each_detector() -> None:
    scene, mask = toy_scene()
    judged = evaluate(scene, mask, camera(), [Unsure(), CoarseDetector()], render=blobs)
    assert judged.confidence == {"fake_colour": 0.3, "fake_coarse": 0.5}
    stated = evaluate(scene, mask, camera(), Unsure(), render=blobs, confidence=0.6)
    assert stated.confidence == 0.6
    for confidence, words in (
        ({"a": 0.5, "b": 0.5}, "0.5"),
        ({"a": 0.3, "b": 0.5}, "0.3 (a), 0.5 (b)"),
    ):
        assert confidence_words(confidence) == words


def test_detectors_state_their_thresholds() -> None:
    assert operating_threshold(Unsure()) == 0.3
    assert operating_threshold(ColourDetector()) == 0.5
    ours = ("fasterrcnn_small", "yolov8n_small")
    assert {operating_threshold(name) for name in ours} == {0.5}
    measured = {"nanodet_coco": 0.45, "centernet_coco": 0.35, "ssd_openimages": 0.3}
    assert {name: DETECTORS[name].threshold for name in measured} == measured
    with pytest.raises(InvalidValueError, match="threshold"):
        dataclasses.replace(DETECTORS["nanodet_coco"], threshold=1.5)
