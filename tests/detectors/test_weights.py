"""Weights that no detector can have are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from attacks.detectors.errors import DetectorError
from attacks.detectors.frozen import FrozenDetector
from attacks.detectors.weights import apply_weights, read_weights


@pytest.mark.parametrize("bad", [torch.nan, -torch.inf])
@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_weights_that_are_not_finite_are_refused(bad: float, suffix: str, tmp_path: Path) -> None:
    """A detector of NaN finds nothing, so that every attack on it would seem to succeed."""
    state = {"good": torch.ones(3), "bad": torch.tensor([0.0, bad]).half(), "whole": torch.ones(2, dtype=torch.int64)}
    path = tmp_path / f"weights{suffix}"
    (save_file if suffix == ".safetensors" else torch.save)(state, path)
    with pytest.raises(DetectorError, match=r"weights\.\w+: expected finite numbers in bad, got others"):
        read_weights(path)


def test_a_model_of_nan_is_no_detector() -> None:
    model = torch.nn.Linear(2, 1)
    FrozenDetector("toy", model, ("car",))
    torch.nn.init.constant_(model.bias, torch.nan)
    with pytest.raises(DetectorError, match="weights of toy: expected finite numbers in bias"):
        FrozenDetector("toy", model, ("car",))


def test_weights_of_another_kind_of_number_are_refused() -> None:
    state = {"weight": torch.ones(1, 2, dtype=torch.int64), "bias": torch.zeros(1)}
    with pytest.raises(DetectorError, match=r"float32, got weight of torch\.int64"):
        apply_weights(torch.nn.Linear(2, 1), state, "a file")
