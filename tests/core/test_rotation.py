"""Quaternions and rotation matrices."""

from __future__ import annotations

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.rotation import from_matrix, is_rotation, multiply, normalise, to_matrix

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


def test_normalise_at_extremes() -> None:
    tiny = torch.tensor([[1e-38, 0, 0, 1e-38], [3e38, 3e38, 3e38, 3e38]])
    torch.testing.assert_close(normalise(tiny), torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5], [0.5, 0.5, 0.5, 0.5]]))
    assert torch.isnan(normalise(torch.zeros(1, 4))).all()
    assert normalise(torch.zeros(0, 4)).shape == (0, 4)


def test_only_norms_within_a_millionth_keep_their_bits() -> None:
    unit = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    assert torch.equal(normalise(unit * (1 + 9e-7)), unit * (1 + 9e-7))
    torch.testing.assert_close(normalise(unit * (1 + 2e-6)), unit, rtol=0, atol=1e-12)


def test_gradient_of_normalise_has_no_radial_part() -> None:
    q = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(normalise, (q,))
    unit = normalise(q.detach()).float().requires_grad_()
    (gradient,) = torch.autograd.grad((normalise(unit) * torch.randn(5, 4)).sum(), unit)
    torch.testing.assert_close((gradient * unit).sum(1), torch.zeros(5), atol=1e-6, rtol=0)
    assert float(gradient.detach().norm()) > 0.1


@hypothesis.given(q=quaternions())
def test_q_and_minus_q_are_the_same_rotation(q: Tensor) -> None:
    unit = normalise(q)
    assert torch.equal(to_matrix(unit), to_matrix(-unit))
    assert is_rotation(to_matrix(unit), 1e-5)


@hypothesis.given(q=quaternions())
def test_matrices_and_quaternions_go_there_and_back(q: Tensor) -> None:
    unit = normalise(q)
    back = from_matrix(to_matrix(unit))
    assert back[0] >= 0
    torch.testing.assert_close(to_matrix(back), to_matrix(unit), atol=1e-5, rtol=0)


@hypothesis.given(p=quaternions(), q=quaternions())
def test_products_of_quaternions_are_products_of_matrices(p: Tensor, q: Tensor) -> None:
    p, q = p / p.norm(), q / q.norm()
    torch.testing.assert_close(to_matrix(multiply(p, q)), to_matrix(p) @ to_matrix(q))


@pytest.mark.parametrize(
    ("axis", "image"),
    [((1.0, 0, 0), (1.0, 0, 0)), ((0, 1.0, 0), (0, 0, 1.0)), ((0, 0, 1.0), (0, -1.0, 0))],
)
def test_a_quarter_turn_about_x(axis: tuple[float, ...], image: tuple[float, ...]) -> None:
    half = math.sqrt(0.5)
    matrix = to_matrix(torch.tensor([half, half, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(matrix @ torch.tensor(axis).double(), torch.tensor(image).double())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_lose_no_precision(axis: int) -> None:
    matrix = -torch.eye(3, dtype=torch.float64)
    matrix[axis, axis] = 1
    expected = torch.zeros(4, dtype=torch.float64)
    expected[axis + 1] = 1
    assert torch.equal(from_matrix(matrix).abs(), expected)


def test_leading_dimensions_are_kept() -> None:
    q = normalise(torch.randn(2, 5, 4))
    assert to_matrix(q).shape == (2, 5, 3, 3)
    assert from_matrix(to_matrix(q)).shape == (2, 5, 4)
    assert multiply(q, q[0, 0]).shape == (2, 5, 4)


def test_what_is_no_rotation() -> None:
    assert is_rotation(torch.eye(3))
    for wrong in (torch.eye(4), torch.zeros(3, 3), -torch.eye(3), 1.01 * torch.eye(3), torch.eye(3) * torch.inf):
        assert not is_rotation(wrong)
    assert is_rotation(1.00004 * torch.eye(3).double())  # orthonormal within 1e-4
    assert not is_rotation(1.00006 * torch.eye(3).double())
    with pytest.raises(InvalidValueError, match="matrices: expected shape"):
        from_matrix(torch.eye(4))
