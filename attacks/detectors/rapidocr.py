"""A reader of text as a detector: RapidOCR (extra `ocr`), which reports a stop sign
where it reads the word on it.

It learnt to read, not to detect, so it shares neither data nor architecture with the
detectors. It has no gradient: it evaluates, and attacks by queries alone can search
with it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from attacks.detectors.base import Detector, eight_bits
from attacks.detectors.catalogue import READER_WORDS, DetectorError
from attacks.detectors.wrapping import wrap_detector
from mi_splat.errors import install

_SIGN = (1.22, 2.45)
"""Width and height of a sign over those of the box of its word, as on the clean sign of
scenes/stop_sign.xml.
"""
_MIN_CONFIDENCE = 0.5
"""The package's own limit of what it reports."""


class _Reader(nn.Module):
    """Images (B, H, W, 3) of 8 bits to the texts in each, with their corners (4, 2)
    in pixels and confidences.
    """

    def __init__(self) -> None:
        super().__init__()
        try:
            import rapidocr_onnxruntime as package
        except ImportError as error:
            needs = "the package rapidocr-onnxruntime, and what its OpenCV needs"
            raise DetectorError.of(
                "detector rapidocr", needs, str(error), install("ocr")
            ) from error
        # One thread, so that equal images have equal texts; and what is unsure, since
        # queries search with it.
        self._engine: Any = package.RapidOCR(
            text_score=0.0, intra_op_num_threads=1, inter_op_num_threads=1
        )
        for path in sorted((Path(package.__file__).parent / "models").glob("*.onnx")):
            digest = hashlib.sha256(path.read_bytes()).digest()
            self.register_buffer(
                path.stem.replace(".", "_"),
                torch.frombuffer(bytearray(digest), dtype=torch.uint8),
            )

    def forward(self, images: Tensor) -> list[list[tuple[Any, str, float]]]:
        # BGR
        return [
            self._engine(picture[..., ::-1].copy())[0] or []
            for picture in images.cpu().numpy()
        ]


def load(name: str, weights: Path | None = None) -> Detector:
    """The reader with the networks of its package."""
    if weights is not None:
        raise DetectorError.of(
            f"weights {weights}",
            "none: the package has them",
            "a file",
            "leave --weights out",
        )
    classes = tuple(READER_WORDS.values())
    return wrap_detector(
        _Reader(),
        classes,
        _signs,
        name=name,
        prepare=_without_gradient,
        min_confidence=_MIN_CONFIDENCE,
    )


def _without_gradient(images: Tensor) -> Tensor:
    if images.requires_grad and torch.is_grad_enabled():
        do = "attack another detector, or search with --optimiser random or square"
        raise DetectorError.of(
            "detector rapidocr", "no gradient requested from it", "images with one", do
        )
    return eight_bits(images)


def _signs(
    readings: list[list[tuple[Any, str, float]]], size: tuple[int, int]
) -> Iterator[tuple[Tensor, Tensor]]:
    """A box and a confidence for each word that stands on a sign."""
    words = list(READER_WORDS)
    for texts in readings:
        boxes = torch.zeros(len(texts), 4)
        scores = torch.zeros(len(texts), len(words))
        for number, (corners, text, score) in enumerate(texts):
            boxes[number] = torch.from_numpy(
                _sign_box(np.asarray(corners, dtype=np.float64), size)
            )
            word = re.sub("[^A-Z]", "", text.upper())
            if word in words:
                scores[number, words.index(word)] = float(score)
        yield boxes, scores


def _sign_box(corners: Any, size: tuple[int, int]) -> Any:
    """(4,) pixels of the sign about a word, whose corners (4, 2) begin at the upper
    left and go clockwise.

    An octagon is nearly a circle: seen at a slant it is nearly an ellipse with the
    word's directions for axes.
    """
    across = _SIGN[0] * (corners[1] + corners[2] - corners[0] - corners[3]) / 4
    down = _SIGN[1] * (corners[2] + corners[3] - corners[0] - corners[1]) / 4
    half = np.hypot(across, down)
    middle = corners.mean(0)
    return np.concatenate([middle - half, middle + half]).clip(
        0, [size[1], size[0]] * 2
    )
