"""What figures count, on rows that were written by hand."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from attacks.dagger.config import DaggerConfig
from attacks.dagger.figures import verdict_figures
from attacks.observe.measures import (
    AIMS,
    CLUSTERS,
    FOUND,
    cloak_measures,
    joint_views,
    rates_at,
    threshold_curve,
    transfer_measures,
    with_control,
)
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, POISON_DEPTH, frame_of
from attacks.rate import Rate


def counts(rates: dict[str, Rate]) -> dict[str, tuple[int, int]]:
    return {name: (rate.successes, rate.total) for name, rate in rates.items()}


def aims(splat: str, view: int, detector: str, *, success: bool, **further: Any) -> dict[str, Any]:
    row = {"splat": splat, "draw": None, "view": view, "detector": detector, "success": success, "aim": float(success)}
    return {**row, "unambiguous": success, "original": "car", "original_score": 0.9, **further}


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
    rates = counts(count(joint_views(JUDGED), AIMS)[()])
    assert rates["success"] == (1, 2)
    assert rates["strict"] == (1, 2)  # b calls the clean object nothing, so that nothing of it can be left
    assert rates["unambiguous"] == (0, 2)
    assert rates["clean_success"] == (1, 2)
    assert rates["noise_success"] == (2, 4)  # each draw counts for each view
    alone = counts(count(joint_views(JUDGED.filter(detector="a")), AIMS)[()])
    assert (alone["success"], alone["strict"], alone["unambiguous"]) == ((2, 2), (1, 2), (2, 2))
    assert counts(count(JUDGED, FOUND)[()]) == {"found_clean": (2, 4), "found_attacked": (2, 4)}


@pytest.mark.parametrize(
    ("views", "detectors", "success", "aim"), [(1.0, 1.0, False, 0.0), (0.5, 1.0, True, 0.6), (1.0, 0.5, True, 1.0)]
)
def test_an_attack_counts_as_its_settings_ask(views: float, detectors: float, success: bool, aim: float) -> None:
    config = DaggerConfig(required_views=views, required_detectors=detectors)
    told = verdict_figures(JUDGED, ["a", "b"], config)
    assert (told["success"], told["score"], told["noise"]["draws"]) == (success, aim, 2)


def looks(view: int, *scores: tuple[float, float]) -> list[dict[str, Any]]:
    """Clean, attacked and noisy: the scores of the original and of the wanted class."""
    names = (CLEAN, ATTACKED, NOISE)
    return [
        {"seed": None, "splat": name, "view": view, "detector": "a", "original_score": own, "target_score": wanted}
        for name, (own, wanted) in zip(names, scores, strict=True)
    ]


LOOKS = frame_of(
    [
        *looks(0, (0.9, 0.0), (0.2, 0.8), (0.9, 0.0)),
        *looks(1, (0.9, 0.0), (0.2, 0.3), (0.4, 0.0)),
        *looks(2, (0.4, 0.0), (0.1, 0.9), (0.1, 0.9)),  # not found clean
        *looks(3, (0.9, 0.6), (0.1, 0.9), (0.1, 0.9)),  # taken for the target without an attack
    ]
)


def test_transfer_is_of_the_views_whose_clean_object_is_found_and_stands_beside_noise() -> None:
    rows = with_control(LOOKS)
    assert rows["clean.original_score"].to_list()[:3] == [0.9] * 3
    assert counts(count(rows, transfer_measures())[()]) == {
        "found": (2, 4),
        "targeted": (1, 2),
        "untargeted": (2, 2),
        "noise_targeted": (0, 2),
        "noise_untargeted": (1, 2),
    }


def test_rows_without_a_control_are_left_out() -> None:
    other = LOOKS.filter(splat=ATTACKED).with_columns(view=pl.lit(9, dtype=pl.Int64))
    assert len(with_control(pl.concat([LOOKS, other]))) == len(LOOKS)


def test_a_rate_is_given_at_several_confidences_and_as_a_curve() -> None:
    rows = with_control(LOOKS)
    at = rates_at(rows, transfer_measures, {"0.25": 0.25, "equal": {"a": 0.85}}, ("detector",))
    assert counts(at["0.25"]["a",])["targeted"] == (3, 3)
    assert counts(at["equal"]["a",])["targeted"] == (1, 3)
    (curve,) = threshold_curve(rows, transfer_measures, "targeted", (0.25, 0.5, 0.95)).values()
    assert [(at, rate.successes, rate.total) for at, rate in curve] == [(0.25, 3, 3), (0.5, 1, 2), (0.95, 0, 0)]


def seen(splat: str, depth: float, score: float, **further: Any) -> dict[str, Any]:
    where = {"azimuth": 10.0 * depth % 360, "elevation": 40.0, "depth: above": depth, "poison_depth: above": depth + 8}
    scores = {"original_score": score, "score": max(score, 0.3), "any_overlap": score, "target_score: side": 0.0}
    side = {"depth: side": -1.0, "poison_depth: side": -1.0}
    row = {"seed": 0, "splat": splat, "view": int(depth), "detector": "a", **where, **side}
    return {**row, **scores, **further}


CLOAK = frame_of(
    [
        *(seen(CLEAN, depth, 0.9 if depth != 7 else 0.1) for depth in range(-9, 9)),
        *(seen(ATTACKED, depth, 0.9 if depth < 2 else 0.2) for depth in range(-9, 9)),
    ]
)


def cloak(**settings: Any) -> dict[str, tuple[int, int]]:
    measures = cloak_measures(["above", "side"], hiding="above", showing="side", well_inside=5.0, **settings)
    return counts(count(with_control(CLOAK), measures, clusters=CLUSTERS)[()])


def test_cloak_is_counted_by_the_depth_inside_the_trigger_or_inside_the_poison() -> None:
    rates = cloak()
    assert rates["control_recall"] == (8, 9)
    assert rates["trigger_miss_rate"] == (3, 3)
    assert rates["trigger_miss_rate_all"] == (6, 8)
    assert rates["trigger_miss_rate_unconditional"] == (4, 4)
    assert rates["nothing_reported"] == (3, 3)
    assert rates["benign_recall"] == (9, 9)
    assert rates["target_rate"] == (0, 0)
    assert cloak(confidence=0.25)["nothing_reported"] == (0, 3)
    assert cloak(depth=POISON_DEPTH)["trigger_miss_rate"] == (6, 11)


def test_a_null_does_not_hold() -> None:
    rows = frame_of([{"view": 0, "success": None}, {"view": 1, "success": True}])
    assert counts(count(rows, {"success": Measure(holds=pl.col("success"))})[()]) == {"success": (1, 2)}
