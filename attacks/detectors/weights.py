"""Weights from files, read without running code from them; their fingerprint; models
that keep them frozen.
"""

import hashlib
import pickle
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from attacks.detectors.catalogue import DetectorError
from mi_splat.io.noted_tensors import not_finite

_Self = TypeVar("_Self", bound="FrozenModel")
SUFFIXES = (".safetensors", ".pth", ".pt")
_SHOWN = 4
_UNREADABLE = (
    *(
        SafetensorError,
        pickle.UnpicklingError,
        struct.error,
        EOFError,
        OSError,
        RuntimeError,
        AssertionError,
    ),
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, ImportError),
)
"""What safetensors, and torch on its way through a pickle, raise for files that are
broken in one way or another.
"""


def fingerprint(state: Mapping[str, Tensor], more: str = "") -> str:
    """16 hex digits that stand for a state dict: SHA-256 over the names and bytes of
    its tensors, in their order.
    """
    total = hashlib.sha256(more.encode())
    for name, value in state.items():
        total.update(name.encode())
        total.update(
            value.detach()
            .cpu()
            .contiguous()
            .reshape(-1)
            .view(torch.uint8)
            .numpy()
            .tobytes()
        )
    return total.hexdigest()[:16]


def one_line(error: Exception) -> str:
    """What an error of a library says, in one line."""
    text = str(error).strip()
    if text:
        return text.splitlines()[0][:300]
    return type(error).__name__


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read a state dict from a safetensors file, or from a .pth file with
    `weights_only=True`.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise DetectorError.of(
            f"weights {path}",
            " or ".join(SUFFIXES),
            f"suffix {path.suffix!r}",
            "pass a file of tensors",
        )
    if not path.is_file():
        raise DetectorError.of(
            f"weights {path}", "a file", "nothing there", "check the path"
        )
    try:
        if path.suffix == ".safetensors":
            return check_finite(load_file(path), f"weights {path}")
        state: object = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        expected = f"a readable {path.suffix} file of tensors"
        do = "download or save it again"
        raise DetectorError.of(
            f"weights {path}", expected, one_line(error), do
        ) from error
    if isinstance(state, Mapping) and isinstance(state.get("model"), Mapping):
        # a training checkpoint of torchvision's reference scripts
        state = state["model"]
    if (
        not isinstance(state, Mapping)
        or not all(
            isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()
        )
        or not state
    ):
        if isinstance(state, Mapping):
            got = "a dict of something else"
        else:
            got = type(state).__name__
        raise DetectorError.of(
            f"weights {path}",
            "a dict of tensors by name",
            got,
            "save model.state_dict()",
        )
    return check_finite(dict(state), f"weights {path}")


def check_finite(state: dict[str, Tensor], what: str) -> dict[str, Tensor]:
    """The weights, whose numbers are all finite: a detector of others finds nothing, as
    if each attack had succeeded.

    A single infinite number without axes is a setting, for instance what an image is
    padded with.
    """
    weights = {
        name: value
        for name, value in state.items()
        if value.ndim or not bool(torch.isinf(value))
    }
    name = not_finite(weights)
    if name:
        raise DetectorError.of(
            what, f"finite numbers in {name}", "others", "download or save them again"
        )
    return state


def apply_weights(
    model: nn.Module, state: Mapping[str, Tensor], source: object
) -> None:
    """Load `state` into `model` strictly, but for BatchNorm's step counters, which have
    no effect in evaluation.

    Names of an older version of the model's library are read, as the model's own
    `load_state_dict` reads them. Where this raises, `model` has some of the weights.
    """
    expected = model.state_dict()
    misshapen = [
        k for k in expected if k in state and state[k].shape != expected[k].shape
    ]
    unlike = [
        k
        for k in expected
        if k in state
        and state[k].is_floating_point() != expected[k].is_floating_point()
    ]
    if unlike:
        got = f"{unlike[0]} of {state[unlike[0]].dtype}"
        do = "pass weights that were saved from the same detector"
        raise DetectorError.of(
            f"weights {source}", f"{expected[unlike[0]].dtype}", got, do
        )
    shapes = [
        f"{k} {tuple(state[k].shape)} instead of {tuple(expected[k].shape)}"
        for k in misshapen
    ]
    try:
        report = model.load_state_dict(
            {k: v for k, v in state.items() if k not in misshapen}, strict=False
        )
        missing = [
            k
            for k in report.missing_keys
            if k not in misshapen and not k.endswith("num_batches_tracked")
        ]
        unexpected = [
            k for k in report.unexpected_keys if not k.endswith("num_batches_tracked")
        ]
    except RuntimeError as error:  # of another shape under an older name
        missing = []
        unexpected = []
        shapes = [*shapes, str(error).splitlines()[-1].strip()]
    problems = [
        f"{len(keys)} {what}"
        f" ({', '.join(keys[:_SHOWN])}{', ...' if len(keys) > _SHOWN else ''})"
        for what, keys in (
            ("missing", missing),
            ("unexpected", unexpected),
            ("of another shape", shapes),
        )
        if keys
    ]
    if problems:
        raise DetectorError.of(
            f"weights {source}",
            f"the {len(expected)} tensors of {type(model).__name__}",
            "; ".join(problems),
            "pass weights that were saved from the same detector",
        )


def keep_gradients_right(model: nn.Module) -> None:
    """Bring the gradient into contiguous order before it enters any BatchNorm2d of
    `model`; the forward pass stays.

    On the CPU (seen with torch 2.15), the backward pass of `BatchNorm2d` takes the
    values of the gradient in a wrong order if the batch is one image, the input is
    contiguous, and the gradient comes in the order of tokens, (B, H * W, C), as from
    the attention of a transformer. There is no error; the gradient is another one.
    """
    for part in model.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.register_forward_hook(_order_gradient)


def _order_gradient(module: nn.Module, inputs: Any, output: Tensor) -> None:
    if output.requires_grad:
        output.register_hook(Tensor.contiguous)  # type: ignore[no-untyped-call]


class FrozenModel:
    """A torch model in evaluation mode whose weights have no gradients: what all
    adapters have in common.
    """

    name: str
    classes: tuple[str, ...]
    model: Any
    settings: str = ""
    """What else changes the scores, for the fingerprint."""

    def __init__(self, name: str, model: nn.Module, classes: Sequence[str]) -> None:
        """Freeze a model, in place."""
        check_finite(model.state_dict(), f"weights of {name}")
        self.name, self.classes = name, tuple(classes)
        self.model = model.eval().requires_grad_(False)
        self._hashed: tuple[dict[str, Tensor], list[tuple[int, int]], str] | None = None

    @property
    def fingerprint(self) -> str:
        """See `Detector`; hashed again only after a tensor was replaced or changed."""
        state = self.model.state_dict()
        versions = [(value.data_ptr(), value._version) for value in state.values()]
        if self._hashed is None or self._hashed[1] != versions:
            # the state, so that no memory is reused
            self._hashed = state, versions, fingerprint(state, self.settings)
        return self._hashed[2]

    def to(self: _Self, device: torch.device | str) -> _Self:
        """Move the weights to a device, in place."""
        self.model.to(device)
        return self
