"""`detr_small`: a small detection transformer of our own, which gives each object once, so that nothing is suppressed.

As in Carion et al., "End-to-End Object Detection with Transformers", 2020, an encoder looks at the cells of a feature
map and a decoder turns queries into boxes. As in Zhu et al., "Deformable DETR", 2021, section 4.2, each cell first
proposes a box, the best proposals become the queries, and each layer of the decoder corrects the boxes of the one
before. That lets it learn from thousands of pictures, where the first form wants hundreds of epochs of COCO.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torchvision.ops import box_convert, clip_boxes_to_image

from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.classes import SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.frozen import FrozenDetector
from attacks.detectors.small import Backbone
from attacks.detectors.weights import apply_weights, read_weights, small_weights

_WIDTH, _HEADS, _FEED_FORWARD = 96, 4, 256
_ENCODERS, _DECODERS, _QUERIES = 2, 3, 40
_LEVELS = ("1", "2")
"""Levels of the backbone's pyramid whose cells are looked at: strides 16 and 32."""
_STRIDE = 32
_SIZES = (0.25, 0.6)
"""Edge of the box that a cell of each level starts from, as a fraction of the picture."""
_RARE = 0.02
"""Confidence of every class before training; half, and the loss would be all about empty cells."""


@dataclass(frozen=True, slots=True, eq=False)
class Guesses:
    """Scores and boxes of cells, or of queries after a layer of the decoder.

    Attributes:
        logits: (B, N, C); their sigmoids are the confidences.
        boxes: (B, N, 4) centre x, y, width and height, as fractions of the picture.
    """

    logits: Tensor
    boxes: Tensor


class DETR(nn.Module):
    """Backbone, encoder, proposals, decoder.

    Attributes:
        backbone: Its pyramid's levels of strides 16 and 32 are looked at.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.backbone = Backbone()
        self.level = nn.Parameter(torch.randn(len(_LEVELS), _WIDTH) * 0.1)
        sizes = (_WIDTH, _HEADS, _FEED_FORWARD, 0.0)
        self.encoder = nn.ModuleList(nn.TransformerEncoderLayer(*sizes, batch_first=True) for _ in range(_ENCODERS))
        self.decoder = nn.ModuleList(nn.TransformerDecoderLayer(*sizes, batch_first=True) for _ in range(_DECODERS))
        self.query = nn.Linear(_WIDTH, _WIDTH)
        self.logits = nn.ModuleList(_rare(nn.Linear(_WIDTH, classes)) for _ in range(1 + _DECODERS))
        self.shifts = nn.ModuleList(_shift() for _ in range(1 + _DECODERS))

    def forward(self, planes: Tensor) -> list[Guesses]:
        """What is in pictures of a size divisible by 32.

        Args:
            planes: (B, 3, H, W) sRGB in [0, 1].

        Returns:
            The guesses of all cells, then those of the queries after each layer of the decoder; the last ones count.
        """
        features = self.backbone((planes - 0.45) / 0.225)
        maps = [features[name] for name in _LEVELS]
        cells = torch.cat([cells_of(one.shape[2:], size) for one, size in zip(maps, _SIZES, strict=True)])
        cells = cells.to(planes)[None]
        place = encoding(cells)
        tokens = torch.cat([m.flatten(2).mT + level for m, level in zip(maps, self.level, strict=True)], 1)
        for encode in self.encoder:
            tokens = encode(tokens + place)
        first = self._guess(0, tokens, cells)
        best = first.logits.detach().amax(2).topk(min(_QUERIES, tokens.shape[1]), dim=1).indices[..., None]
        queries = self.query(tokens.gather(1, best.expand(-1, -1, _WIDTH)))
        boxes, found, memory = first.boxes.gather(1, best.expand(-1, -1, 4)), [first], tokens + place
        for number, decode in enumerate(self.decoder, start=1):
            if self.training:
                boxes = boxes.detach()  # each layer learns its own correction
            queries = decode(queries + encoding(boxes), memory)
            found.append(self._guess(number, queries, boxes))
            boxes = found[-1].boxes
        return found

    def _guess(self, number: int, tokens: Tensor, boxes: Tensor) -> Guesses:
        return Guesses(
            self.logits[number](tokens), torch.sigmoid(torch.logit(boxes, 1e-4) + self.shifts[number](tokens))
        )


def _rare(layer: nn.Linear) -> nn.Linear:
    nn.init.constant_(layer.bias, math.log(_RARE / (1 - _RARE)))
    return layer


def _shift() -> nn.Sequential:
    """Corrects a box; at first by nothing."""
    last = nn.Linear(_WIDTH, 4)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(_WIDTH, _WIDTH), nn.ReLU(), last)


def cells_of(shape: torch.Size, size: float) -> Tensor:
    """(h * w, 4) boxes around the cells of a feature map, rows first, with edges of `size` of the picture."""
    height, width = shape
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, size), torch.full_like(x, size)], -1).reshape(-1, 4)


def encoding(boxes: Tensor) -> Tensor:
    """(..., width) sines and cosines of the four numbers of (..., 4) boxes at doubling frequencies."""
    count = _WIDTH // 8
    frequencies = math.pi * 2.0 ** torch.linspace(0, 6, count, device=boxes.device)
    angles = boxes[..., None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], -1).flatten(-2)


class DETRDetector(FrozenDetector):
    """A frozen `DETR` behind the `Detector` interface.

    Attributes:
        name: Name in `attacks.detectors.DETECTORS`.
        classes: Foreground classes.
        model: The network, in evaluation mode, its weights without gradients.
        min_confidence: Confidence below which `detect` reports nothing.
    """

    def __init__(self, name: str, model: DETR, *, min_confidence: float = 0.05) -> None:
        """Wrap `model`, whose class number i is SMALL_CLASSES[i]."""
        super().__init__(name, model, SMALL_CLASSES)
        self.min_confidence = min_confidence

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every query after the last layer; which cells became queries is constant for the gradient.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        check_images(images)
        height, width = images.shape[1:3]
        last = self.model(resized(images.permute(0, 3, 1, 2), SMALL_SIDE))[-1]
        whole = box_convert(last.boxes, "cxcywh", "xyxy") * images.new_tensor([width, height, width, height])
        boxes = clip_boxes_to_image(whole, (height, width))[:, :, None].expand(-1, -1, len(self.classes), -1)
        return [Candidates(*each) for each in zip(boxes, last.logits.sigmoid(), strict=True)]

    def detect(self, images: Tensor) -> list[Detections]:
        """Every query whose best class is confident enough, as that class.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        with torch.no_grad():
            return [self._confident(found) for found in self.candidates(images)]

    def _confident(self, found: Candidates) -> Detections:
        scores, classes = found.scores.max(1)
        order = scores.argsort(descending=True)
        order = order[scores[order] >= self.min_confidence]
        labels = tuple(self.classes[number] for number in classes[order].tolist())
        return Detections(found.boxes[order, 0], scores[order], labels)


def resized(planes: Tensor, side: int) -> Tensor:
    """(B, 3, H, W) pictures whose shorter side becomes `side` pixels, the longer one the nearest multiple of 32."""
    height, width = planes.shape[2:]
    gain = side / min(height, width)
    size = [max(round(length * gain / _STRIDE), 1) * _STRIDE for length in (height, width)]
    if size == [height, width]:
        return planes
    return F.interpolate(planes, size=size, mode="bilinear", align_corners=False, antialias=gain < 1)


def build() -> DETR:
    """The network with random weights, in training mode."""
    return DETR(len(SMALL_CLASSES))


def load_small(weights: Path | None = None) -> DETRDetector:
    """The detector, with the weights of a training.

    Raises:
        DetectorError: There are no weights, or they do not fit.
    """
    model, path = build(), small_weights("detr_small", weights)
    apply_weights(model, read_weights(path), path)
    return DETRDetector("detr_small", model)
