"""Trainings of the small detectors: to the same bits when interrupted, by the losses of each, and by the command."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from safetensors import safe_open
from torch import Tensor

from attacks import cli
from attacks.cli.train_detector import SmallDetector
from attacks.detectors.base import Detector
from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_WEIGHTS, DetectorError
from attacks.detectors.torchvision import RCNNDetector
from attacks.detectors.training import train as steps
from attacks.detectors.training.config import TrainConfig
from attacks.detectors.training.dataset import training_job
from attacks.detectors.training.faster_rcnn import FasterRCNNTrainer
from attacks.detectors.training.loop import Training, export_weights
from attacks.detectors.training.pictures import (
    LabelledPicture,
)
from attacks.detectors.training.train import trainer_of
from attacks.detectors.weights import read_weights
from mi_splat.ledger import Job, Ledger
from tests.detectors.made import HERE, TableDetector, drawn, picture, reported
from tests.io.noted import Change, changed

PLAIN = TrainConfig(epochs=2, batch=2, low_resolution=96, low_resolution_fraction=1.0, seed=3)


def few() -> list[LabelledPicture]:
    return [drawn((20 + 4 * i, 30, 70, 80), label=1 + i % 2) for i in range(4)]


@pytest.mark.slow
def test_training_lowers_the_loss() -> None:
    training = Training(replace(PLAIN, epochs=8, learning_rate=1e-3, warm_up=0.01), FasterRCNNTrainer())
    losses = [sum(training.run_epoch(few()).values()) for _ in range(6)]
    assert min(losses[-2:]) < 0.7 * losses[0]


@pytest.mark.slow
def test_an_interrupted_run_ends_with_the_same_bits(tmp_path: Path) -> None:
    straight = Training(PLAIN, FasterRCNNTrainer())
    straight.run_epoch(few())
    straight.save(tmp_path)
    straight.run_epoch(few())
    resumed = Training.resume(tmp_path, PLAIN, FasterRCNNTrainer())
    assert resumed.epoch == 1
    resumed.run_epoch(few())
    for name, value in straight.model.state_dict().items():
        assert torch.equal(value, resumed.model.state_dict()[name]), name
    for name, value in straight.averaged.items():
        assert torch.equal(value, resumed.averaged[name]), name


def test_a_killed_training_goes_on_and_another_is_another_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    epochs: list[int] = []

    def epoch(self: Training, samples: object, **_: object) -> dict[str, float]:
        self.epoch += 1
        epochs.append(self.epoch)
        if len(epochs) == 2:
            raise KeyboardInterrupt
        return {}

    def validated(training: Training, validation: object, folder: Path) -> dict[str, object]:
        export_weights(training.averaged, folder / "best.safetensors", notes={})
        return {"map": 0.0, "validation": {"ap": {}}, "false_positives": 0.0}

    monkeypatch.setattr(Training, "run_epoch", epoch)
    monkeypatch.setattr(steps, "validated", validated)
    weights = tmp_path / "start.safetensors"
    export_weights(Training(PLAIN, FasterRCNNTrainer()).averaged, weights, notes={})
    sets: dict[str, list[Job]] = {"training": [], "validation": []}
    job = training_job("fasterrcnn_small", PLAIN, sets, start=weights)
    told: list[str] = []
    ledger = Ledger(tmp_path / "store", on_event=lambda event: told.append(event.text))
    with pytest.raises(KeyboardInterrupt):
        ledger.do(job)
    done = ledger.do(job)
    assert epochs == [1, 2, 2]
    assert {path.name for path in done.folder.iterdir()} == {"best.safetensors", "curves.json"}
    history = json.loads((done.folder / "curves.json").read_text())["history"]
    assert [record["epoch"] for record in history] == [0, 1, 2]
    assert any(text.startswith("epoch 2: loss 0.000") for text in told)
    ledger.do(job)
    assert epochs == [1, 2, 2], "nothing is left to do"
    ledger.do(training_job("fasterrcnn_small", replace(PLAIN, seed=4), sets, start=weights))
    export_weights(Training(replace(PLAIN, seed=5), FasterRCNNTrainer()).averaged, weights, notes={})
    ledger.do(training_job("fasterrcnn_small", PLAIN, sets, start=weights))
    assert epochs == [1, 2, 2, 1, 2, 1, 2]


def test_shipped_weights_are_what_the_snapshot_computes(tmp_path: Path) -> None:
    training = Training(PLAIN, FasterRCNNTrainer())
    path = tmp_path / "w.safetensors"
    export_weights(training.averaged, path, notes={"seed": "3"})
    detector = training.snapshot()
    assert isinstance(detector, RCNNDetector)
    stored, model = read_weights(path), detector.model.state_dict()
    assert path.stat().st_size < 12_000_000
    for name, value in stored.items():
        assert torch.equal(value.float(), model[name]), name


class Noting(FasterRCNNTrainer):
    """Notes how each epoch begins, and learns from a loss of one weight."""

    def __init__(self) -> None:
        self.begun: list[tuple[int | None, bool]] = []

    def build(self) -> torch.nn.Module:
        return torch.nn.Linear(2, 1)

    def begin_epoch(self, model: torch.nn.Module, *, side: int | None, final: bool) -> None:
        self.begun.append((side, final))

    def losses(self, model: torch.nn.Module, pictures: object, targets: object, generator: object) -> dict[str, Tensor]:
        return {"loss": 100 * model(torch.ones(1, 2)).sum()}


def test_epochs_begin_as_the_configuration_says() -> None:
    config = replace(PLAIN, epochs=5, low_resolution=64, low_resolution_fraction=0.4, final_fraction=0.2)
    trainer = Noting()
    training = Training(config, trainer)
    for _ in range(5):
        training.run_epoch(few())
    assert trainer.begun == [(64, False), (64, False), (None, False), (None, False), (None, True)]


def test_the_learning_rate_warms_up_and_follows_a_cosine() -> None:
    training = Training(replace(PLAIN, learning_rate=2.0, warm_up=0.1), Noting())

    def rate(done: float) -> float:
        training._set_rate(done)
        return float(training._optimiser.param_groups[0]["lr"])

    assert [rate(done) for done in (0.0, 0.05, 0.1)] == pytest.approx([0.04, 1.02, 2.0])
    assert [rate(done) for done in (0.55, 1.0)] == pytest.approx([2 * (0.005 + 0.995 / 2), 0.01])


def test_only_matrices_decay() -> None:
    groups = Training(replace(PLAIN, weight_decay=0.3), Noting())._optimiser.param_groups
    assert [(group["weight_decay"], [p.ndim for p in group["params"]]) for group in groups] == [(0.3, [2]), (0.0, [1])]


def test_the_average_keeps_most_of_itself() -> None:
    training = Training(replace(PLAIN, ema_decay=0.9, warm_up=0.01), Noting())
    before = {name: value.clone() for name, value in training.averaged.items()}
    training.run_epoch(few()[:2])
    for name, value in training.model.state_dict().items():
        torch.testing.assert_close(training.averaged[name], 0.9 * before[name] + 0.1 * value)
        assert not torch.equal(value, before[name])


def test_long_gradients_are_scaled_down() -> None:
    training = Training(replace(PLAIN, max_gradient_norm=5.0), Noting())
    training.run_epoch(few()[:2])
    gradients = torch.cat([p.grad.flatten() for p in training.model.parameters() if p.grad is not None])
    assert float(gradients.norm()) == pytest.approx(5.0, rel=1e-4)


def test_pictures_change_from_epoch_to_epoch() -> None:
    training = Training(PLAIN, Noting())

    def first_epoch_s() -> Tensor:
        torch.manual_seed(0)
        return torch.stack(next(iter(training._batches(few())))[0])

    one, again = first_epoch_s(), first_epoch_s()
    training.epoch = 1
    assert torch.equal(one, again)
    assert not torch.equal(one, first_epoch_s())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n, t: t["model/weight"].fill_(torch.nan), "finite numbers in model/weight"),
        (lambda n, t: t["optimiser/0/exp_avg"].fill_(torch.inf), "finite numbers in optimiser/0/exp_avg"),
        (
            lambda n, t: t.update({"average/weight": torch.zeros(1, 3)}),
            r"average, weight: expected \(1, 2\) of float32",
        ),
        (lambda n, t: t.pop("model/bias"), "model, bias: expected .*, got none"),
        (lambda n, t: t.pop("optimiser/0/step"), "optimiser 0, step: expected .*, got none"),
        (lambda n, t: t.update({"optimiser/1/exp_avg": torch.zeros(7)}), "optimiser 1, exp_avg: expected"),
        (lambda n, t: n.update(epoch=3), "epoch: expected a whole number from 0 to 2, got 3"),
        (lambda n, t: n.update(epoch="one"), "epoch: expected a whole number"),
        (
            lambda n, t: n.update(history=[{"epoch": 2}]),
            r"history\[0\]: epoch: expected a whole number from 0 to 1, got 2",
        ),
        (lambda n, t: n.update(history=[7]), "history: expected a list of objects"),
    ],
)
def test_checkpoints_whose_parts_do_not_fit_are_refused(tmp_path: Path, change: Change, words: str) -> None:
    training = Training(PLAIN, Noting())
    training.run_epoch(few())
    training.save(tmp_path)
    assert Training.resume(tmp_path, PLAIN, Noting()).epoch == 1
    changed(tmp_path / "checkpoint.safetensors", change)
    with pytest.raises(DetectorError, match=words):
        Training.resume(tmp_path, PLAIN, Noting())


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.safetensors").write_bytes(b"something else")
    with pytest.raises(DetectorError, match="a checkpoint of this run"):
        Training.resume(tmp_path, PLAIN, Noting())


CONFIG = TrainConfig(pretraining=1, epochs=2, batch=2, low_resolution=64, low_resolution_fraction=0.5)


@pytest.mark.parametrize("name", get_args(SmallDetector))
def test_each_trainer_takes_a_step_and_makes_a_detector(name: str) -> None:
    if name.startswith("yolo") and importlib.util.find_spec("ultralytics") is None:
        pytest.skip("needs the extra yolo")
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
    (candidates,) = detector.candidates(with_object.image[None].float() / 255)
    assert candidates.scores.shape[1] == len(SMALL_CLASSES)
    assert bool(torch.isfinite(candidates.boxes).all())


def test_the_shipped_weights_are_small() -> None:
    assert 0 < SMALL_WEIGHTS.stat().st_size <= 10_000_000


@pytest.mark.parametrize(("wrong", "better"), [(0, 2), (3, 1)])
def test_the_best_epoch_has_few_false_positives_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: int, better: int
) -> None:
    """More objects are found in the second epoch, and perhaps more is reported where there is none."""
    training = Training(TrainConfig(), FasterRCNNTrainer())
    car, nothing = reported((HERE, 0.9, "car")), reported()
    with_object, empty = [picture((HERE, 1))] * 10, [picture()] * 10
    for epoch, (right, imagined) in enumerate([(7, 0), (8, wrong)], start=1):
        on_empty = [car] * imagined + [nothing] * (10 - imagined)
        told = [*[car] * right, *[nothing] * (10 - right), *[nothing] * 10, *on_empty]
        monkeypatch.setattr(training, "snapshot", lambda told=told: TableDetector(*told))
        training.epoch = epoch
        training.history.append({"epoch": epoch, **steps.validated(training, [*with_object, *empty], tmp_path)})
    assert [record["map"] for record in training.history] == [0.7, 0.8]
    with safe_open(tmp_path / "best.safetensors", framework="pt") as file:
        assert file.metadata()["epoch"] == str(better)


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
    weights = (tmp_path / "out" / "best.safetensors").read_bytes()
    assert cli.main([*words, "--force"]) == 0, "nothing is left to do"
    assert "epoch" not in capsys.readouterr().err
    assert (tmp_path / "out" / "best.safetensors").read_bytes() == weights
