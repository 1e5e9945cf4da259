"""The adapter to YOLOv3, YOLOv5, YOLOv8 and YOLO11 against the library itself, with
random weights.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, UnidentifiedImageError
from safetensors.torch import save_file
from torch import nn

from attacks.detectors import DetectorError, load_detector
from attacks.detectors.base import Detector
from attacks.detectors.catalogue import COCO_CLASSES, SMALL_CLASSES
from attacks.testing import check_detector
from tests.detectors.contract import pictures

try:
    from attacks.detectors import ultralytics
except DetectorError as error:
    # ultralytics is not installed, or not usable without some system library
    pytest.skip(str(error), allow_module_level=True)


def random_model(classes: int = 8, family: str = "yolov8") -> Any:
    """Random weights that see something: norms have met a few batches, and confidences
    are spread.
    """
    torch.manual_seed(12)
    model: Any = ultralytics.build("n", classes, family=family)
    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None
        norm.train()
    with torch.no_grad():
        for _ in range(4):
            model(torch.rand(2, 3, 64, 64))
        # Otherwise the outputs are so large that rounding decides which boxes are
        # suppressed, and where they are.
        for boxes, classes_of in zip(
            model.model[-1].cv2, model.model[-1].cv3, strict=True
        ):
            boxes[-1].weight *= 0.02
            classes_of[-1].weight *= 0.03
            classes_of[-1].bias.zero_()
    return model.eval()


@pytest.fixture(scope="module", params=["yolov8", "yolo11"])
def model(request: pytest.FixtureRequest) -> Any:
    return random_model(family=str(request.param))


@pytest.fixture(scope="module")
def detector(model: Any) -> ultralytics.YOLODetector:
    return ultralytics.YOLODetector("yolov8n_small", model, SMALL_CLASSES, side=128)


@pytest.mark.parametrize("size", [(128, 128), (90, 160), (75, 50), (300, 211)])
def test_detections_are_those_of_the_library(
    detector: ultralytics.YOLODetector, model: Any, size: tuple[int, int]
) -> None:
    agrees_with_the_library(detector, model, size)


def agrees_with_the_library(
    detector: ultralytics.YOLODetector, model: Any, size: tuple[int, int]
) -> None:
    from ultralytics import YOLO

    images = pictures(*size)
    library: Any = YOLO("yolov8n.yaml")
    library.model = model
    bgr = [
        (image.numpy() * 255).round().astype(np.uint8)[:, :, ::-1].copy()
        for image in images
    ]
    wanted = library.predict(bgr, imgsz=128, verbose=False)
    for detections, other in zip(detector.detect(images), wanted, strict=True):
        assert len(detections) == len(other.boxes) > 0
        # The library fuses convolutions and norms, which moves the last digits.
        assert torch.allclose(detections.boxes, other.boxes.xyxy, atol=0.1)
        assert torch.allclose(detections.scores, other.boxes.conf, atol=1e-4)
        assert detections.labels == tuple(
            detector.classes[int(number)] for number in other.boxes.cls
        )


@pytest.mark.parametrize("size", [(128, 128), (90, 160), (75, 50)])
def test_candidates_are_what_detections_come_from(
    detector: Detector, size: tuple[int, int]
) -> None:
    images = pictures(*size)
    for candidates, reported in zip(
        detector.candidates(images), detector.detect(images), strict=True
    ):
        best, label = candidates.scores.max(1)
        away = (candidates.boxes[:, 0] - reported.boxes[0]).abs().amax(1)
        near = int((away + 30 * (best - reported.scores[0]).abs()).argmin())
        # Rounding to 8 bits and OpenCV's fixed-point scaling stand between the two.
        assert float(away[near]) < 1.5
        assert float(best[near]) == pytest.approx(float(reported.scores[0]), abs=0.05)
        assert SMALL_CLASSES[int(label[near])] == reported.labels[0]


def test_the_contract_is_kept(detector: Detector) -> None:
    check_detector(detector)


def test_the_floor_is_that_of_the_constructor(
    detector: ultralytics.YOLODetector, model: Any
) -> None:
    (all_of_them,) = detector.detect(pictures(96, 128, 1))
    floor = float(all_of_them.scores.median())
    other = ultralytics.YOLODetector(
        "x", model, SMALL_CLASSES, side=128, min_confidence=floor
    )
    assert (detector.min_confidence, other.min_confidence) == (0.25, floor)
    assert other.fingerprint == detector.fingerprint
    (detections,) = other.detect(pictures(96, 128, 1))
    assert 0 < len(detections) < len(all_of_them)
    assert float(detections.scores.min()) >= floor


@pytest.mark.parametrize(
    ("family", "name"),
    [("yolov8", "yolov8n"), ("yolo11", "yolo11n"), ("yolov5", "yolov5nu")],
)
def test_the_library_s_own_checkpoints_are_read(
    tmp_path: Path, family: str, name: str
) -> None:
    model = random_model(80, family)
    model.names = {number: f"thing {number}" for number in range(80)}
    path = tmp_path / f"{name}.pt"
    torch.save({"model": model.half(), "ema": None, "train_args": {}}, path)
    loaded = load_detector(name, weights=path)
    assert loaded.classes[3] == "thing 3"
    assert isinstance(loaded, ultralytics.YOLODetector)
    assert loaded.side == 640
    other = "yolo11n" if family == "yolov8" else "yolov8n"
    with pytest.raises(
        DetectorError,
        match=f"weights of {other}: expected a {other[:-1]}, got a {family}",
    ):
        load_detector(other, weights=path)


def test_yolov3_has_one_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a hundred million numbers, so that a YOLOv5 stands in for it."""
    asked = list[tuple[str, int, str]]()
    stand_in = random_model(80, "yolov5")

    def build(size: str, classes: int, *, family: str) -> Any:
        asked.append((size, classes, family))
        return stand_in

    monkeypatch.setattr(ultralytics, "build", build)
    save_file(
        {key: value.contiguous() for key, value in stand_in.state_dict().items()},
        tmp_path / "w.safetensors",
    )
    loaded = load_detector("yolov3u", weights=tmp_path / "w.safetensors")
    assert (loaded.name, loaded.classes, asked) == (
        "yolov3u",
        COCO_CLASSES,
        [("", 80, "yolov3")],
    )
    agrees_with_the_library(
        ultralytics.YOLODetector("x", stand_in, COCO_CLASSES, side=128),
        stand_in,
        (75, 50),
    )


def test_published_yolo11_is_read_from_tensors(tmp_path: Path) -> None:
    model = random_model(80, "yolo11")
    path = tmp_path / "w.safetensors"
    save_file(
        {key: value.contiguous() for key, value in model.state_dict().items()}, path
    )
    loaded = load_detector("yolo11n", weights=path)
    assert loaded.classes == COCO_CLASSES
    (expected,) = ultralytics.YOLODetector(
        "x", model, COCO_CLASSES, side=640
    ).candidates(pictures(40, 60, 1))
    (candidates,) = loaded.candidates(pictures(40, 60, 1))
    assert torch.equal(expected.scores, candidates.scores)
    assert torch.equal(expected.boxes, candidates.boxes)
    with pytest.raises(
        DetectorError,
        match=r"expected the \d+ tensors of DetectionModel, got \d+ missing",
    ):
        load_detector("yolov8n", weights=path)


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "evil.pt"
    torch.save({"model": Evil()}, path)
    with pytest.raises(DetectorError, match="weights of yolov8n"):
        load_detector("yolov8n", weights=path)
    assert not (tmp_path / "ran").exists()


def test_missing_weights_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        ultralytics, "SMALL_YOLO_WEIGHTS", tmp_path / "none.safetensors"
    )
    with pytest.raises(DetectorError, match="the wheel has none"):
        load_detector("yolov8n_small")


def test_other_libraries_stay_as_they_are(tmp_path: Path) -> None:
    """The package patches Pillow when it is imported, and then asks for another package
    where an image is broken.
    """
    assert Image.open.__module__ == "PIL.Image"
    assert torch.save.__module__ == "torch.serialization"
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(UnidentifiedImageError):
        Image.open(tmp_path / "broken.png")
