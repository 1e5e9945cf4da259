"""False positives per picture, the pictures without objects that they are counted on, and the commands around them."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from scipy.stats import chi2

from attacks import cli
from attacks.detectors.base import Detections
from attacks.detectors.evaluation.held_out import evaluate_sets, figures
from attacks.detectors.torchvision import random_detector
from attacks.detectors.training import train as steps
from attacks.detectors.training.average_precision import Score
from attacks.detectors.training.backgrounds import background_pictures, background_sets
from attacks.detectors.training.config import BACKGROUNDS, BackgroundConfig, TrainConfig
from attacks.detectors.training.false_positives import FalsePositives, false_positives, poisson_interval
from attacks.detectors.training.faster_rcnn import FasterRCNNTrainer
from attacks.detectors.training.loop import Training
from attacks.detectors.training.pictures import LabelledPicture
from mi_splat.errors import InvalidValueError
from tests.fakes import ColourDetector

CLASSES = ("car", "person")
TINY = BackgroundConfig(scenes=1, shots=2, samples=1, size=32)
HERE, THERE = [10.0, 10.0, 50.0, 50.0], [60.0, 60.0, 90.0, 90.0]


def picture(*objects: tuple[list[float], int]) -> LabelledPicture:
    boxes = torch.tensor([box for box, _ in objects]).reshape(-1, 4)
    labels = torch.tensor([label for _, label in objects], dtype=torch.int64)
    return LabelledPicture(torch.zeros(96, 96, 3, dtype=torch.uint8), boxes, labels)


def found(*rows: tuple[list[float], float, str]) -> Detections:
    boxes = torch.tensor([box for box, _, _ in rows]).reshape(-1, 4)
    return Detections(boxes, torch.tensor([score for _, score, _ in rows]), tuple(label for _, _, label in rows))


@pytest.mark.parametrize(
    ("detections", "cars", "people"),
    [
        (found(), 0, 0),
        (found((HERE, 0.9, "car")), 0, 0),
        (found((HERE, 0.9, "person")), 0, 1),  # the right place, the wrong class
        (found((THERE, 0.9, "car")), 1, 0),
        (found((THERE, 0.5, "car")), 1, 0),  # 0.5 counts
        (found((THERE, 0.49, "car")), 0, 0),
        (found((HERE, 0.9, "car"), (HERE, 0.8, "car")), 1, 0),  # an object is found once
        (found((HERE, 0.9, "car"), (THERE, 0.8, "person"), (THERE, 0.7, "person")), 0, 2),
        (found(([10.0, 10.0, 50.0, 29.0], 0.9, "car")), 1, 0),  # overlaps by 0.475
        (found(([10.0, 10.0, 50.0, 31.0], 0.9, "car")), 0, 0),  # by 0.525
    ],
)
def test_what_counts_as_a_false_positive(detections: Detections, cars: int, people: int) -> None:
    result = false_positives([detections], [picture((HERE, 1))], CLASSES)
    assert result.by_class == {"car": cars, "person": people}
    assert result.pictures_with == int(cars + people > 0)


def test_pictures_are_counted_and_matched_apart() -> None:
    results = [found((HERE, 0.9, "car")), found((THERE, 0.9, "car"), (HERE, 0.8, "person")), found()]
    result = false_positives(results, [picture((HERE, 1)), picture((HERE, 1)), picture()], CLASSES)
    assert (result.pictures, result.pictures_with, result.total) == (3, 1, 2)
    assert result.rate == pytest.approx(2 / 3)
    low, high = poisson_interval(2)
    assert result.interval == (low / 3, high / 3)


def test_thresholds_can_be_chosen() -> None:
    detections = [found((THERE, 0.3, "car"), ([10.0, 10.0, 50.0, 29.0], 0.9, "car"))]
    truth = [picture((HERE, 1))]
    assert false_positives(detections, truth, CLASSES, confidence=0.2, iou=0.4).total == 1
    assert false_positives(detections, truth, CLASSES, confidence=0.2).total == 2
    assert false_positives(detections, truth, CLASSES, iou=0.4).total == 0


@pytest.mark.parametrize("count", [0, 1, 2, 7, 60, 400])
def test_the_interval_is_garwood_s(count: int) -> None:
    low, high = poisson_interval(count)
    assert low == pytest.approx(chi2.ppf(0.025, 2 * count) / 2 if count else 0.0, rel=1e-6)
    assert high == pytest.approx(chi2.ppf(0.975, 2 * count + 2) / 2, rel=1e-6)


def test_no_pictures_say_nothing() -> None:
    nothing = FalsePositives(pictures=0, pictures_with=0, by_class={"car": 0})
    assert (nothing.rate, nothing.interval) == (0.0, (0.0, float("inf")))


def test_sets_are_scored_apart() -> None:
    sets = {"with": [picture((HERE, 1))], "without": [picture(), picture()]}
    results = evaluate_sets(ColourDetector(), sets)
    assert results["with"].score is not None
    assert results["with"].score.counts == {"car": 1}
    assert results["without"].score is None
    shown = figures(results)
    assert shown["without"]["pictures"] == 2
    assert "map" not in shown["without"]
    assert shown["with"]["map"] == 0.0
    assert json.loads(json.dumps(shown)) == shown


@pytest.mark.parametrize("kind", BACKGROUNDS)
def test_backgrounds_have_no_object_and_are_reproduced(kind: str) -> None:
    first, again = (background_pictures(kind, 0, TINY) for _ in range(2))
    assert len(first) == 2
    assert all(len(one.labels) == len(one.boxes) == 0 for one in first)
    assert all(torch.equal(one.image, other.image) for one, other in zip(first, again, strict=True))
    assert float(first[0].image.float().std()) > 1
    assert not torch.equal(first[0].image, background_pictures(kind, 1, TINY)[0].image)


def test_a_kind_that_there_is_not_is_refused() -> None:
    with pytest.raises(InvalidValueError, match=r"street or park or .*got 'beach'"):
        background_pictures("beach", 0, TINY)


def test_kinds_of_backgrounds_can_be_chosen(tmp_path: Path) -> None:
    made = background_sets(tmp_path, replace(TINY, shots=1), kinds=("ground",))
    assert {kind: len(some) for kind, some in made.items()} == {"ground": 1}


@pytest.mark.parametrize(("rate", "better"), [(0.0, 2), (0.3, 1)])
def test_the_best_epoch_has_few_false_positives_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: float, better: int
) -> None:
    training = Training(TrainConfig(), FasterRCNNTrainer())
    validation = [picture((HERE, 1)), picture()]
    wrong = FalsePositives(pictures=1, pictures_with=1, by_class={"car": 1})
    for epoch, (average, count) in enumerate([(0.7, 0.0), (0.8, rate)], start=1):
        training.epoch = epoch
        monkeypatch.setattr(steps, "evaluate", lambda *_, a=average: Score(ap={"car": a}, recall={}, counts={}))
        monkeypatch.setattr(steps, "false_positives", lambda *_, c=count: replace(wrong, by_class={"car": c}))
        training.history.append({"epoch": epoch, **steps.validated(training, validation, tmp_path)})
    with safe_open(tmp_path / "best.safetensors", framework="pt") as file:
        assert file.metadata()["epoch"] == str(better)


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
def test_the_command_scores_pictures_backgrounds_and_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {**asdict(TINY), "size": 64}
    flags = [f"--backgrounds.{name}={sizes[name]}" for name in ("scenes", "shots", "samples", "size")]
    words = ["evaluate-detector", "--data", str(tmp_path), "--out", str(tmp_path / "figures.json"), *flags]
    words += [
        "--pictures=3",
        "--samples=1",
        "--splats=0",
        "--processes=0",
        "--scenes",
        "scenes/car_street.xml",
        "scenes/stop_sign.xml",
    ]
    assert cli.main([*words, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == json.loads((tmp_path / "figures.json").read_text())
    assert set(shown["sets"]) == {
        "path traced",
        "scenes/car_street.xml",
        "scenes/stop_sign.xml",
        *(f"background: {k}" for k in BACKGROUNDS),
    }
    street = shown["sets"]["scenes/car_street.xml"]
    assert (street["pictures"], street["counts"]) == (6, {"car": 6})
    assert street["recall"]["car"] == 1.0
    assert shown["sets"]["scenes/stop_sign.xml"]["recall"] == {"stop sign": 1.0}
    assert len(shown["fingerprint"]) == 16
    assert shown["sets"]["path traced"]["recall_by"]["elevation"]["all"]
    assert shown["pictures"]["backgrounds"]["scenes"] == 1
    assert "| background: street |" in (tmp_path / "figures.md").read_text()
    assert cli.main(words) == 0
    assert "background: street: 2 pictures\n  false positives per picture: " in capsys.readouterr().out


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
