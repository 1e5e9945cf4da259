"""A detector in the form of a TensorFlow.js graph, behind the `Detector` interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.classes import COCO_CLASSES
from attacks.detectors.coco import centernet, nanodet
from attacks.detectors.coco.cards import check_files
from attacks.detectors.coco.sources import GRAPH, PUBLISHED, WEIGHTS, weights_of
from attacks.detectors.errors import DetectorError
from attacks.detectors.frozen import FrozenDetector
from attacks.detectors.tfjs.files import load_graph_model
from attacks.detectors.tfjs.network import GraphNetwork
from attacks.detectors.weights import fingerprint
from mi_splat.errors import message


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """What has to be known of a network to use it.

    Attributes:
        outputs: Names of the graph's tensors that are decoded.
        side: Height and width of its input, pixels.
        prepare: From (1, 3, side, side) sRGB in [0, 1] to what the graph takes.
        decode: From the outputs to boxes (A, 4) in pixels of the input and scores (A, 80).
        keep: From boxes and scores to rows, columns and scores of what is reported, best first.
        min_confidence: Confidence below which nothing is reported.
    """

    outputs: tuple[str, ...]
    side: int
    prepare: Callable[[Tensor], Tensor]
    decode: Callable[[tuple[Tensor, ...]], tuple[Tensor, Tensor]]
    keep: Callable[[Tensor, Tensor, float], tuple[Tensor, Tensor]]
    min_confidence: float


FAMILIES: Mapping[str, Family] = {
    "centernet_coco": Family(
        outputs=centernet.OUTPUTS,
        side=centernet.SIDE,
        prepare=centernet.prepare,
        decode=centernet.decode,
        keep=centernet.keep,
        min_confidence=0.05,
    ),
    "nanodet_coco": Family(
        outputs=nanodet.OUTPUTS,
        side=nanodet.SIDE,
        prepare=nanodet.prepare,
        decode=nanodet.decode,
        keep=nanodet.keep,
        min_confidence=0.05,
    ),
}
"""Name to family of the detectors that can be got (`attacks.detectors.coco.sources.PUBLISHED`)."""


class GraphDetector(FrozenDetector):
    """A detector that others trained on COCO, its weights frozen.

    A picture of any size is resized to the network's square, whatever its shape, as the published programs do.

    Attributes:
        name: Name in `attacks.detectors.DETECTORS`.
        classes: The 80 classes of COCO.
        model: The graph.
    """

    def __init__(self, name: str, network: GraphNetwork, family: Family) -> None:
        super().__init__(name, network, COCO_CLASSES)
        self._family = family

    @property
    def fingerprint(self) -> str:
        """See `Detector`. The graph belongs to it; with the published one it is that of the weights, as ever."""
        published = self.name in PUBLISHED and self.model.digest == PUBLISHED[self.name].graph
        return fingerprint(self.model.state_dict(), "" if published else self.model.digest)

    @property
    def min_confidence(self) -> float:
        """See `Detector`."""
        return self._family.min_confidence

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every cell of every level as every class, before peaks, thresholds and non-maximum suppression.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        check_images(images)
        found = []
        for image in images:  # the graph is for one picture
            boxes, scores = self._decoded(image)
            found.append(Candidates(boxes[:, None].expand(-1, scores.shape[1], -1), scores))
        return found

    def detect(self, images: Tensor) -> list[Detections]:
        """What the published programs report: peaks or non-maximum suppression, at any confidence of 0.05 or more.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        check_images(images)
        found = []
        with torch.no_grad():
            for image in images:
                boxes, scores = self._decoded(image)
                rows, columns = self._family.keep(boxes, scores, self.min_confidence)
                labels = tuple(self.classes[column] for column in columns.tolist())
                found.append(Detections(boxes[rows], scores[rows, columns], labels))
        return found

    def _decoded(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes (A, 4) in pixels of the picture, inside it, and scores (A, C)."""
        side = self._family.side
        square = functional.interpolate(image.permute(2, 0, 1)[None], (side, side), mode="bilinear")
        boxes, scores = self._family.decode(self.model(self._family.prepare(square)))
        high, wide = image.shape[:2]
        scale = boxes.new_tensor([wide, high, wide, high]) / side
        return torch.minimum((boxes * scale).clamp(min=0), boxes.new_tensor([wide, high, wide, high])), scores


def load_published(name: str, weights: Path | None = None) -> GraphDetector:
    """A detector that was got with `mi-splat detectors --get`.

    Args:
        name: Key of `FAMILIES`.
        weights: The `weights.safetensors` of a folder that the command wrote, its `graph.json` and its card
            beside it; None looks where the command writes it.

    Raises:
        DetectorError: The files are not there, are of another detector, or are not those that were got.
    """
    path = weights_of(name) if weights is None else Path(weights)
    if weights is None and not path.is_file():
        do = f"get it: mi-splat detectors --get {name} (npm, {PUBLISHED[name].megabytes:g} MB)"
        raise DetectorError(message(f"weights of {name}", f"a file {path}", "nothing there", do))
    if not path.is_file():
        raise DetectorError(message(f"weights {path}", "a file", "nothing there", "check the path"))
    if path.name != WEIGHTS:
        raise DetectorError(message(f"weights {path}", f"the {WEIGHTS} of a folder", path.name, "pass that file"))
    check_files(PUBLISHED[name], path.parent)
    family = FAMILIES[name]
    model = load_graph_model(path.with_name(GRAPH), path)
    network = GraphNetwork(model, family.outputs)
    _check_fits(name, network, family)
    return GraphDetector(name, network, family)


def _check_fits(name: str, network: GraphNetwork, family: Family) -> None:
    """Raise unless a graph takes and gives what its family does.

    Raises:
        DetectorError: It takes or gives something else.
    """
    what, do = f"graph of {name}", "get the detector again"
    taken = tuple(family.prepare(torch.zeros(1, 3, family.side, family.side)).shape)
    if list(network.inputs.values()) != [taken]:
        raise DetectorError(message(what, f"one input of {taken}", list(network.inputs.values()), do))
    given = " and ".join(str(shape) for shape in network.shapes)
    try:
        boxes, scores = family.decode(tuple(torch.zeros(shape) for shape in network.shapes))
        fits = boxes.shape == (len(scores), 4) and scores.shape[1] == len(COCO_CLASSES)
    except (RuntimeError, ValueError, IndexError):
        fits = False
    if not fits:
        raise DetectorError(message(what, f"outputs of its family, in {', '.join(family.outputs[:2])}", given, do))
