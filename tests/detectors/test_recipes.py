"""The recipes of the small detectors, on small inputs, and the figures by which
detectors are compared.
"""

import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks.detectors.base import Detections
from attacks.detectors.catalogue import COCO_CLASSES, SMALL_CLASSES
from attacks.detectors.registry import load_detector
from scenes.recipes import detector_training, evaluate_detectors
from scenes.recipes.detector_pictures import (
    BACKGROUNDS,
    LabelledPicture,
    PictureSet,
    SplatSettings,
    ViewingConditions,
    made,
)
from scenes.recipes.evaluate_detectors import confidences_at, detector_figures, look_at
from tests.fakes import ColourDetector

HERE = [10.0, 10.0, 50.0, 50.0]
THERE = [60.0, 60.0, 90.0, 90.0]
AWAY = [0.0, 60.0, 30.0, 90.0]


def picture(*labels: int) -> LabelledPicture:
    """Objects of these labels, all in one place, seen from 50 degrees."""
    boxes = torch.tensor([HERE] * len(labels)).reshape(-1, 4)
    seen = (ViewingConditions(50.0, 6.0, 4.0),) * len(labels)
    image = torch.full((100, 100, 3), 51, dtype=torch.uint8)
    return LabelledPicture(image, boxes, torch.tensor(labels, dtype=torch.int64), seen)


def reported(*rows: tuple[list[float], float, str]) -> Detections:
    boxes = torch.tensor([box for box, _, _ in rows]).reshape(-1, 4)
    return Detections(
        boxes,
        torch.tensor([score for _, score, _ in rows]),
        tuple(label for _, _, label in rows),
    )


class Scripted(ColourDetector):
    classes = COCO_CLASSES

    def __init__(self, rows: Sequence[Detections]) -> None:
        self.rows = list(rows)

    def detect(self, images: Tensor) -> list[Detections]:
        part = self.rows[: len(images)]
        self.rows = self.rows[len(images) :]
        return part


def test_figures_done_by_hand() -> None:
    screen = (THERE, 0.9, "tv")
    results = [
        # a second one on the object is false
        reported((HERE, 0.8, "car"), (HERE, 0.7, "car"), screen),
        reported((HERE, 0.6, "car"), (AWAY, 0.9, "kite")),
        reported((HERE, 0.8, "truck")),
        reported((HERE, 0.3, "car")),
    ]
    cars = look_at(Scripted(results), [picture(1)] * 4)
    empty = look_at(
        Scripted([reported(screen)] * 2 + [reported()] * 6), [picture()] * 8
    )
    figures = detector_figures({"path traced": cars, "background: park": empty}, 0.5)
    on_cars = figures["sets"]["path traced"]
    nothing = figures["sets"]["background: park"]
    assert (on_cars["found"]["car"]["successes"], on_cars["found"]["car"]["total"]) == (
        2,
        4,
    )
    # by confidence: right, false, right, right
    assert on_cars["ap"] == {"car": pytest.approx((1 + 0.75 + 0.75) / 4)}
    assert on_cars["reported_as"] == {"car": {"truck": 1}}
    assert on_cars["other_classes"] == {"kite": 1, "truck": 1}
    assert on_cars["false_positives"]["by_class"]["car"] == 1
    bins = {
        part["from"]: part["total"] for part in on_cars["found_by"]["elevation"]["all"]
    }
    assert bins == {0: 0, 15: 0, 30: 0, 45: 4, 60: 0, 75: 0}
    wrong = nothing["false_positives"]
    assert (wrong["number"], wrong["per_picture"]) == (2, 0.25)
    assert wrong["interval"] == pytest.approx([0.2422 / 8, 7.2247 / 8], abs=1e-4)
    assert figures["false_positives"]["all"]["number"] == 4
    assert "map" not in nothing
    assert confidences_at(empty) == {
        "0.01": pytest.approx(0.9),
        "0.1": pytest.approx(0.9),
        "1": None,
    }
    assert confidences_at(empty)["0.1"] > float(torch.tensor(0.9))  # type: ignore[operator]


@pytest.mark.nightly
def test_pictures_are_made_once_and_reproduced(tmp_path: Path) -> None:
    tiny = PictureSet(
        split="held-out",
        size=32,
        samples=1,
        shots=1,
        scenes=1,
        empty=0.0,
        pair=0.0,
        street=0.0,
    )
    splat = SplatSettings(
        views=2, samples=1, objects=300, surroundings=300, sky=50, steps=0, pictures=1
    )
    sets = [
        tiny,
        PictureSet(scenes=1, size=32, samples=1, splat=splat),
        *(
            PictureSet(
                scenes=1, size=32, samples=1, shots=1, objects=False, around=kind
            )
            for kind in BACKGROUNDS
        ),
    ]
    first = made(tmp_path, sets, processes=0)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = made(tmp_path, sets, processes=0)
    assert times == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert torch.equal(
        made(tmp_path / "new", [tiny], processes=0)[0][0].image, first[0][0].image
    )
    assert [len(part) for part in first] == [1] * 7
    assert all(
        torch.equal(a[0].image, b[0].image) for a, b in zip(first, again, strict=True)
    )
    assert all(not len(part[0].labels) for part in first[2:])
    assert len(first[0][0].conditions) == len(first[0][0].labels) == 1


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["fasterrcnn_small", "yolov8n_small"])
def test_a_small_detector_is_trained_and_scored(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name.startswith("yolo") and importlib.util.find_spec("ultralytics") is None:
        pytest.skip("needs the extra yolo")
    recipe = importlib.import_module(f"scenes.recipes.train_{name}")
    (trainer,) = (
        value
        for key, value in vars(recipe).items()
        if key.endswith("Trainer") and key != "Trainer"
    )
    few = [PictureSet(scenes=2, shots=2, size=64, samples=1, street=0.0, empty=0.0)]
    monkeypatch.setattr(detector_training, "training_sets", lambda scale: (few, few))
    monkeypatch.setattr(
        evaluate_detectors, "held_out_sets", lambda **counts: {"path traced": few[0]}
    )
    data = ["--data", str(tmp_path / "data"), "--processes", "0"]
    out = tmp_path / "out"
    flags = [
        "--epochs=2",
        "--batch=2",
        "--pretraining=1",
        "--validate-every=1",
        "--low-resolution=64",
    ]
    monkeypatch.setattr(sys, "argv", ["train", *data, "--out", str(out), *flags])
    detector_training.main(trainer(), detector_training.TrainConfig(), None)
    history = json.loads((out / "curves.json").read_text())["history"]
    assert [record["epoch"] for record in history] == [1, 2]
    assert all(
        value == value for record in history for value in record["losses"].values()
    )
    assert (
        load_detector(name, weights=out / "best.safetensors").classes == SMALL_CLASSES
    )
    words = [
        *data,
        "--detectors",
        name,
        "--weights",
        str(out / "best.safetensors"),
        "--out",
        str(tmp_path / "r.json"),
    ]
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    evaluate_detectors.main()
    assert (
        json.loads((tmp_path / "r.json").read_text())["detectors"][name]["sets"][
            "path traced"
        ]["pictures"]
        == 4
    )
