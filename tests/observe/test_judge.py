"""One name for judging: rows, rates and images of one splat, or of a clean and an
attacked one.
"""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest
import torch

from attacks import evaluate
from attacks.observe.comparison import compare, compared_rows
from attacks.observe.rates import Measure
from attacks.observe.views import detect_scenes
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc
from tests.fakes import CoarseDetector, ColourDetector, blobs, camera, toy_scene

SCENE, MASK = toy_scene()
CAMERAS = [camera(offset=x) for x in (-0.5, 0.0, 0.5)]


def painted() -> Any:
    """The object in green, which is a person."""
    sh = SCENE.sh.clone()
    sh[MASK, 0] = colour_to_dc(torch.tensor([0.1, 0.9, 0.1]))
    return SCENE.replace(sh=sh)


def test_a_clean_and_an_attacked_splat() -> None:
    scenes = {"clean": SCENE, "attacked": painted()}
    detectors = [ColourDetector(), CoarseDetector()]
    judged = evaluate(
        scenes, MASK, CAMERAS, detectors, render=blobs, target="person", confidence=0.4
    )
    assert set(judged.rates) == {"fake_colour", "fake_coarse"}
    rates = judged.rates["fake_colour"]
    assert (rates["found_clean"].successes, rates["found_clean"].total) == (3, 3)
    assert (
        rates["missed"].successes,
        rates["target_attacked"].successes,
        rates["target_clean"].successes,
    ) == (3, 3, 0)
    seen = detect_scenes(scenes, MASK, CAMERAS, detectors, render=blobs)
    looked = compared_rows(seen, target="person", min_confidence=0.4)
    assert judged.rows.equals(looked.rows)
    assert judged.detections.equals(looked.detections)
    figures = compare(looked.rows, confidence=0.4)
    for name, of_detector in judged.rates.items():
        for measure, rate in of_detector.items():
            assert figures.rate(measure, detector=name) == rate
    assert len(judged.views["attacked"]) == 6


def test_one_splat_alone() -> None:
    judged = evaluate(SCENE, MASK, CAMERAS, ColourDetector(), render=blobs)
    assert list(judged.rates) == ["fake_colour"]
    (rate,) = judged.rates["fake_colour"].values()
    assert (rate.successes, rate.total) == (3, 3)
    assert set(judged.rows["splat"]) == {"clean"}
    strict = evaluate(
        SCENE, MASK, CAMERAS, ColourDetector(), render=blobs, original="person"
    )
    assert strict.rates["fake_colour"]["found_clean"].successes == 0


def test_any_rate_that_rows_give() -> None:
    judged = evaluate(
        {"clean": SCENE, "attacked": painted()},
        MASK,
        CAMERAS,
        ColourDetector(),
        render=blobs,
    )
    sure = {"sure": Measure(holds=pl.col("score") > 0.5)}
    counted = judged.count(sure, by=["splat"])
    for splat in ("clean", "attacked"):
        assert counted.rate("sure", splat=splat).total == 3


def test_what_cannot_be_judged() -> None:
    known: Any = evaluate
    with pytest.raises(
        InvalidValueError, match="scenes: expected one of the name clean"
    ):
        evaluate({"attacked": SCENE}, MASK, CAMERAS, ColourDetector(), render=blobs)
    with pytest.raises(
        InvalidValueError, match="scenes: expected scenes by name, or one, got list"
    ):
        known([SCENE], MASK, CAMERAS, ColourDetector(), render=blobs)
    with pytest.raises(InvalidValueError, match="confidence"):
        evaluate(SCENE, MASK, CAMERAS, ColourDetector(), render=blobs, confidence=2.0)


class Registering(ColourDetector):
    """A detector that keeps the images which it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[torch.Tensor] = []

    def detect(self, images: torch.Tensor) -> Any:
        self.images.append(images)
        return super().detect(images)


def test_every_detector_that_judges_gets_images_of_8_bits() -> None:
    scene, mask = toy_scene()
    detectors = [Registering(), Registering()]
    detectors[1].name = "another"
    assert not is_of_8_bits(blobs(scene, camera()))
    detect_scenes(
        {"clean": scene, "attacked": scene}, mask, [camera()], detectors, render=blobs
    )
    evaluate(
        {"clean": scene, "attacked": scene}, mask, [camera()], detectors, render=blobs
    )
    for detector in detectors:
        assert len(detector.images) >= 4
        assert all(is_of_8_bits(images) for images in detector.images)


def is_of_8_bits(images: torch.Tensor) -> bool:
    return bool((images * 255 - (images * 255).round()).abs().max() < 1e-3)
