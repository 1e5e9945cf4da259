"""Every trainer of a small detector: one step on pictures with objects and without, its detector, what is shipped."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from typing import get_args

import pytest
import torch

from attacks.cli.train_detector import SmallDetector
from attacks.detectors.base import Detector
from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_WEIGHTS
from attacks.detectors.training.config import TrainConfig
from attacks.detectors.training.loop import Training
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.train import trainer_of
from tests.detectors.made import drawn

CONFIG = TrainConfig(pretraining=1, epochs=2, batch=2, low_resolution=64, low_resolution_fraction=0.5)


@pytest.mark.parametrize("name", get_args(SmallDetector))
def test_each_trainer_takes_a_step_and_makes_a_detector(name: str) -> None:
    if name.startswith("yolo") and importlib.util.find_spec("ultralytics") is None:
        pytest.skip("needs the extra yolo")
    torch.set_num_threads(1)
    with_object = drawn((30, 40, 70, 80), size=128, label=2)
    empty = LabelledPicture(with_object.image, torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64))
    training = Training(replace(CONFIG, learning_rate=1e-3), trainer_of(name))
    before = {key: value.clone() for key, value in training.averaged.items()}
    training.pretrain([with_object, empty])
    losses = training.run_epoch([with_object, empty])
    assert all(torch.isfinite(torch.tensor(value)) for value in losses.values())
    assert sum(losses.values()) > 0
    moved = [key for key, value in training.averaged.items() if not torch.equal(value, before[key])]
    assert len(moved) > 0.7 * len(before)
    detector = training.snapshot()
    assert isinstance(detector, Detector)
    assert (detector.name, detector.classes) == (name, SMALL_CLASSES)
    (found,) = detector.candidates(with_object.image[None].float() / 255)
    assert found.scores.shape[1] == len(SMALL_CLASSES)
    assert bool(torch.isfinite(found.boxes).all())


def test_the_shipped_weights_are_small() -> None:
    assert 0 < SMALL_WEIGHTS.stat().st_size <= 10_000_000
