"""Rates counted from rows: what counts, what holds, and what belongs together."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from attacks.observe.rates import Measure, banded, blocks_of, count
from attacks.rate import Rate

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


@pytest.mark.parametrize(("angle", "part"), [(0.0, 0), (9.99, 0), (10.0, 1), (30.0, 2), (-5.0, 0)])
def test_bands_hold_their_lower_edge_and_what_lies_outside_the_nearest(angle: float, part: int) -> None:
    rows = pl.DataFrame({"angle": [angle], "success": [True]})
    bands = banded(rows, "angle", (0.0, 30.0), 3, Measure(holds=pl.col("success")))
    assert [band["total"] for band in bands] == [int(part == place) for place in range(3)]
    assert [band["from"] for band in bands] == [0.0, 10.0, 20.0]


def many(agree: bool) -> pl.DataFrame:
    """Rows of 20 blocks, 3 seeds and 10 views each, half of which hold: whole blocks, or views by chance."""
    rng = np.random.default_rng(5)
    places = [(block, seed, view) for block in range(20) for seed in range(3) for view in range(10)]
    holds = [block % 2 == 0 if agree else bool(rng.random() < 0.5) for block, _, _ in places]
    return pl.DataFrame(places, schema=["block", "seed", "view"], orient="row").with_columns(holds=pl.Series(holds))


def test_views_that_agree_make_a_wide_interval() -> None:
    widths = {}
    for agree in (True, False):
        (rate,) = count(many(agree), {"rate": Measure(holds=pl.col("holds"))}, clusters=("block", "seed"))[()].values()
        low, high = rate.interval
        assert low < rate.fraction < high
        widths[agree] = high - low
    assert widths[True] == pytest.approx(2 * 1.96 * 0.5 / 20**0.5, rel=0.15)  # of 20 independent draws
    assert widths[False] < 0.4 * widths[True]


def test_a_resampled_interval_is_the_same_every_time() -> None:
    first, second = (
        count(many(agree=True), {"rate": Measure(holds=pl.col("holds"))}, clusters=("block", "seed"))[()][
            "rate"
        ].interval
        for _ in range(2)
    )
    assert first == second


@pytest.mark.parametrize(("blocks", "holds"), [(4, None), (20, True), (20, False)])
def test_where_blocks_say_nothing_each_counts_once(blocks: int, holds: bool | None) -> None:
    rows = many(agree=True).filter(pl.col("block") < blocks)
    if holds is not None:
        rows = rows.with_columns(holds=pl.lit(holds))
    rate = count(rows, {"rate": Measure(holds=pl.col("holds"))}, clusters=("block", "seed"))[()]["rate"]
    assert rate.interval == Rate(successes=round(rate.fraction * blocks), total=blocks).interval


def over(objects: int, spread: float) -> Rate:
    """A rate over ten views of 20 blocks of each object, of which so many tenths more hold the later it comes."""
    rng, middle = np.random.default_rng(1), (objects - 1) / 2
    places = [(thing, block, 0) for thing in range(objects) for block in range(20) for _ in range(10)]
    holds = [bool(rng.random() < 0.5 + spread * (thing - middle) / 10) for thing, _, _ in places]
    rows = pl.DataFrame(places, schema=["object", "block", "seed"], orient="row").with_columns(holds=pl.Series(holds))
    return count(rows, {"rate": Measure(holds=pl.col("holds"))}, clusters=("object", "block", "seed"))[()]["rate"]


@pytest.mark.parametrize("objects", [5, 8])
def test_objects_that_differ_make_a_wide_interval(objects: int) -> None:
    """Within what a t interval over as many numbers says, and never wider than if each object were one draw."""
    widths = []
    for spread in (0.0, 1.0):
        rate = over(objects, spread)
        assert rate.interval[0] < rate.fraction < rate.interval[1]
        widths.append(rate.interval[1] - rate.interval[0])
    deviation = np.std(np.arange(objects) / 10, ddof=1) / objects**0.5
    assert 0.6 < widths[1] / (2 * {5: 2.776, 8: 2.365}[objects] * deviation) < 1.3
    assert widths[0] < 0.5 * widths[1] < Rate(successes=objects // 2, total=objects).interval[1]


def test_objects_that_all_agree_count_once_each() -> None:
    rows = pl.DataFrame({"object": [0, 1, 2, 3, 4] * 20, "block": range(100), "seed": 0, "holds": True})
    sure = count(rows, {"rate": Measure(holds=pl.col("holds"))}, clusters=("object", "block", "seed"))[()]["rate"]
    assert sure.interval == Rate(successes=5, total=5).interval


def test_blocks_are_as_wide_near_the_pole_as_at_the_horizon() -> None:
    def blocks(elevation: float) -> int:
        azimuths = pl.DataFrame({"azimuth": [float(a) for a in range(360)]}).with_columns(elevation=pl.lit(elevation))
        return azimuths.select(blocks_of("azimuth", "elevation")).n_unique()

    assert [blocks(0.0), blocks(60.0), blocks(85.0)] == [18, 9, 3]
    below_and_above = pl.DataFrame({"azimuth": [5.0, 5.0], "elevation": [-5.0, 65.0]})
    assert below_and_above.select(blocks_of("azimuth", "elevation")).n_unique() == 2


def test_blocks_in_which_nothing_counts_have_no_part_in_an_interval() -> None:
    rows = many(agree=True).with_columns(inside=pl.col("block") < 8)
    measure = Measure(holds=pl.col("holds"), given=pl.col("inside"))
    among = count(rows, {"rate": measure}, clusters=("block", "seed"))[()]["rate"]
    alone = count(rows.filter("inside"), {"rate": measure}, clusters=("block", "seed"))[()]["rate"]
    assert among == alone
