"""Adapter to DETR and RT-DETR of the library transformers, which the user installs (extra `transformers`).

Both propose a fixed number of boxes, the queries, and need no non-maximum suppression.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from attacks.detectors.base import Candidates, Detections, check_images, eight_bits
from attacks.detectors.catalogue import BACKGROUND, TRANSFORMERS_HUB, UNUSED, DetectorError, download_advice
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import FrozenModel, keep_gradients_right, one_line
from mi_splat.errors import install

os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")  # before the package is imported
try:
    from transformers import (
        AutoConfig,
        DetrForObjectDetection,
        DetrImageProcessor,
        RTDetrForObjectDetection,
        RTDetrImageProcessor,
    )
    from transformers.utils import logging as library_logging
except ImportError as error:
    raise DetectorError.of("detector", "the package transformers", str(error), install("transformers")) from error

_MIN_CONFIDENCE = 0.5
"""The library's own threshold of `post_process_object_detection`."""
_COCO_NAMES = {
    "motorbike": "motorcycle",
    "aeroplane": "airplane",
    "sofa": "couch",
    "pottedplant": "potted plant",
    "diningtable": "dining table",
    "tvmonitor": "tv",
}
"""Names of classes in RT-DETR's published configurations, and COCO's own."""
_FILES = "config.json, preprocessor_config.json and model.safetensors"


def _softmax(logits: Tensor) -> Tensor:
    """DETR's: one class, or the last column, which is no object."""
    return torch.softmax(logits, -1)[..., :-1]


_ARCHITECTURES: Mapping[str, tuple[Any, Any, Callable[[Tensor], Tensor]]] = {
    "detr": (DetrForObjectDetection, DetrImageProcessor, _softmax),
    "rt_detr": (RTDetrForObjectDetection, RTDetrImageProcessor, torch.sigmoid),
}
"""Model, image processor, and how (B, Q, L) scores come from logits, by the library's name of the architecture."""


class TransformersDetector(FrozenModel):
    """A frozen DETR or RT-DETR behind the `Detector` interface."""

    def __init__(self, name: str, model: Any, processor: Any, *, min_confidence: float = _MIN_CONFIDENCE) -> None:
        """Wrap `model`."""
        self._labels = _labels(model.config.id2label)
        self._columns = [i for i, label in enumerate(self._labels) if label not in (BACKGROUND, UNUSED)]
        super().__init__(name, model, [self._labels[i] for i in self._columns])
        keep_gradients_right(self.model)
        self.processor, self.min_confidence = processor, min_confidence
        self._scores = _ARCHITECTURES[self.model.config.model_type][2]

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every query as every class, before the threshold.

        The gradient is the whole one: RT-DETR's own training holds the boxes constant with which each layer of its
        decoder starts, and this does not. Which places become queries is constant.
        """
        check_images(images)
        height, width = images.shape[1:3]
        with _WholeGradient():
            outputs = self.model(**self._network_input(images))
        scores = self._scores(outputs.logits)[:, :, self._columns]
        corners = torchvision.ops.box_convert(outputs.pred_boxes, "cxcywh", "xyxy")
        boxes = corners * corners.new_tensor([width, height, width, height])
        return [Candidates.of_all_classes(*parts) for parts in zip(boxes, scores, strict=True)]

    def detect(self, images: Tensor) -> list[Detections]:
        """What the library's image processor, model and `post_process_object_detection` give for 8-bit pictures."""
        check_images(images)
        pictures = eight_bits(images).permute(0, 3, 1, 2)
        inputs = self.processor(images=list(pictures), input_data_format="channels_first", return_tensors="pt")
        sizes = [(images.shape[1], images.shape[2])] * len(images)
        with torch.no_grad():
            outputs = self.model(**inputs)
        results = self.processor.post_process_object_detection(outputs, self.min_confidence, sizes)
        detections = []
        for result in results:
            order = result["scores"].argsort(descending=True, stable=True)
            labels = tuple(self._labels[number] for number in result["labels"][order].tolist())
            detections.append(Detections(result["boxes"][order], result["scores"][order], labels))
        return detections

    def _network_input(self, images: Tensor) -> dict[str, Tensor]:
        """What the image processor makes of the pictures, without its rounding to 8 bits, differentiable.

        The library resizes and pads; its scaling and normalising, which would round to 32 bits, are done here.
        """
        processor = self.processor
        planes = images.permute(0, 3, 1, 2) * 255
        options = {"do_rescale": False, "do_normalize": False, "input_data_format": "channels_first"}
        inputs: dict[str, Tensor] = dict(processor(images=list(planes), return_tensors="pt", **options))
        pixels = inputs["pixel_values"]
        if processor.do_rescale:
            pixels = pixels * processor.rescale_factor
        if processor.do_normalize:
            mean, deviation = (pixels.new_tensor(v).view(3, 1, 1) for v in (processor.image_mean, processor.image_std))
            pixels = (pixels - mean) / deviation
        if "pixel_mask" in inputs:
            pixels = pixels * inputs["pixel_mask"][:, None]  # the library pads with zeros after it has normalised
        return {**inputs, "pixel_values": pixels}


class _WholeGradient(TorchFunctionMode):
    """Within it, `detach` does nothing."""

    def __torch_function__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return args[0] if func is Tensor.detach else func(*args, **(kwargs or {}))


def _labels(names: Mapping[int, str]) -> tuple[str, ...]:
    """What the label numbers 0, 1, ... mean, by COCO's names."""
    return tuple(_COCO_NAMES.get(names[number], names[number]) for number in sorted(names))


def load(name: str, weights: Path | None = None) -> TransformersDetector:
    """One of the COCO detectors of the library's hub."""
    hub = TRANSFORMERS_HUB[name]
    if weights is None:
        where: dict[str, Any] = {"pretrained_model_name_or_path": hub.repository, "revision": hub.revision}
    else:
        where = {"pretrained_model_name_or_path": model_folder(Path(weights)), "local_files_only": True}
    source = name if weights is None else weights
    model_class, processor_class, _ = _ARCHITECTURES[hub.architecture]
    with loading(source):
        config = AutoConfig.from_pretrained(**where)
    if config.model_type != hub.architecture:
        raise DetectorError.of(
            f"weights of {source}", f"a {hub.architecture}", f"a {config.model_type}", f"pass a folder of {name}"
        )
    with loading(source):
        processor = processor_class.from_pretrained(**where)
        model, report = model_class.from_pretrained(
            **where, config=config, dtype=torch.float32, output_loading_info=True
        )
    require_all(report, source)
    return TransformersDetector(name, model, processor)


def model_folder(path: Path) -> Path:
    """The folder that a path names, or that holds the file that it names."""
    if not path.exists():
        raise DetectorError.of(f"weights {path}", f"a folder of {_FILES}", "nothing there", "check the path")
    folder = path if path.is_dir() else path.parent
    missing = [name for name in ("config.json", "preprocessor_config.json") if not (folder / name).is_file()]
    if missing:
        got = f"no {' and no '.join(missing)} in {folder}"
        do = "save model and image processor with save_pretrained into one folder, and pass it"
        raise DetectorError.of(f"weights {path}", f"a folder of {_FILES}", got, do)
    return folder


def require_all(report: Mapping[str, Any], source: object) -> None:
    """Raise unless every tensor of the model came from the file; what else is in the file does not matter."""
    flaws = (("missing", "missing_keys"), ("of another shape", "mismatched_keys"))
    tensors = {flaw: sorted(map(str, report.get(key) or ())) for flaw, key in flaws}
    problems = [f"{len(keys)} {flaw} ({', '.join(keys[:4])})" for flaw, keys in tensors.items() if keys]
    if problems:
        do = "pass weights that were saved from the same detector"
        raise DetectorError.of(f"weights of {source}", "the model's tensors", "; ".join(problems), do)


@contextmanager
def loading(source: object) -> Iterator[None]:
    """No progress bars meanwhile, and whatever the library raises told in a line."""
    shown = library_logging.is_progress_bar_enabled()
    library_logging.disable_progress_bar()
    try:
        yield
    except Exception as error:  # what the library raises has no common base
        expected, reason = f"a folder of {_FILES}, or a network that reaches the library's hub", one_line(error)
        do = download_advice("folder")
        if isinstance(error, ImportError) and "timm" in str(error):
            reason, do = "one whose backbone needs the package timm", "pip install timm, or take its revision no_timm"
        raise DetectorError.of(f"weights of {source}", expected, reason, do) from error
    finally:
        if shown:
            library_logging.enable_progress_bar()
