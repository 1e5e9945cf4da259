"""Any torch detector behind the interface: against adapters of libraries, and against
outputs that are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.detectors import DetectorError, load_detector, wrap_detector
from attacks.objectives.suppression import hide
from attacks.testing import check_detector
from mi_splat.errors import InvalidValueError
from tests.detectors.contract import pictures
from tests.fakes import blobs, camera, toy_scene

Pairs = Iterator[tuple[Tensor, Tensor]]


def corners(boxes: Tensor) -> Tensor:
    """Of centre and size."""
    return torch.cat(
        [boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], -1
    )


@pytest.mark.slow
def test_like_torchvision() -> None:
    """Lists of images in, a dict of boxes, scores and labels for each out."""
    known = load_detector("fasterrcnn_small")
    model: Any = known.model  # type: ignore[attr-defined]

    def decode(outputs: Any, size: tuple[int, int]) -> Pairs:
        for seen in outputs:
            yield (
                seen["boxes"],
                seen["scores"][:, None]
                * F.one_hot(seen["labels"] - 1, len(known.classes)),
            )

    def as_list(images: Tensor) -> list[Tensor]:
        return list(images.permute(0, 3, 1, 2))

    ours = wrap_detector(
        model,
        known.classes,
        decode,
        prepare=as_list,
        min_confidence=known.min_confidence,
    )
    images = pictures(96, 128)
    for seen, expected in zip(ours.detect(images), known.detect(images), strict=True):
        assert seen.labels == expected.labels
        torch.testing.assert_close(seen.scores, expected.scores)
        torch.testing.assert_close(seen.boxes, expected.boxes)
    assert ours.fingerprint == known.fingerprint
    model.roi_heads.score_thresh = 0.0
    model.roi_heads.nms_thresh = 1.0
    model.roi_heads.detections_per_img = 10_000
    (scores,) = (seen.scores for seen in ours.candidates(images[:1]))
    (all_scores,) = (seen.scores for seen in known.candidates(images[:1]))
    for label in range(len(known.classes)):
        torch.testing.assert_close(scores[:, label].max(), all_scores[:, label].max())


class Plain(nn.Module):
    """Three convolutions: a score of each class and a box at every fourth pixel."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.features = nn.Conv2d(3, 8, 9, stride=4, padding=4)
        self.scores = nn.Conv2d(8, 2, 1)
        self.drop = nn.Dropout(0.5)

    def forward(self, images: Tensor) -> Tensor:
        logits: Tensor = self.scores(self.drop(torch.tanh(self.features(images - 0.5))))
        return logits


def plain(logits: Tensor, size: tuple[int, int]) -> Pairs:
    y, x = torch.meshgrid(
        *(4.0 * torch.arange(side) for side in logits.shape[2:]), indexing="ij"
    )
    middle = torch.stack([x, y], -1).reshape(-1, 2)
    boxes = torch.cat([middle - 8, middle + 8], -1)
    return ((boxes, picture.flatten(1).T.sigmoid()) for picture in logits)


def test_plain_torch_is_attacked() -> None:
    detector = wrap_detector(
        Plain(), ("car", "person"), plain, name="plain", min_confidence=0.4, max_iou=0.3
    )
    check_detector(detector)
    scene, mask = toy_scene()
    config = DaggerConfig(steps=3, noise_draws=0, early_stop=False)
    result = attack(
        scene, mask, camera(), detector, hide(), render=blobs, config=config
    )
    assert result.detectors == ("plain",)
    assert result.trace[-1].loss < result.trace[0].loss


def test_thresholds_suppression_and_another_program_s_report() -> None:
    images = pictures(64, 64)
    considered = wrap_detector(Plain(), ("car", "person"), plain).candidates(images)
    least = float(torch.cat([seen.scores for seen in considered]).median())
    detector = wrap_detector(
        Plain(), ("car", "person"), plain, min_confidence=least, max_iou=0.3
    )
    for seen, before in zip(detector.detect(images), considered, strict=True):
        assert 0 < len(seen) < int((before.scores >= least).sum())
        assert float(seen.scores.min()) >= least
    told = wrap_detector(
        Plain(),
        ("car", "person"),
        plain,
        detect=lambda images: detector.detect(images)[:1],
    )
    assert len(told.detect(images)) == 1
    turned = wrap_detector(
        Plain(),
        ("car", "person"),
        plain,
        prepare=lambda batch: batch.flip(-1).permute(0, 3, 1, 2),
    )
    other = wrap_detector(Plain(), ("car", "person"), plain).candidates(images.flip(-1))
    for mine, wanted in zip(turned.candidates(images), other, strict=True):
        torch.testing.assert_close(mine.scores, wanted.scores)
    double = Plain().double()
    (exact,) = wrap_detector(double, ("car", "person"), plain).candidates(images[:1])
    assert exact.scores.dtype == torch.float64


@pytest.mark.parametrize(
    ("decode", "message"),
    [
        (lambda logits, size: [], "2 pairs, got 0"),
        (
            lambda logits, size: [(b, s[:, :1]) for b, s in plain(logits, size)],
            r"scores \(A, 2\) and boxes \(A, 4\)",
        ),
        (
            lambda logits, size: [(b, s.logit()) for b, s in plain(logits, size)],
            r"scores in \[0, 1\], got values from",
        ),
        (
            lambda logits, size: [(b, s.detach()) for b, s in plain(logits, size)],
            "scores with a gradient, got none",
        ),
    ],
)
def test_outputs_that_are_wrong(decode: Any, message: str) -> None:
    detector = wrap_detector(Plain(), ("car", "person"), decode)
    with pytest.raises(
        InvalidValueError, match=f"decode of wrapped: expected .*{message}"
    ):
        detector.candidates(pictures(32, 40).requires_grad_())


def test_arguments_that_are_wrong() -> None:
    known: Any = wrap_detector
    with pytest.raises(
        InvalidValueError, match=r"module: expected a torch.nn.Module, got function"
    ):
        known(plain, ("car",), plain)
    with pytest.raises(InvalidValueError, match="classes: expected different names"):
        known(Plain(), ("car", "car"), plain)
    with pytest.raises(InvalidValueError, match="min_confidence"):
        known(Plain(), ("car", "person"), plain, min_confidence=2)
    broken = Plain()
    nn.init.constant_(broken.scores.weight, torch.nan)
    with pytest.raises(
        DetectorError, match="weights of wrapped: expected finite numbers"
    ):
        known(broken, ("car", "person"), plain)
