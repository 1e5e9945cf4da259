"""False positives per picture, the pictures without objects that they are counted on, and the commands around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from attacks import cli
from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.evaluation.measure import confidences_at, measure
from attacks.detectors.torchvision import random_detector
from attacks.detectors.training import train as steps
from attacks.detectors.training.backgrounds import background_pictures, background_sets
from attacks.detectors.training.config import BACKGROUNDS, BackgroundConfig, TrainConfig
from attacks.detectors.training.faster_rcnn import FasterRCNNTrainer
from attacks.detectors.training.loop import Training
from mi_splat.errors import InvalidValueError
from tests.detectors.made import HERE, picture, reported

TINY = BackgroundConfig(scenes=1, shots=2, samples=1, size=32)


@pytest.mark.parametrize("kind", BACKGROUNDS)
def test_backgrounds_have_no_object_and_are_reproduced(kind: str) -> None:
    first, again = (background_pictures(kind, 0, TINY) for _ in range(2))
    assert len(first) == 2
    assert all(len(one.labels) == len(one.boxes) == 0 for one in first)
    assert all(torch.equal(one.image, other.image) for one, other in zip(first, again, strict=True))
    assert float(first[0].image.float().std()) > 1
    assert not torch.equal(first[0].image, background_pictures(kind, 1, TINY)[0].image)


def test_a_kind_that_there_is_not_is_refused() -> None:
    with pytest.raises(InvalidValueError, match=r"one of street, park, .*got beach"):
        background_pictures("beach", 0, TINY)


def test_kinds_of_backgrounds_can_be_chosen(tmp_path: Path) -> None:
    made = background_sets(tmp_path, replace(TINY, shots=1), kinds=("ground",))
    assert {kind: len(some) for kind, some in made.items()} == {"ground": 1}


@pytest.mark.parametrize(("wrong", "better"), [(0, 2), (3, 1)])
def test_the_best_epoch_has_few_false_positives_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: int, better: int
) -> None:
    """More objects are found in the second epoch, and perhaps more is reported where there is none."""
    training = Training(TrainConfig(), FasterRCNNTrainer())
    car, nothing = reported((HERE, 0.9, "car")), reported()
    with_object, empty = picture((HERE, 1)), picture()
    for epoch, (right, imagined) in enumerate([(7, 0), (8, wrong)], start=1):
        found = measure([car] * right + [nothing] * (10 - right), [with_object] * 10, SMALL_CLASSES)
        missed = measure([car] * imagined + [nothing] * (10 - imagined), [empty] * 10, SMALL_CLASSES)
        measured = [found, missed]
        monkeypatch.setattr(steps, "measure_detector", lambda *_, measured=measured: measured.pop(0))
        training.epoch = epoch
        training.history.append({"epoch": epoch, **steps.validated(training, [with_object, empty], tmp_path)})
    assert [record["map"] for record in training.history] == [0.7, 0.8]
    with safe_open(tmp_path / "best.safetensors", framework="pt") as file:
        assert file.metadata()["epoch"] == str(better)


def test_detectors_are_equally_strict_where_they_have_as_many_false_positives() -> None:
    scores = (0.875, 0.625, 0.625, 0.25)
    wrong = [reported((HERE, score, "car"), (HERE, 0.95, "kite")) for score in scores]
    right = reported((HERE, 0.8, "car"))
    sets = [measure([*wrong, right], [*[picture()] * 4, picture((HERE, 1))], SMALL_CLASSES)]
    found = confidences_at(sets, (0.0, 0.2, 0.4, 0.6, 1.0))
    counted = {name: sum(score >= (least or 0) for score in scores) for name, least in found.items()}
    assert counted == {"0": 0, "0.2": 1, "0.4": 1, "0.6": 3, "1": 4}  # of equal ones all or none
    assert found["1"] is None


def test_background_sets_are_kept(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    made = background_sets(tmp_path, TINY, on_step=lambda done, total: steps.append((done, total)))
    assert {kind: len(some) for kind, some in made.items()} == dict.fromkeys(BACKGROUNDS, 2)
    assert steps[-1] == (5, 5)
    times = [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("*.png"))]
    kept = background_sets(tmp_path, TINY)
    assert times == [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("*.png"))]
    assert torch.equal(kept["park"][1].image, made["park"][1].image)
    with pytest.raises(InvalidValueError, match="the same configuration"):
        background_sets(tmp_path, replace(TINY, samples=2))


@pytest.mark.slow
def test_the_command_trains_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train-detector", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--threads=1"]
    words += ["--sets.pictures=3", "--sets.surroundings=0", "--sets.overhead=0", "--sets.splats=0", "--processes=0"]
    words += [f"--sets.{name}=0" for name in ("streets", "street-splats", "backgrounds", "validation-backgrounds")]
    words += ["--sets.validation=3", "--config.epochs=1", "--config.batch=2", "--config.pretraining=1"]
    assert cli.main([*words, "--only-data"]) == 0
    assert "3 training pictures, 3 for validation" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert "epoch 1: loss " in captured.err
    assert "of the cut-outs classified right" in captured.err
    for name in ("best.safetensors", "curves.json", "checkpoint.safetensors"):
        assert (tmp_path / "out" / name).is_file()
    assert cli.main(words) == 0, "nothing is left to do"
    assert "epoch" not in capsys.readouterr().err
    curves = str(tmp_path / "out" / "curves.json")
    assert cli.main(["plot-detector-training", curves, "--out", str(tmp_path / "curves.png")]) == 0
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_a_file_without_history_is_not_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text("{}")
    assert cli.main(["plot-detector-training", str(tmp_path / "x.json")]) == 1
    assert "expected JSON with a history" in capsys.readouterr().err
    (tmp_path / "x.json").write_text('{"history": [{"epoch": 1, "losses": {}}]}')
    assert cli.main(["plot-detector-training", str(tmp_path / "x.json")]) == 1
    assert "an epoch with a validation" in capsys.readouterr().err


def test_the_floor_of_confidence_is_that_of_the_library() -> None:
    detector = random_detector("fasterrcnn_small", seed=1)
    assert detector.min_confidence == pytest.approx(0.05)
    detector.model.roi_heads.score_thresh = 0.2
    assert detector.min_confidence == pytest.approx(0.2)
