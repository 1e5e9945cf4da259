"""The detectors that come as graphs of operations, CenterNet, NanoDet and two SSDs,
behind the `Detector` interface.

CenterNet (Zhou et al., "Objects as Points", 2019, on MobileNetV3): one heat map of
centres for each class, and at each cell the distances to a box's sides. NanoDet: at
each cell of three levels a quality for each class, and for each side of the box a
distribution, as in Li et al., "Generalized Focal Loss", 2020; the distance is the mean
of eleven bins. SSD (Liu et al., 2016, on MobileNetV2): at 1,917 anchors of six levels a
quality for each class, and the box's shift from the anchor.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.catalogue import (
    COCO_CLASSES,
    OPEN_IMAGES_CLASSES,
    OPEN_IMAGES_LABELS,
    PACKAGED,
    DetectorError,
    weights_of,
)
from attacks.detectors.graphs.graph import (
    GraphModel,
    Node,
    read_frozen,
    read_graph_model,
    read_tflite,
)
from attacks.detectors.graphs.operations import OPERATIONS, Function, Value
from attacks.detectors.graphs.packages import read_files
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import FrozenModel

# A graph model as a torch module: differentiable, its shapes and constants worked out
# once.
#
# Making it ready walks the graph once with an input of zeros: what depends on constants
# alone is computed then, and what is left is a list of calls.


class GraphNetwork(nn.Module):
    """Some outputs of a graph as functions of its inputs.

    The tensors that go in and come out have the axes that the graph gives them. Sizes
    are those of the graph.
    """

    def __init__(self, model: GraphModel, outputs: Sequence[str]) -> None:
        """Make a graph ready."""
        super().__init__()
        self._inputs = [
            name for name, node in model.nodes.items() if node.op == "Placeholder"
        ]
        self._calls: list[tuple[Function, tuple[str, ...], tuple[str, ...]]] = []
        self._constants: dict[int, str] = {}
        self._results = [self._kept(value) for value in self._walk(model, outputs)]
        self._last_use: dict[str, int] = {}
        for number, (_, taken, _) in enumerate(self._calls):
            self._last_use.update(dict.fromkeys(taken, number))
        self._last_use.update(dict.fromkeys(self._results, len(self._calls)))

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The outputs for one tensor of each input, in the order of the graph."""
        at = {
            **dict(self.named_buffers()),
            **dict(zip(self._inputs, tensors, strict=True)),
        }
        for number, (function, taken, given) in enumerate(self._calls):
            result = function(*(at[slot] for slot in taken))
            at.update(
                zip(
                    given,
                    result if isinstance(result, tuple) else (result,),
                    strict=True,
                )
            )
            for slot in set(taken):
                if self._last_use[slot] == number:
                    del at[slot]
        return tuple(at[slot] for slot in self._results)

    def _walk(self, model: GraphModel, outputs: Sequence[str]) -> list[Value]:
        """Make every node ready that the outputs need, and return the outputs."""
        ready: dict[str, tuple[Value, ...]] = {}

        def output(name: str) -> Value:
            node, _, number = name.partition(":")
            return ready[node][int(number or 0)]

        waiting = [name.partition(":")[0] for name in outputs]
        while waiting:
            name = waiting[-1]
            node = model.nodes[name]
            missing = [
                taken
                for taken in (of.partition(":")[0] for of in node.inputs)
                if taken not in ready
            ]
            if name in ready or not missing:
                waiting.pop()
            if name in ready:
                continue
            waiting += missing
            if not missing:
                ready[name] = self._made_ready(
                    name, node, [output(taken) for taken in node.inputs], model
                )
        return [output(name) for name in outputs]

    def _made_ready(
        self, name: str, node: Node, inputs: list[Value], model: GraphModel
    ) -> tuple[Value, ...]:
        if node.op == "Const":
            return (Value(model.constants[name]),)
        if node.op == "Placeholder":
            return (Value(torch.zeros(node.settings["shape"]), name),)
        return OPERATIONS[node.op](node, inputs, self._run)

    def _run(self, function: Function, *inputs: Value) -> tuple[Value, ...]:
        with torch.no_grad():
            result = function(*(value.tensor for value in inputs))
        tensors = result if isinstance(result, tuple) else (result,)
        if all(value.slot is None for value in inputs):
            return tuple(map(Value, tensors))
        given = tuple(f"{len(self._calls)}.{number}" for number in range(len(tensors)))
        self._calls.append((function, tuple(map(self._kept, inputs)), given))
        return tuple(map(Value, tensors, given))

    def _kept(self, value: Value) -> str:
        """Name under which a value is when the network runs; a constant becomes a
        buffer.
        """
        if value.slot is not None:
            return value.slot
        if id(value.tensor) not in self._constants:
            name = f"constant_{len(self._constants)}"
            self.register_buffer(name, value.tensor)
            self._constants[id(value.tensor)] = name
        return self._constants[id(value.tensor)]


_MOST = 100
"""Detections in one image."""
_STRIDE = 4
"""Pixels of CenterNet's input from one cell to the next."""
_STRIDES = (8, 16, 32)
_BINS = 11
"""NanoDet's levels, and bins of each distance."""
MEAN = (103.53, 116.28, 123.675)
DEVIATION = (57.375, 57.12, 58.395)
"""Of blue, green and red in [0, 255], as NanoDet standardises them."""
_OVERLAP = 0.6
"""Intersection over union from which NanoDet and SSD drop the weaker of two boxes of a
class.
"""
_SIDE = 300
_ANCHOR_STRIDES = (16, 32, 64, 128, 256, 512)
_SCALES = (0.2, 0.95)
"""Pixels of SSD's input, pixels from one anchor to the next in each of its levels, and
scales of first and last.
"""
_SHAPES = (1.0, 2.0, 0.5, 3.0, 1 / 3)
"""Width over height of the anchors in one place."""
_SHIFTS = (10.0, 10.0, 5.0, 5.0)
"""What the numbers for y, x, height and width are divided by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """What has to be known of a network to use it."""

    outputs: tuple[str, ...]  # names of the graph's tensors that are decoded
    side: int  # height and width of its input, pixels
    # from (1, 3, side, side) sRGB in [0, 1] to what the graph takes
    prepare: Callable[[Tensor], Tensor]
    decode: Callable[[tuple[Tensor, ...]], tuple[Tensor, Tensor]]
    """From the outputs to boxes (A, 4) in pixels of the input and scores (A, C)."""
    keep: Callable[[Tensor, Tensor, float], tuple[Tensor, Tensor]]
    """From boxes, scores and the least score to rows and columns of what is reported,
    best first.
    """
    min_confidence: float = 0.05  # confidence below which nothing is reported


def _prepare_standardised(picture: Tensor) -> Tensor:
    """(1, 3, h, w) RGB in [0, 1] to the same in BGR, standardised."""
    mean, deviation = (
        picture.new_tensor(values).reshape(1, 3, 1, 1) for values in (MEAN, DEVIATION)
    )
    return (picture.flip(1) * 255 - mean) / deviation


def _decode_centres(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """CenterNet's cells row by row: scores (1, h, w, 80), pixels (1, h, w, 4) to left,
    upper, right, lower side.
    """
    scores, distances = outputs
    centres = _STRIDE * _cells(*scores.shape[1:3]).to(scores)
    return _around(centres, distances.reshape(-1, 4)), scores.reshape(
        -1, scores.shape[-1]
    )


def _decode_bins(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """The cells of all levels of NanoDet.

    Each level has scores (1, cells, 80), and logits (1, cells, 44): eleven bins for the
    left, upper, right, lower side.
    """
    boxes = []
    scores = []
    for stride, score, logits in zip(
        _STRIDES, outputs[::2], outputs[1::2], strict=True
    ):
        side = FAMILIES["nanodet_coco"].side // stride
        centres = stride * (_cells(side, side).to(score) + 0.5)
        bins = torch.softmax(logits.reshape(-1, 4, _BINS), -1)
        boxes.append(_around(centres, stride * (bins @ torch.arange(_BINS).to(bins))))
        scores.append(score[0])
    return torch.cat(boxes), torch.cat(scores)


@cache
def anchors() -> NDArray[np.float64]:
    """(1917, 4) y, x, height and width of SSD's anchors as shares of the image, in
    the order of its outputs.

    Section 2.2 of Liu et al., with the first level's three smaller ones of TensorFlow's
    implementation.
    """
    first, last = _SCALES
    scales = [*np.linspace(first, last, len(_ANCHOR_STRIDES)), 1.0]
    anchor_rows = []
    for level, stride in enumerate(_ANCHOR_STRIDES):
        kinds = [(scales[level], shape) for shape in _SHAPES]
        kinds.append((math.sqrt(scales[level] * scales[level + 1]), 1.0))
        if level == 0:
            kinds = [(first / 2, 1.0), (first, 2.0), (first, 0.5)]
        cells = math.ceil(_SIDE / stride)
        centres = [
            ((row + 0.5) / cells, (column + 0.5) / cells)
            for row in range(cells)
            for column in range(cells)
        ]
        anchor_rows += [
            (*at, scale / math.sqrt(shape), scale * math.sqrt(shape))
            for at in centres
            for scale, shape in kinds
        ]
    return np.array(anchor_rows)


def _decode_anchors(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """The boxes at all anchors of SSD; a class of several labels has the best score of
    them.

    `outputs` are shifts (1, 1917, 4), and logits (1, 1917, 24), the first of which is
    that of no object.
    """
    scores = torch.sigmoid(outputs[1][0, :, 1:])
    best = [scores[:, _columns(name)].amax(1) for name in OPEN_IMAGES_CLASSES]
    return _shifted(outputs[0][0]), torch.stack(best, 1)


def _decode_levels(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """The boxes at all anchors of an SSD of one class: for each level (1, h, w, 4 k)
    shifts, (1, h, w, 2 k) logits.
    """
    shifts, logits = (
        torch.cat([level.reshape(-1, width) for level in outputs[first::2]])
        for first, width in ((0, 4), (1, 2))
    )
    return _shifted(shifts), torch.sigmoid(logits[:, 1:])


def _shifted(shifts: Tensor) -> Tensor:
    """(1917, 4) pixels of SSD's boxes, from their shifts (1917, 4) from the anchors."""
    shifts = shifts / shifts.new_tensor(_SHIFTS)
    fixed = torch.from_numpy(anchors()).to(shifts)
    middles = fixed[:, :2]
    sizes = fixed[:, 2:]
    centres = (shifts[:, :2] * sizes + middles).flip(1)
    half = (shifts[:, 2:].exp() * sizes / 2).flip(1)
    return _SIDE * torch.cat([centres - half, centres + half], 1)


def _columns(name: str) -> list[int]:
    return [
        column
        for column, counted in enumerate(OPEN_IMAGES_LABELS.values())
        if counted == name
    ]


def _cells(high: int, wide: int) -> Tensor:
    """(high * wide, 2) column and row of each cell, row by row."""
    y, x = torch.meshgrid(torch.arange(high), torch.arange(wide), indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def _around(centres: Tensor, distances: Tensor) -> Tensor:
    """Boxes x0, y0, x1, y1 (A, 4) from points (A, 2) and distances (A, 4) to the left,
    upper, right and lower side.
    """
    return torch.cat([centres - distances[:, :2], centres + distances[:, 2:]], -1)


def _keep_peaks(boxes: Tensor, scores: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """As in `Family.keep`: cells of a square map whose score is the largest of the 3 x
    3 cells about it.
    """
    side = int(len(scores) ** 0.5)
    peaks = torch.zeros_like(scores, dtype=torch.bool)
    # few classes, and what follows is slow for all 80
    likely = (scores >= least).any(0)
    maps = scores[:, likely].T.reshape(1, -1, side, side)
    if len(maps[0]):
        highest = (maps == functional.max_pool2d(maps, 3, 1, 1)) & (maps >= least)
        peaks[:, likely] = highest.reshape(len(maps[0]), -1).T
    numbers = peaks.flatten().nonzero()[:, 0]
    kept = numbers[
        scores.flatten()[numbers].sort(descending=True, stable=True).indices[:_MOST]
    ]
    return kept // scores.shape[1], kept % scores.shape[1]


def _keep_unsuppressed(
    boxes: Tensor, scores: Tensor, least: float
) -> tuple[Tensor, Tensor]:
    """As in `Family.keep`: what is left after non-maximum suppression in each class."""
    rows, columns = (scores >= least).nonzero(as_tuple=True)
    kept = torchvision.ops.batched_nms(
        boxes[rows], scores[rows, columns], columns, _OVERLAP
    )[:_MOST]
    return rows[kept], columns[kept]


FAMILIES: Mapping[str, Family] = {
    "centernet_coco": Family(
        outputs=("tower_0/keypoints", "tower_0/wh"),
        side=512,
        prepare=lambda picture: picture.permute(0, 2, 3, 1) * 255,
        decode=_decode_centres,
        keep=_keep_peaks,
    ),
    # scores and bins of each level, in the order of the strides
    "nanodet_coco": Family(
        outputs=(
            "Identity:0",
            "Identity_3:0",
            "Identity_1:0",
            "Identity_4:0",
            "Identity_2:0",
            "Identity_5:0",
        ),
        side=416,
        prepare=_prepare_standardised,
        decode=_decode_bins,
        keep=_keep_unsuppressed,
    ),
    "ssd_openimages": Family(
        outputs=("raw_outputs/box_encodings", "raw_outputs/class_predictions"),
        side=_SIDE,
        prepare=lambda picture: picture.permute(0, 2, 3, 1) * 2 - 1,
        decode=_decode_anchors,
        keep=_keep_unsuppressed,
    ),
    "ssdlite_pedestrian": Family(
        outputs=tuple(
            f"BoxPredictor_{level}/{part}Predictor/BiasAdd"
            for level in range(6)
            for part in ("BoxEncoding", "Class")
        ),
        side=_SIDE,
        prepare=lambda picture: picture.permute(0, 2, 3, 1) * 2 - 1,
        decode=_decode_levels,
        keep=_keep_unsuppressed,
    ),
}
"""Name to family of the detectors in `PACKAGED`."""


class GraphDetector(FrozenModel):
    """A detector that others trained on photographs, its weights frozen.

    An image of any size is resized to the network's square, whatever its shape, as the
    published programs do.
    """

    def __init__(
        self,
        name: str,
        network: GraphNetwork,
        family: Family,
        classes: Sequence[str] = COCO_CLASSES,
    ) -> None:
        super().__init__(name, network, classes)
        self._family = family

    @property
    def min_confidence(self) -> float:
        """See `Detector`."""
        return self._family.min_confidence

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every cell of every level as every class, before peaks, thresholds and
        non-maximum suppression.
        """
        check_images(images)
        # the graph is for one image
        return [Candidates.of_all_classes(*self._decoded(image)) for image in images]

    def detect(self, images: Tensor) -> list[Detections]:
        """What the published programs report: peaks or non-maximum suppression, at any
        confidence of 0.05 or more.
        """
        check_images(images)
        detections = []
        with torch.no_grad():
            for image in images:
                boxes, scores = self._decoded(image)
                rows, columns = self._family.keep(boxes, scores, self.min_confidence)
                labels = tuple(self.classes[column] for column in columns.tolist())
                detections.append(
                    Detections(boxes[rows], scores[rows, columns], labels)
                )
        return detections

    def _decoded(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes (A, 4) in pixels of the image, inside it, and scores (A, C)."""
        side = self._family.side
        square = functional.interpolate(
            image.permute(2, 0, 1)[None], (side, side), mode="bilinear"
        )
        boxes, scores = self._family.decode(self.model(self._family.prepare(square)))
        high, wide = image.shape[:2]
        corner = boxes.new_tensor([wide, high, wide, high])
        return torch.minimum((boxes * (corner / side)).clamp(min=0), corner), scores


def load(name: str, weights: Path | None = None) -> GraphDetector:
    """A detector that was got with `mi-splat detectors --get`."""
    detector = PACKAGED[name]
    family = FAMILIES[name]
    path = weights_of(name) if weights is None else Path(weights)
    if weights is not None and not (
        path.is_file() and path.name == weights_of(name).name
    ):
        got = path.name if path.is_file() else "nothing there"
        raise DetectorError.of(
            f"weights {path}", f"a file {weights_of(name).name}", got, "pass that file"
        )
    content = read_files(detector, path.parent)
    if len(content) == 2:
        graph = read_graph_model(*content)
    elif path.suffix == ".pb":
        graph = read_frozen(
            content[0], {"Preprocessor/sub": (1, family.side, family.side, 3)}
        )
    else:
        graph = read_tflite(content[0][detector.start :])
    return GraphDetector(
        name, GraphNetwork(graph, family.outputs), family, detector.classes
    )
