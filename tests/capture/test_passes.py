"""Samples of a picture: exactly as many as were asked for, and nothing of Mitsuba's log on stdout."""

from __future__ import annotations

import mitsuba as mi
import pytest

from mi_splat.capture.mitsuba_meshes import tracing_variant
from mi_splat.capture.passes import PASSES, pass_samples, sampler_type


@pytest.mark.parametrize("samples", [1, 2, 3, 10, 20, 32, 63, 64, 131, 187, 1000])
def test_passes_take_exactly_the_samples(samples: int) -> None:
    counts = pass_samples(samples)
    assert sum(counts) == samples
    assert len(counts) == min(PASSES, samples)
    with tracing_variant():
        taken = [mi.load_dict({"type": sampler_type(count), "sample_count": count}).sample_count() for count in counts]
    assert tuple(taken) == counts


@pytest.mark.parametrize("samples", [6, 8, 12, 16, 24, 32, 48])
def test_usual_counts_are_halved(samples: int) -> None:
    assert pass_samples(samples) == (samples // 2, samples // 2)
    assert sampler_type(samples // 2) == "multijitter"


def test_warnings_of_mitsuba_go_to_stderr(capfd: pytest.CaptureFixture[str]) -> None:
    with tracing_variant():
        mi.load_dict({"type": "multijitter", "sample_count": 10})
    found = capfd.readouterr()
    assert found.out == ""
    assert "rounded up to 12" in found.err
