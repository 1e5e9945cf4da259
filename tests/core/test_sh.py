"""Spherical harmonics against SciPy's complex ones, and their rotation against its
meaning.
"""

import math

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from scipy.special import sph_harm_y
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import from_matrix, multiply, normalise, to_matrix
from mi_splat.maths.sh import (
    colours_by_direction,
    degree_of,
    even_directions,
    sh_basis,
    sh_to_colour,
)


def directions(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1
    )


def turn(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return to_matrix(
        normalise(torch.randn(4, generator=generator, dtype=torch.float64))
    )


def test_basis_is_the_real_form_of_scipys_harmonics() -> None:
    d = directions(200)
    x, y, z = d.numpy().T
    polar = np.arccos(z)
    azimuth = np.arctan2(y, x)
    expected = []
    for band in range(4):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), polar, azimuth)
            expected.append(
                value.real
                if m == 0
                else math.sqrt(2) * (value.real if m > 0 else value.imag)
            )
    torch.testing.assert_close(sh_basis(d, 3), torch.from_numpy(np.stack(expected, 1)))


def test_colour_is_clamped_from_below_only() -> None:
    sh = torch.zeros(3, 4, 3)
    sh[0, 0], sh[1, 0] = 10.0, -10.0
    colour = sh_to_colour(sh, directions(3).float())
    assert (colour[0] > 3).all()
    assert torch.equal(colour[1:], torch.tensor([[0.0] * 3, [0.5] * 3]))


@pytest.mark.parametrize("count", [-1, 0, 2, 3, 5, 15, 25])
def test_unknown_counts_are_refused(count: int) -> None:
    with pytest.raises(InvalidValueError, match="1, 4, 9 or 16 coefficients"):
        degree_of(count)


def test_colours_by_direction_are_those_of_each_gaussian() -> None:
    sh = torch.randn(7, 16, 3, generator=torch.Generator().manual_seed(0))
    directions = even_directions(5)
    means, most = colours_by_direction(sh.numpy(), directions, rows=3)
    for index, direction in enumerate(torch.from_numpy(directions).to(sh)):
        colours = sh_to_colour(sh, direction.expand(7, 3))
        assert means[index] == pytest.approx(float(colours.mean()), rel=1e-5)
        assert most[index] == pytest.approx(float(colours.max()), rel=1e-5)


# Quaternions and rotation matrices


components = st.floats(-1, 1, width=32)


@st.composite
def quaternions(draw: st.DrawFn) -> Tensor:
    value = torch.tensor([draw(components) for _ in range(4)], dtype=torch.float64)
    hypothesis.assume(float(value.norm()) > 1e-3)
    return value


@hypothesis.given(q=quaternions())
def test_normalise_is_idempotent_bit_for_bit(q: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        once = normalise(q.to(dtype))
        assert torch.equal(normalise(once), once)
        assert abs(float(once.double().norm()) - 1) < 1.1e-6


def test_gradient_of_normalise_has_no_radial_part() -> None:
    q = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(normalise, (q,))
    unit = normalise(q.detach()).float().requires_grad_()
    (gradient,) = torch.autograd.grad((normalise(unit) * torch.randn(5, 4)).sum(), unit)
    torch.testing.assert_close(
        (gradient * unit).sum(1), torch.zeros(5), atol=1e-6, rtol=0
    )
    assert float(gradient.detach().norm()) > 0.1


@hypothesis.given(q=quaternions())
def test_matrices_and_quaternions_go_there_and_back(q: Tensor) -> None:
    unit = normalise(q)
    back = from_matrix(to_matrix(unit))
    assert back[0] >= 0
    torch.testing.assert_close(to_matrix(back), to_matrix(unit), atol=1e-5, rtol=0)


@hypothesis.given(p=quaternions(), q=quaternions())
def test_products_of_quaternions_are_products_of_matrices(p: Tensor, q: Tensor) -> None:
    p = p / p.norm()
    q = q / q.norm()
    torch.testing.assert_close(to_matrix(multiply(p, q)), to_matrix(p) @ to_matrix(q))
