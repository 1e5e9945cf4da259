"""Where the files of weights are, or would be; light, so that detectors can be listed without importing torch."""

from __future__ import annotations

import os
from pathlib import Path

SMALL_WEIGHTS = {
    name: Path(__file__).with_name(f"{name}.safetensors") for name in ("fasterrcnn_small", "fcos_small", "detr_small")
}
"""Where the package has, or would have, the weights of detectors that this project trained."""
NOT_SHIPPED = ("fcos_small", "detr_small")
"""Those of which it has none."""
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


def torch_download(file: str) -> Path:
    """Where torch's hub keeps a file that it has downloaded; TORCH_HOME and XDG_CACHE_HOME as torch documents them."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("TORCH_HOME", f"{cache}/torch")).expanduser() / "hub" / "checkpoints" / file
