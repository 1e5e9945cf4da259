"""Where the files of weights are, or would be; light, so that detectors can be listed without importing torch."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

SMALL_WEIGHTS = Path(__file__).with_name("fasterrcnn_small.safetensors")
"""Where the package has the weights of `fasterrcnn_small`."""
SMALL_YOLO_WEIGHTS = Path(__file__).parents[2] / "scenes" / "detectors" / "yolov8n_small.safetensors"
"""Where a checkout has the weights of `yolov8n_small`; the wheel has none, for their licence is another."""
TORCHVISION_FILES = {
    "fasterrcnn_resnet50_fpn": "fasterrcnn_resnet50_fpn_coco-258fb6c6.pth",
    "fasterrcnn_resnet50_fpn_v2": "fasterrcnn_resnet50_fpn_v2_coco-dd69338a.pth",
    "fasterrcnn_mobilenet_v3_large_fpn": "fasterrcnn_mobilenet_v3_large_fpn-fb6a3cc7.pth",
    "fasterrcnn_mobilenet_v3_large_320_fpn": "fasterrcnn_mobilenet_v3_large_320_fpn-907ea3f9.pth",
    "retinanet_resnet50_fpn": "retinanet_resnet50_fpn_coco-eeacb38b.pth",
    "retinanet_resnet50_fpn_v2": "retinanet_resnet50_fpn_v2_coco-5905b1c5.pth",
    "fcos_resnet50_fpn": "fcos_resnet50_fpn_coco-99b0c9b7.pth",
    "ssdlite320_mobilenet_v3_large": "ssdlite320_mobilenet_v3_large_coco-a79551df.pth",
    "ssd300_vgg16": "ssd300_vgg16_coco-b556d3b4.pth",
}
"""Names of torchvision's published COCO weights; a test compares them with the library's own."""

YOLO_NAMES = tuple(f"{family}{size}" for family in ("yolov8", "yolo11") for size in "nsmlx")
"""ultralytics' published COCO detectors; a file of the name and ".pt" has the weights of one."""


class HubEntry(NamedTuple):
    """Where the hub of the library transformers has a detector.

    Attributes:
        repository: Its name there.
        revision: The one that needs no package besides the library.
        architecture: The library's name of it, `model_type` in a configuration.
    """

    repository: str
    revision: str
    architecture: str


TRANSFORMERS_HUB = {
    "detr_resnet50": HubEntry("facebook/detr-resnet-50", "no_timm", "detr"),
    "detr_resnet101": HubEntry("facebook/detr-resnet-101", "no_timm", "detr"),
    "rtdetr_r18vd": HubEntry("PekingU/rtdetr_r18vd", "main", "rt_detr"),
    "rtdetr_r50vd": HubEntry("PekingU/rtdetr_r50vd", "main", "rt_detr"),
}
"""Published COCO detectors of transformers."""


def elsewhere(what: str) -> str:
    """What to do where weights cannot be downloaded.

    Args:
        what: The file or folder that holds them.
    """
    others = "mi-splat detectors --get centernet_coco"
    return f"download the {what} elsewhere and pass its path (--weights), or get another: {others}"


def torch_download(file: str) -> Path:
    """Where torch's hub keeps a file that it has downloaded; TORCH_HOME and XDG_CACHE_HOME as torch documents them."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("TORCH_HOME", f"{cache}/torch")).expanduser() / "hub" / "checkpoints" / file


def hub_download(entry: HubEntry) -> Path:
    """Where the library transformers keeps its download; HF_HUB_CACHE, HF_HOME and XDG_CACHE_HOME as it documents them.

    A revision is a name for a commit, which the library notes in a file beside the downloads.
    """
    home = os.environ.get("HF_HOME", f"{os.environ.get('XDG_CACHE_HOME', '~/.cache')}/huggingface")
    cache = Path(os.environ.get("HF_HUB_CACHE", f"{home}/hub")).expanduser()
    folder = cache / f"models--{entry.repository.replace('/', '--')}"
    note = folder / "refs" / entry.revision
    commit = note.read_text().strip() if note.is_file() else entry.revision
    return folder / "snapshots" / commit / "model.safetensors"
