"""Rates counted from rows: what counts, what holds, and what belongs together."""

from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.stats import binomtest

from attacks.dagger.figures import verdict_figures
from attacks.figures.frame import HIGH, LOW, MEASURE, Figures
from attacks.figures.rate import Rate
from attacks.observe.rates import (
    AIMS,
    CLUSTERS,
    REPORTED_AS_ORIGINAL,
    Measure,
    banded,
    blocks_of,
    cloak_measures,
    count,
    joint_views,
    rates_at,
    transfer_measures,
    with_control,
    with_thresholds,
)
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, frame_of

ROWS = pl.DataFrame(
    {
        "splat": ["clean", "clean", "clean", "cloaked", "cloaked"],
        "detector": ["a", "a", "b", "a", "b"],
        "view": [0, 1, 0, 0, 0],
        "score": [0.9, 0.2, 0.5, 0.1, None],
    }
)
REPORTED = Measure(holds=pl.col("score") >= 0.5)


def numbers(
    rows: pl.DataFrame, measure: Measure, *by: str
) -> dict[tuple[object, ...], tuple[int, int]]:
    groups = count(rows, {"rate": measure}, by).groups(*by)
    rates = {group: of_group.rate("rate") for group, of_group in groups.items()}
    return {group: (rate.successes, rate.total) for group, rate in rates.items()}


def test_what_cannot_be_said_does_not_hold_and_counts() -> None:
    assert numbers(ROWS, REPORTED) == {(): (2, 5)}
    assert numbers(ROWS, Measure(holds=REPORTED.holds, given=pl.col("view") == 0)) == {
        (): (2, 4)
    }


def test_groups_come_in_the_order_of_their_first_rows() -> None:
    rates = numbers(ROWS, REPORTED, "splat", "detector")
    assert list(rates.items()) == [
        (("clean", "a"), (1, 2)),
        (("clean", "b"), (1, 1)),
        (("cloaked", "a"), (0, 1)),
        (("cloaked", "b"), (0, 1)),
    ]


def test_bands_hold_their_lower_edge_and_what_lies_outside_the_nearest() -> None:
    rows = pl.DataFrame({"angle": [-5.0, 0.0, 9.99, 10.0, 30.0], "success": [True] * 5})
    measures = {"held": Measure(holds=pl.col("success"))}
    bands = banded(rows, "angle", (0.0, 30.0), 3, measures)
    totals = [
        (low, band.rate("held", scope="angle").total)
        for (low, _), band in bands.groups(LOW, HIGH).items()
    ]
    assert totals == [(0.0, 3), (10.0, 1), (20.0, 1)]


def many(agree: bool) -> pl.DataFrame:
    """Rows of 20 blocks, 3 seeds and 10 views each, half of which hold: whole blocks,
    or views by chance.
    """
    rng = np.random.default_rng(5)
    keys = [
        (block, seed, view)
        for block in range(20)
        for seed in range(3)
        for view in range(10)
    ]
    holds = [
        block % 2 == 0 if agree else bool(rng.random() < 0.5) for block, _, _ in keys
    ]
    return pl.DataFrame(
        keys, schema=["block", "seed", "view"], orient="row"
    ).with_columns(holds=pl.Series(holds))


def test_views_that_agree_make_a_wide_interval() -> None:
    widths = {}
    for agree in (True, False):
        rate = count(
            many(agree),
            {"rate": Measure(holds=pl.col("holds"))},
            clusters=("block", "seed"),
        ).rate("rate")
        low, high = rate.interval
        assert low < rate.fraction < high
        widths[agree] = high - low
    # of 20 independent draws
    assert widths[True] == pytest.approx(2 * 1.96 * 0.5 / 20**0.5, rel=0.15)
    assert widths[False] < 0.4 * widths[True]


@pytest.mark.parametrize(("blocks", "holds"), [(4, None), (20, True), (20, False)])
def test_where_blocks_say_nothing_each_counts_once(
    blocks: int, holds: bool | None
) -> None:
    rows = (
        many(agree=True)
        .filter(pl.col("block") < blocks)
        .with_columns(object=pl.col("block"))
    )
    if holds is not None:
        rows = rows.with_columns(holds=pl.lit(holds))
    for clusters in (("block", "seed"), ("object", "block", "seed"))[
        : 1 if holds is None else 2
    ]:
        holding = {"rate": Measure(holds=pl.col("holds"))}
        rate = count(rows, holding, clusters=clusters).rate("rate")
        assert (
            rate.interval
            == Rate(successes=round(rate.fraction * blocks), total=blocks).interval
        )


def over(objects: int, spread: float) -> Rate:
    """A rate over ten views of 20 blocks of each object, of which so many tenths more
    hold the later it comes.
    """
    rng = np.random.default_rng(1)
    middle = (objects - 1) / 2
    keys = [
        (object_, block, 0)
        for object_ in range(objects)
        for block in range(20)
        for _ in range(10)
    ]
    holds = [
        bool(rng.random() < 0.5 + spread * (object_ - middle) / 10)
        for object_, _, _ in keys
    ]
    rows = pl.DataFrame(
        keys, schema=["object", "block", "seed"], orient="row"
    ).with_columns(holds=pl.Series(holds))
    return count(
        rows,
        {"rate": Measure(holds=pl.col("holds"))},
        clusters=("object", "block", "seed"),
    ).rate("rate")


@pytest.mark.parametrize("objects", [5, 8])
def test_objects_that_differ_make_a_wide_interval(objects: int) -> None:
    """Within what a t interval over as many numbers says, and never wider than if each
    object were one draw.
    """
    widths = []
    for spread in (0.0, 1.0):
        rate = over(objects, spread)
        assert rate.interval[0] < rate.fraction < rate.interval[1]
        widths.append(rate.interval[1] - rate.interval[0])
    deviation = np.std(np.arange(objects) / 10, ddof=1) / objects**0.5
    assert 0.6 < widths[1] / (2 * {5: 2.776, 8: 2.365}[objects] * deviation) < 1.3
    assert (
        widths[0]
        < 0.5 * widths[1]
        < Rate(successes=objects // 2, total=objects).interval[1]
    )


def test_blocks_are_as_wide_near_the_pole_as_at_the_horizon() -> None:
    def blocks(elevation: float) -> int:
        azimuths = pl.DataFrame(
            {"azimuth": [float(a) for a in range(360)]}
        ).with_columns(elevation=pl.lit(elevation))
        return azimuths.select(blocks_of("azimuth", "elevation")).n_unique()

    assert [blocks(0.0), blocks(60.0), blocks(85.0)] == [18, 9, 3]
    below_and_above = pl.DataFrame({"azimuth": [5.0, 5.0], "elevation": [-5.0, 65.0]})
    assert below_and_above.select(blocks_of("azimuth", "elevation")).n_unique() == 2


def test_blocks_in_which_nothing_counts_have_no_part_in_an_interval() -> None:
    rows = many(agree=True).with_columns(inside=pl.col("block") < 8)
    measure = Measure(holds=pl.col("holds"), given=pl.col("inside"))
    among, alone = (
        count(of, {"rate": measure}, clusters=("block", "seed")).rate("rate")
        for of in (rows, rows.filter("inside"))
    )
    assert among == alone


# What figures count, on rows that were written by hand


def counts(figures: Figures) -> dict[str, tuple[int, int]]:
    rates = {name: figures.rate(name) for name in figures.labels(MEASURE)}
    return {name: (rate.successes, rate.total) for name, rate in rates.items()}


def aims(
    splat: str, view: int, detector: str, *, success: bool, **further: Any
) -> dict[str, Any]:
    row = {
        "splat": splat,
        "draw": None,
        "view": view,
        "detector": detector,
        "success": success,
        "aim": float(success),
    }
    return {
        **row,
        "unambiguous": success,
        "original": "car",
        "original_score": 0.9,
        **further,
    }


JUDGED = frame_of(
    [
        aims(CLEAN, 0, "a", success=False),
        aims(CLEAN, 0, "b", success=True, original=None),
        aims(CLEAN, 1, "a", success=True, original_score=0.4),
        aims(CLEAN, 1, "b", success=True),
        aims(ATTACKED, 0, "a", success=True, original_score=0.1),
        aims(ATTACKED, 0, "b", success=True, original=None, unambiguous=False, aim=0.6),
        aims(ATTACKED, 1, "a", success=True),
        aims(ATTACKED, 1, "b", success=False),
        *(
            aims(NOISE, view, name, success=view == draw, draw=draw, unambiguous=None)
            for draw in (0, 1)
            for view in (0, 1)
            for name in "ab"
        ),
    ]
)


def test_a_view_counts_where_every_detector_is_deceived() -> None:
    figures = count(joint_views(JUDGED), AIMS, ("splat",))
    rates = counts(figures.where(splat=ATTACKED))
    # b calls the clean object nothing, so that nothing of it can be left
    assert rates == {"success": (1, 2), "strict": (1, 2), "unambiguous": (0, 2)}
    assert counts(figures.where(splat=CLEAN))["success"] == (1, 2)
    # each draw counts for each view
    assert counts(figures.where(splat=NOISE))["success"] == (2, 4)
    figures = count(joint_views(JUDGED.filter(detector="a")), AIMS, ("splat",))
    alone = counts(figures.where(splat=ATTACKED))
    assert alone == {"success": (2, 2), "strict": (1, 2), "unambiguous": (2, 2)}
    assert counts(count(with_thresholds(JUDGED), REPORTED_AS_ORIGINAL)) == {
        "found_clean": (2, 4),
        "found_attacked": (2, 4),
    }


@pytest.mark.parametrize(
    ("views", "success", "aim"), [(1.0, False, 0.0), (0.5, True, 0.6)]
)
def test_an_attack_counts_as_its_settings_ask(
    views: float, success: bool, aim: float
) -> None:
    verdict = verdict_figures(JUDGED, ["a", "b"], views)
    assert bool(verdict.rate("reached", splat=ATTACKED).successes) == success
    assert verdict.value("score", splat=ATTACKED) == aim
    assert verdict.rate("reached", splat=NOISE).total == 2


def looks(view: int, *scores: tuple[float, float]) -> list[dict[str, Any]]:
    """Clean, attacked and noisy: the scores of the original and of the wanted class."""
    names = (CLEAN, ATTACKED, NOISE)
    return [
        {
            "seed": None,
            "splat": name,
            "view": view,
            "detector": "a",
            "original_score": own,
            "target_score": wanted,
        }
        for name, (own, wanted) in zip(names, scores, strict=True)
    ]


LOOKS = frame_of(
    [
        *looks(0, (0.9, 0.0), (0.2, 0.8), (0.9, 0.0)),
        *looks(1, (0.9, 0.0), (0.2, 0.3), (0.4, 0.0)),
        *looks(2, (0.4, 0.0), (0.1, 0.9), (0.1, 0.9)),  # not found clean
        # taken for the target without an attack
        *looks(3, (0.9, 0.6), (0.1, 0.9), (0.1, 0.9)),
    ]
)


def test_transfer_counts_views_whose_clean_object_is_found_and_has_a_control() -> None:
    # has no control: left out
    alone = LOOKS.filter(splat=ATTACKED).with_columns(view=pl.lit(9, dtype=pl.Int64))
    rows = with_control(pl.concat([LOOKS, alone]))
    assert len(rows) == len(LOOKS)
    assert rows["clean.original_score"].to_list()[:3] == [0.9] * 3
    assert counts(count(rows, transfer_measures())) == {
        "found": (2, 4),
        "targeted": (1, 2),
        "untargeted": (2, 2),
        "noise_targeted": (0, 2),
        "noise_untargeted": (1, 2),
    }


def test_a_rate_is_given_at_several_confidences() -> None:
    rows = with_control(LOOKS)
    at = rates_at(
        rows,
        transfer_measures,
        {"0.25": 0.25, "equal": {"a": 0.85}, "sure": 0.95},
        ("detector",),
    )
    assert counts(at["0.25"].where(detector="a"))["targeted"] == (3, 3)
    assert counts(at["equal"].where(detector="a"))["targeted"] == (1, 3)
    assert counts(at["sure"].where(detector="a"))["targeted"] == (0, 0)


def seen(splat: str, depth: float, score: float, **further: Any) -> dict[str, Any]:
    where = {
        "azimuth": 10.0 * depth % 360,
        "elevation": 40.0,
        "depth: above": depth,
        "poison_depth: above": depth + 8,
    }
    scores = {
        "original_score": score,
        "score": max(score, 0.3),
        "any_overlap": score,
        "target_score: side": 0.0,
    }
    side = {"depth: side": -1.0, "poison_depth: side": -1.0}
    row = {
        "seed": 0,
        "splat": splat,
        "view": int(depth),
        "detector": "a",
        **where,
        **side,
    }
    return {**row, **scores, **further}


CLOAK = frame_of(
    [
        *(seen(CLEAN, depth, 0.9 if depth != 7 else 0.1) for depth in range(-9, 9)),
        *(seen(ATTACKED, depth, 0.9 if depth < 2 else 0.2) for depth in range(-9, 9)),
    ]
)


def cloak(**settings: Any) -> dict[str, tuple[int, int]]:
    measures = cloak_measures(
        ["above", "side"], hiding="above", showing="side", well_inside=5.0, **settings
    )
    return counts(count(with_control(CLOAK), measures, clusters=CLUSTERS))


def test_cloak_is_counted_by_the_depth_inside_the_trigger() -> None:
    rates = cloak()
    assert rates["control_recall"] == (8, 9)
    assert rates["trigger_miss_rate"] == (3, 3)
    assert rates["trigger_miss_rate_all"] == (6, 8)
    assert rates["trigger_miss_rate_unconditional"] == (4, 4)
    assert rates["nothing_reported"] == (3, 3)
    assert rates["benign_recall"] == (9, 9)
    assert rates["target_rate"] == (0, 0)
    assert cloak(confidence=0.25)["nothing_reported"] == (0, 3)


@pytest.mark.parametrize(("successes", "total"), [(0, 5), (1, 9), (17, 60), (60, 60)])
def test_intervals_are_those_of_wilson_at_95_per_cent(
    successes: int, total: int
) -> None:
    known = binomtest(successes, total).proportion_ci(0.95, method="wilson")
    assert Rate(successes=successes, total=total).interval == pytest.approx(
        (known.low, known.high)
    )


def test_resampled_intervals_cover_95_per_cent_of_what_is_drawn_anew() -> None:
    """Of independent blocks, each of one row, the interval is about that of the mean of
    as many draws.
    """
    holds = np.random.default_rng(0).random(400) < 0.3
    rows = pl.DataFrame({"holds": holds, "block": np.arange(400), "seed": 0})
    holding = {"rate": Measure(holds=pl.col("holds"))}
    rate = count(rows, holding, clusters=CLUSTERS).rate("rate")
    low, high = rate.interval
    deviation = (rate.fraction * (1 - rate.fraction) / 400) ** 0.5
    assert (high - low) / (2 * deviation) == pytest.approx(1.96, rel=0.06)


def test_a_control_is_that_of_its_own_seed() -> None:
    """Clean splats of other seeds score otherwise, and are the control of nothing
    else.
    """
    rows = pl.DataFrame(
        {
            "seed": [1, 1, 2, 2],
            "splat": [CLEAN, ATTACKED] * 2,
            "detector": ["a"] * 4,
            "view": [0] * 4,
            "original_score": [0.9, 0.1, 0.2, 0.1],
        }
    )
    paired = with_control(rows).filter(splat=ATTACKED)
    assert dict(zip(paired["seed"], paired["clean.original_score"], strict=True)) == {
        1: 0.9,
        2: 0.2,
    }
