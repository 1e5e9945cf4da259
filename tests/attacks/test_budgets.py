"""Budgets: projections are idempotent, inside the ball to the last bit, and a zero
budget is the identity.
"""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Generator, Tensor

from attacks.optimisers import NORM_NAMES, NormName
from attacks.search.budget import NORMS, Budget, BudgetError
from mi_splat.errors import InvalidValueError

norms = st.sampled_from(NORM_NAMES)
seeds = st.integers(0, 2**32 - 1)
radii = st.sampled_from([0.0, 1e-8, 1e-3, 0.3, 1.0, 5.0, 1e4])


def draw(
    seed: int, *, spread: float, size: float = 1.0, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """A point and a reference, (12, 4, 3) each, `spread` apart, with references of
    about `size`.
    """
    generator = Generator().manual_seed(seed)
    reference = size * torch.randn(12, 4, 3, generator=generator, dtype=dtype)
    return (
        reference + spread * torch.randn(12, 4, 3, generator=generator, dtype=dtype),
        reference,
    )


@given(
    norms,
    radii,
    seeds,
    st.sampled_from([1e-6, 0.1, 10.0]),
    st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_a_projection_lands_inside_and_a_second_one_changes_nothing(
    norm: NormName, radius: float, seed: int, spread: float, size: float
) -> None:
    for dtype in (torch.float32, torch.float64):
        point, reference = draw(seed, spread=spread, size=size, dtype=dtype)
        budget = Budget(radius={"sh": radius}, norm=norm)
        once = budget.project({"sh": point}, {"sh": reference})
        assert once["sh"].dtype == dtype
        budget.check(once, {"sh": reference})
        assert budget.measure(once, {"sh": reference})["sh"] <= radius
        assert torch.equal(budget.project(once, {"sh": reference})["sh"], once["sh"])


@given(norms, seeds)
def test_a_zero_budget_is_the_identity(norm: NormName, seed: int) -> None:
    point, reference = draw(seed, spread=1.0)
    projected = Budget(radius={"sh": 0.0}, norm=norm).project(
        {"sh": point}, {"sh": reference}
    )
    assert torch.equal(projected["sh"], reference)


@given(norms, seeds)
def test_what_is_inside_comes_back_bit_for_bit(norm: NormName, seed: int) -> None:
    point, reference = draw(seed, spread=0.01)
    assert (
        Budget(radius={"sh": 5.0}, norm=norm).project({"sh": point}, {"sh": reference})[
            "sh"
        ]
        is point
    )


@given(norms, seeds, st.sampled_from([0.3, 5.0]))
def test_the_projection_is_the_nearest_point(
    norm: NormName, seed: int, radius: float
) -> None:
    """No other point of the ball is nearer: checked against random points of the ball
    (the balls are convex).
    """
    point, reference = draw(seed, spread=3.0, dtype=torch.float64)
    budget = Budget(radius={"sh": radius}, norm=norm)
    nearest = (budget.project({"sh": point}, {"sh": reference})["sh"] - point).norm()
    generator = Generator().manual_seed(seed)
    for _ in range(5):
        other = budget.uniform({"sh": reference}, generator)["sh"]
        assert nearest <= (other - point).norm() * (1 + 1e-9)


@given(norms, seeds)
def test_the_steepest_direction_has_size_one_and_beats_random_directions(
    norm: NormName, seed: int
) -> None:
    gradient, other = draw(seed, spread=1.0, dtype=torch.float64)
    best = Budget(radius={"sh": 1.0}, norm=norm).steepest({"sh": gradient})["sh"]
    assert NORMS[norm].measure(best) == pytest.approx(1.0)
    rival = NORMS[norm].noise(best, Generator().manual_seed(seed))
    assert (gradient * best).sum() >= (gradient * rival).sum()
    shrunk = NORMS[norm].shrink(other, 1.0)
    assert (gradient * best).sum() >= (gradient * shrunk).sum()


@pytest.mark.parametrize("norm", NORM_NAMES)
def test_a_tiny_gradient_still_gives_a_direction_and_a_zero_one_gives_none(
    norm: NormName,
) -> None:
    gradient = torch.zeros(3, 2)
    gradient[1, 0] = 1e-35
    direction = Budget(radius={"sh": 1.0}, norm=norm).steepest({"sh": gradient})["sh"]
    assert direction.tolist() == [[0, 0], [1, 0], [0, 0]]


@given(norms, seeds)
def test_noise_is_as_large_as_what_it_controls(norm: NormName, seed: int) -> None:
    point, reference = draw(seed, spread=0.5, dtype=torch.float64)
    budget = Budget(radius={"sh": 100.0}, norm=norm)
    noisy = budget.noise(
        {"sh": point}, {"sh": reference}, Generator().manual_seed(seed)
    )
    want, got = (
        budget.measure({"sh": p}, {"sh": reference})["sh"] for p in (point, noisy["sh"])
    )
    assert got == pytest.approx(want)
    if norm == "l2_per_gaussian":
        rows = [
            (p - reference).reshape(len(p), -1).norm(dim=1)
            for p in (point, noisy["sh"])
        ]
        torch.testing.assert_close(rows[0], rows[1])


@pytest.mark.parametrize(
    ("norm", "sizes"),
    [("l2", (0.9, 1.0)), ("linf", (0.9, 1.0)), ("l2_per_gaussian", (0.3, 1.0))],
)
def test_the_ball_is_filled_up_to_its_edge(
    norm: NormName, sizes: tuple[float, float]
) -> None:
    reference = torch.zeros(40, 1, 3)
    budget = Budget(radius={"sh": 1.0}, norm=norm)
    point = budget.uniform({"sh": reference}, Generator().manual_seed(1))["sh"]
    assert sizes[0] < NORMS[norm].measure(point.double()) <= sizes[1]


@pytest.mark.parametrize("norm", NORM_NAMES)
def test_nothing_at_all_is_inside(norm: NormName) -> None:
    empty = {"sh": torch.zeros(0, 4, 3)}
    budget = Budget(radius={"sh": 1.0}, norm=norm)
    assert budget.measure(budget.project(empty, empty), empty) == {"sh": 0.0}
    assert len(budget.steepest(empty)["sh"]) == 0
    assert len(budget.uniform(empty, Generator())["sh"]) == 0


@pytest.mark.parametrize("norm", NORM_NAMES)
@pytest.mark.parametrize("value", [1.001, float("nan")])
def test_leaving_the_ball_is_an_error(norm: NormName, value: float) -> None:
    reference = {"opacities": torch.zeros(3)}
    outside = {"opacities": torch.tensor([0.0, value, 0.0])}
    with pytest.raises(BudgetError, match=rf"{norm} of opacities: expected <= 1\.0"):
        Budget(radius={"opacities": 1.0}, norm=norm).check(outside, reference)


@pytest.mark.parametrize(
    ("radius", "norm", "complaint"),
    [
        ({"sh": -1.0}, "l2", "radius of sh: expected a number >= 0, got -1.0"),
        ({"sh": float("inf")}, "l2", "radius of sh: expected a finite number"),
        ({"sh": float("nan")}, "l2", "radius of sh: expected a finite number"),
        ({}, "l2", "radius: expected at least one attribute"),
        ({"sh": 1.0}, "l1", "norm: expected one of linf, l2, l2_per_gaussian, got l1"),
    ],
)
def test_a_wrong_budget_says_what_is_wrong(
    radius: dict[str, float], norm: NormName, complaint: str
) -> None:
    with pytest.raises(InvalidValueError, match=complaint):
        Budget(radius=radius, norm=norm)


@pytest.mark.parametrize("norm", ["l2", "l2_per_gaussian"])
def test_rounding_of_the_norm_does_not_leave_the_ball(norm: NormName) -> None:
    """Around a reference of 0 a float64 perturbation is stored as it is, and its norm
    may round up.
    """
    budget = Budget(radius={"sh": 0.3}, norm=norm)
    reference = {"sh": torch.zeros(12, 4, 3, dtype=torch.float64)}
    for seed in range(40):
        point, _ = draw(seed, spread=1.0, dtype=torch.float64)
        budget.check(budget.project({"sh": point}, reference), reference)
