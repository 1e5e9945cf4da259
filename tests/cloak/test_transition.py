"""The transition on blends with known answers."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from attacks.cloak.kinds.compared import differ, transition_fraction
from attacks.cloak.rates import fit_transition


def appearances(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two pictures and a mask."""
    generator = torch.Generator().manual_seed(seed)
    benign, hidden = torch.rand(2, 6, 7, 3, generator=generator)
    return benign, hidden, torch.rand(6, 7, generator=generator) > 0.4


@given(st.floats(-0.5, 1.5), st.integers(0, 99))
def test_the_fraction_of_a_blend_is_known(fraction: float, seed: int) -> None:
    benign, hidden, mask = appearances(seed)
    blend = (1 - fraction) * benign + fraction * hidden
    blend[~mask] = 0.5  # elsewhere does not count
    assert transition_fraction(blend, benign, hidden, mask) == pytest.approx(fraction, abs=1e-5)


def test_what_is_across_the_way_does_not_count() -> None:
    benign, hidden, mask = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3), torch.ones(2, 2, dtype=torch.bool)
    hidden[..., 0] = 0.8
    picture = torch.tensor([0.2, 0.9, 0.4]).expand(2, 2, 3)
    assert transition_fraction(picture, benign, hidden, mask) == pytest.approx(0.25)


@pytest.mark.parametrize("step", [1.0, 5.0])
def test_a_linear_ramp_has_its_width(step: float) -> None:
    angles = [step * i for i in range(round(90 / step) + 1)]
    band = fit_transition(angles, [min(max((angle - 40) / 20, 0), 1) for angle in angles])
    assert (band.start, band.end, band.width) == pytest.approx((42, 58, 16))


def test_a_logistic_has_its_width_also_under_noise() -> None:
    angles = np.arange(0, 90.5, 0.5)
    truth = 1 / (1 + np.exp(-(angles - 52) / 2.5))
    width = 2 * 2.5 * math.log(9)
    exact = fit_transition(angles.tolist(), truth.tolist())
    assert exact.width == pytest.approx(width, abs=0.02)
    noisy = truth + np.random.default_rng(0).normal(0, 0.03, len(angles))
    fitted = fit_transition(angles.tolist(), noisy.tolist())
    assert fitted.width == pytest.approx(width, abs=1.5)
    assert fitted.start == pytest.approx(52 - width / 2, abs=1.0)


def test_bands_that_are_not_seen_have_no_width() -> None:
    never = fit_transition([0, 10, 20], [0.0, 0.3, 0.6])
    assert never.start == pytest.approx(10 / 3)
    assert (never.end, never.width) == (None, None)
    at_once = fit_transition([0, 10, 20], [0.5, 0.95, 1.0])
    assert (at_once.start, at_once.width) == (None, None)
    assert at_once.end == pytest.approx(10 * 0.4 / 0.45)
    nothing = fit_transition([0, 10, 20], [0.02, 0.0, 0.01])
    assert (nothing.start, nothing.end) == (None, None)
    assert fit_transition([0, 10], [0.1, 0.9]).width == 10
    assert fit_transition([0, 10, 20, 30], [0, 0, 1, 1]).width == pytest.approx(8)


def test_cameras_at_one_angle_are_averaged_and_weigh_more() -> None:
    band = fit_transition([10, 0, 0, 0, 20], [0.0, 0.2, 0.4, 0.6, 1.0])
    assert band.fractions == pytest.approx((0.4, 0.0, 1.0))
    assert band.fitted == pytest.approx((0.3, 0.3, 1.0))


def test_appearances_differ_from_one_step_of_8_bits_on() -> None:
    plain, mask = torch.full((4, 4, 3), 0.5), torch.ones(4, 4, dtype=torch.bool)
    assert differ(plain, plain + 1.01 / 255, mask)
    assert not differ(plain, plain + 0.99 / 255, mask)
