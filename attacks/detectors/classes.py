"""The classes that detectors know, by their names in COCO; the one home of these lists."""

from __future__ import annotations

BACKGROUND, UNUSED = "__background__", "N/A"
"""Names of the two kinds of label numbers that mean no class; COCO's numbers have gaps."""

SMALL_CLASSES = ("car", "person", "stop sign", "elephant", "bird", "tv", "train", "suitcase")
"""Classes of the project's own small detectors, in their order: label i + 1 is SMALL_CLASSES[i]."""

SMALL_SIDE = 256
"""Pixels of the side of a picture that the small detectors scale it to: the R-CNN the shorter, the YOLO the longer."""

COCO_CLASSES = (
    *("person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light"),
    *("fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow"),
    *("elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee"),
    *("skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard"),
    *("tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple"),
    *("sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch"),
    *("potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone"),
    *("microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors", "teddy bear"),
    *("hair drier", "toothbrush"),
)
"""The 80 classes of COCO's detection task, in its order."""
