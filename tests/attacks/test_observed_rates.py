"""Rates counted from rows: what counts, what holds, and what belongs together."""

from __future__ import annotations

import polars as pl
import pytest

from attacks.observe.rates import Measure, banded, count, jointly, paired

ROWS = pl.DataFrame(
    {
        "splat": ["clean", "clean", "clean", "cloaked", "cloaked"],
        "detector": ["a", "a", "b", "a", "b"],
        "view": [0, 1, 0, 0, 0],
        "score": [0.9, 0.2, 0.5, 0.1, None],
    }
)
REPORTED = Measure(holds=pl.col("score") >= 0.5)


def numbers(rows: pl.DataFrame, measure: Measure, *by: str) -> dict[tuple[object, ...], tuple[int, int]]:
    found = count(rows, {"rate": measure}, by)
    return {group: (rates["rate"].successes, rates["rate"].total) for group, rates in found.items()}


def test_what_cannot_be_said_does_not_hold_and_counts() -> None:
    assert numbers(ROWS, REPORTED) == {(): (2, 5)}


def test_only_rows_that_are_given_count() -> None:
    measure = Measure(holds=pl.col("score") >= 0.5, given=pl.col("view") == 0)
    assert numbers(ROWS, measure) == {(): (2, 4)}


def test_groups_come_in_the_order_of_their_first_rows() -> None:
    found = numbers(ROWS, REPORTED, "splat", "detector")
    assert list(found.items()) == [
        (("clean", "a"), (1, 2)),
        (("clean", "b"), (1, 1)),
        (("cloaked", "a"), (0, 1)),
        (("cloaked", "b"), (0, 1)),
    ]


def test_pairs_have_both_scenes_side_by_side() -> None:
    pairs = paired(ROWS, ("clean", "cloaked"), scene="splat", on=("detector", "view"))
    assert pairs.columns == ["detector", "view", "clean.score", "cloaked.score"]
    assert pairs.rows() == [("a", 0, 0.9, 0.1), ("b", 0, 0.5, None)]  # nobody saw the cloaked splat from view 1


def test_together_holds_what_holds_for_every_detector() -> None:
    rows = pl.DataFrame({"view": [0, 0, 1, 1], "success": [True, False, True, True]})
    assert jointly(rows, ("view",), ("success",)).rows() == [(0, False), (1, True)]


@pytest.mark.parametrize(("angle", "part"), [(0.0, 0), (9.99, 0), (10.0, 1), (30.0, 2), (-5.0, 0)])
def test_bands_hold_their_lower_edge_and_what_lies_outside_the_nearest(angle: float, part: int) -> None:
    rows = pl.DataFrame({"angle": [angle], "success": [True]})
    bands = banded(rows, "angle", (0.0, 30.0), 3, Measure(holds=pl.col("success")))
    assert [band["total"] for band in bands] == [int(part == place) for place in range(3)]
    assert [band["from"] for band in bands] == [0.0, 10.0, 20.0]
