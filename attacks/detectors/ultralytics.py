"""Adapter to YOLOv3, v5, v8 and 11 of ultralytics, which the user installs (extra
`yolo`); nothing else imports it.

Its licence is AGPL-3.0, which is stricter than that of this project: read it before you
build on this module.
"""

import atexit
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from PIL import Image
from torch import Tensor, nn

from attacks.detectors.base import Candidates, Detections, check_images, eight_bits
from attacks.detectors.catalogue import (
    COCO_CLASSES,
    SMALL_CLASSES,
    SMALL_SIDE,
    SMALL_YOLO_WEIGHTS,
    DetectorError,
    download_advice,
)
from attacks.detectors.weights import FrozenModel, apply_weights, one_line, read_weights
from mi_splat.errors import install

# Before the package is imported, which would otherwise write settings into the home and
# ask a server for news.
os.environ.setdefault("YOLO_OFFLINE", "true")
os.environ.setdefault("YOLO_AUTOINSTALL", "false")
os.environ.setdefault("YOLO_VERBOSE", "false")
# a folder of its own: one with a name that others can guess may be theirs
if "YOLO_CONFIG_DIR" not in os.environ:
    os.environ["YOLO_CONFIG_DIR"] = tempfile.mkdtemp(prefix="mi-splat-yolo-")
    atexit.register(shutil.rmtree, os.environ["YOLO_CONFIG_DIR"], ignore_errors=True)

_open = Image.open
_save = torch.save
try:
    from ultralytics.cfg import get_cfg
    from ultralytics.data.augment import LetterBox
    from ultralytics.nn.tasks import DetectionModel, torch_safe_load
    from ultralytics.utils.nms import non_max_suppression
    from ultralytics.utils.ops import scale_boxes
except ImportError as error:
    raise DetectorError.of(
        "detector",
        "the package ultralytics, which is AGPL-3.0, and what its OpenCV needs",
        str(error),
        f"{install('yolo')}; for libGL on Debian: apt install libgl1 libglib2.0-0",
    ) from error
finally:
    # The package puts functions of its own in the place of these, for the whole
    # process; nothing here wants them.
    Image.open = _open
    torch.save = _save

SMALL = "yolov8n_small"
"""Name of the project's own detector."""
USUAL_SIDE = 640
"""Longer image side, in pixels, that the published ones work at; the small one works at
`SMALL_SIDE`.
"""
_MIN_CONFIDENCE = 0.25
_MAX_IOU = 0.7
_MAX_DETECTIONS = 300
"""The library's own settings of prediction: least confidence, largest IoU of two boxes,
most boxes.
"""
_NAME = re.compile(r"(?P<family>yolov?\d+)(?P<size>[nsmlx]?)")
"""How the library names a family of architectures (yolov3, yolov8, yolo11), and a size
of it if there are several.
"""


class YOLODetector(FrozenModel):
    """A frozen detector of the library behind the `Detector` interface."""

    def __init__(
        self,
        name: str,
        model: nn.Module,
        classes: Sequence[str],
        *,
        side: int,
        min_confidence: float = _MIN_CONFIDENCE,
    ) -> None:
        """Wrap `model`."""
        super().__init__(name, model, classes)
        self.side = side
        self.min_confidence = min_confidence
        strides: Any = model.stride
        self._stride = int(strides.max())

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every cell of the three grids, before threshold and non-maximum
        suppression.
        """
        check_images(images)
        height, width = images.shape[1:3]
        inner, (left, top, right, bottom) = _frame(
            (height, width), self.side, self._stride
        )
        planes = F.interpolate(
            images.permute(0, 3, 1, 2), size=inner, mode="bilinear", align_corners=False
        )
        out = self._decoded(F.pad(planes, (left, right, top, bottom), value=114 / 255))
        centre = out[:, :, :2]
        size = out[:, :, 2:4]
        corners = torch.cat([centre - size / 2, centre + size / 2], -1)
        gain = corners.new_tensor([inner[1] / width, inner[0] / height] * 2)
        pixels = (corners - corners.new_tensor([left, top, left, top])) / gain
        boxes = torch.minimum(
            pixels.clamp(min=0), pixels.new_tensor([width, height, width, height])
        )
        return [
            Candidates.of_all_classes(*parts)
            for parts in zip(boxes, out[:, :, 4:], strict=True)
        ]

    def detect(self, images: Tensor) -> list[Detections]:
        """What the library's own `predict` gives for the images at 8 bits."""
        check_images(images)
        frame = LetterBox((self.side, self.side), auto=True, stride=self._stride)
        pictures = eight_bits(images).cpu().numpy()
        planes = torch.from_numpy(
            np.stack([frame(image=picture) for picture in pictures])
        ).permute(0, 3, 1, 2)
        with torch.no_grad():
            raw = self._decoded(planes.to(images.device).float() / 255).transpose(1, 2)
        kept = non_max_suppression(
            raw, self.min_confidence, _MAX_IOU, max_det=_MAX_DETECTIONS
        )
        detections = []
        for rows in kept:
            boxes = scale_boxes(planes.shape[2:], rows[:, :4], images.shape[1:3])
            labels = tuple(self.classes[int(number)] for number in rows[:, 5])
            detections.append(Detections(boxes, rows[:, 4], labels))
        return detections

    def _decoded(self, planes: Tensor) -> Tensor:
        """(B, A, 4 + C): centre and size in the network's pixels, and confidences."""
        out = self.model(planes)
        # newer ones give the raw maps as well
        decoded: Tensor = out[0] if isinstance(out, (list, tuple)) else out
        return decoded.transpose(1, 2)


def _frame(
    shape: tuple[int, int], side: int, stride: int
) -> tuple[tuple[int, int], tuple[int, int, int, int]]:
    """The library's letterbox: (height, width) of the scaled image, and what is added
    left, top, right and bottom.

    The longer side becomes `side`; the shorter one is filled up to a multiple of the
    stride.
    """
    gain = min(side / shape[0], side / shape[1])
    height, width = (max(round(length * gain), 1) for length in shape)
    across = (side - width) % stride / 2
    down = (side - height) % stride / 2
    left = round(across - 0.1)
    top = round(down - 0.1)
    return (height, width), (left, top, round(across + 0.1), round(down + 0.1))


def build(size: str, classes: int, *, family: str = "yolov8") -> nn.Module:
    """A detector of random weights; `size` is one of n, s, m, l, x, and empty for
    "yolov3", which has one.
    """
    model: nn.Module = DetectionModel(
        f"{family}{size}.yaml", ch=3, nc=classes, verbose=False
    )
    model.args = get_cfg()  # which its loss reads
    return model


def load(name: str, weights: Path | None = None) -> YOLODetector:
    """The project's own small YOLOv8, or one of the library's COCO detectors."""
    small = name == SMALL
    path = _shipped() if small and weights is None else weights
    side = SMALL_SIDE if small else USUAL_SIDE
    if path is None or not (small or Path(path).suffix == ".safetensors"):
        model = _unpickled(name, path)
        return YOLODetector(
            name,
            model,
            [model.names[number] for number in sorted(model.names)],
            side=side,
        )
    family, size = _parts(name)
    classes = SMALL_CLASSES if small else COCO_CLASSES
    model = build(size, len(classes), family=family)
    apply_weights(model, read_weights(Path(path)), path)
    return YOLODetector(name, model, classes, side=side)


def _shipped() -> Path:
    if not SMALL_YOLO_WEIGHTS.is_file():
        do = (
            "pass as weights scenes/detectors/yolov8n_small.safetensors of a checkout,"
            " or train it"
        )
        error = DetectorError.of(
            f"weights of {SMALL}", "a file", "none: the wheel has none", do
        )
        raise error.hinted("--weights")
    return SMALL_YOLO_WEIGHTS


def _unpickled(name: str, weights: Path | None) -> Any:
    """The model in one of the library's checkpoints."""
    source = f"{name}.pt" if weights is None else str(weights)
    if weights is not None and not Path(weights).is_file():
        raise DetectorError.of(
            f"weights {weights}", "a file", "nothing there", "check the path"
        )
    try:
        checkpoint, _ = torch_safe_load(source, safe_only=True)
        model = checkpoint.get("ema") or checkpoint["model"]
        if not isinstance(model, DetectionModel):
            raise TypeError(f"a {type(model).__name__}")
    except Exception as error:  # what the library raises has no common base
        reason = one_line(error)
        expected = (
            "a detection checkpoint of ultralytics, or a network that reaches its hub"
        )
        raise DetectorError.of(
            f"weights of {name}", expected, reason, download_advice("file")
        ) from error
    match, (family, _) = (
        _NAME.match(Path(str(model.yaml.get("yaml_file", ""))).stem),
        _parts(name),
    )
    if match is not None and match["family"] != family:
        do = f"load them as a {match['family']}, or pass weights of {name}"
        raise DetectorError.of(
            f"weights of {name}", f"a {family}", f"a {match['family']}", do
        )
    return model.float()


def _parts(name: str) -> tuple[str, str]:
    """The family and the size in the name of a detector."""
    parts = _NAME.match(name)
    assert parts is not None, name
    return parts["family"], parts["size"]
