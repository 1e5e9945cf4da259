"""Which images a rate of a CLOAK study counts, and the transition."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from attacks.cloak.config import AttackConfig
from attacks.cloak.figures import (
    by_elevation,
    costs,
    figures,
    measures,
    over_objects,
    rates,
)
from attacks.cloak.kinds.compared import differ, transition_fraction
from attacks.cloak.setup import Setup
from attacks.cloak.tables import region_of, tables
from attacks.cloak.transition import Tables, fit_transition, transition
from attacks.figures.frame import LOW, MEASURE, Figures
from attacks.observe.rates import with_control
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    FIDELITY,
    ROWS,
    TRANSITION,
    frame_of,
    frame_with,
)
from tests.cloak.tiny_study import STUDY

NAMES = ("overhead", "sector")


def seen(
    view: int,
    depth: float,
    clean: float,
    cloaked: float,
    *,
    sign: float = 0.0,
    other: float = 0.0,
) -> list[dict[str, Any]]:
    """Both splats from one camera that is `depth` degrees inside the overhead
    trigger.
    """
    return [
        {
            "splat": which,
            "seed": 0,
            "detector": "redness",
            "view": view,
            "azimuth": 0.0,
            "elevation": 38.2 + depth,
            "depth: overhead": depth,
            "depth: rear": -10.0,
            "original_score": score,
            "target_score: rear": sign if which == ATTACKED else 0.0,
            "any_overlap": score,
            "score": max(score, other) if which == ATTACKED else score,
        }
        for which, score in ((CLEAN, clean), (ATTACKED, cloaked))
    ]


def study_rows(
    rows: Sequence[dict[str, Any]] = (),
    *,
    fidelity: Sequence[dict[str, Any]] = (),
    transition: Sequence[dict[str, Any]] = (),
) -> Tables:
    return {
        ROWS: frame_of(rows),
        FIDELITY: frame_with(fidelity, ("splat", "psnr", "ssim")),
        TRANSITION: frame_with(
            transition,
            ("splat", "elevation", "fraction", *(f"depth: {name}" for name in NAMES)),
        ),
    }


def test_rates_have_the_denominators_that_they_say() -> None:
    observed = [
        *seen(0, 10, 0.9, 0.1, other=0.8),
        *seen(1, 10, 0.9, 0.9),
        *seen(2, 10, 0.2, 0.1),  # the control is not found
        *seen(3, 1.8, 0.9, 0.1),  # near the edge, and at the lower end of a band
        *seen(7, STUDY.evaluation.well_inside, 0.2, 0.1),  # which is inside
        *seen(4, -5, 0.9, 0.9),
        *seen(5, -5, 0.9, 0.3),
        *seen(6, -5, 0.3, 0.3),
    ]
    counted = rates(with_control(frame_of(observed)), measures(STUDY))

    def numbers(name: str) -> tuple[int, int]:
        rate = counted.rate(name)
        return rate.successes, rate.total

    assert numbers("control_recall") == (3, 5)
    assert numbers("trigger_miss_rate") == (1, 2)
    # what is no car any more is something else
    assert numbers("nothing_reported") == (0, 2)
    assert numbers("trigger_miss_rate_all") == (2, 3)
    assert numbers("trigger_miss_rate_unconditional") == (3, 4)
    assert numbers("benign_recall") == (1, 2)
    assert numbers("control_benign_recall") == (2, 3)
    assert numbers("target_rate") == (0, 0)
    elevations = by_elevation(STUDY, frame_of(observed)).where(detector="redness")
    rows = {}
    for (low,), band in elevations.where(scope="elevation").groups(LOW).items():
        clean = band.rate("found", splat=CLEAN, to=low + 5)
        cloaked = band.rate("found", splat=ATTACKED, to=low + 5)
        rows[low] = (clean.successes, cloaked.successes, clean.total)
    assert rows == {30.0: (2, 1, 3), 40.0: (1, 0, 2), 45.0: (2, 1, 3)}


def test_figures_are_counted_in_each_detector_s_own_region() -> None:
    """Bands of 10 degrees in which it finds the control from 80 % of the cameras."""
    scores = [0.9, 0.9, 0.9, 0.9, 0.1]  # 80 % of a band
    observed = [
        *(
            row
            for view, score in enumerate(scores)
            for row in seen(view, 7, score, 0.1)
        ),
        *(row for view in range(5, 9) for row in seen(view, -5, 0.9, 0.9)),
        *(
            row
            for view, score in enumerate([0.9, 0.1], 10)
            for row in seen(view, 30, score, 0.1)
        ),
    ]
    observed += [
        {**row, "detector": "blind", "original_score": 0.1} for row in observed
    ]
    told = figures(
        replace(
            STUDY, evaluation=replace(STUDY.evaluation, detectors=("redness", "blind"))
        ),
        study_rows(observed),
        [],
    )
    own = told.where(scope="own region")
    assert [region_of(own, name) for name in ("redness", "blind")] == [
        "30 to 50 degrees",
        "-",
    ]
    rates_of = own.where(detector="redness")
    assert rates_of.rate("trigger_miss_rate").counts == "4 of 4"
    assert rates_of.rate("control_recall").counts == "4 of 5"
    assert own.labels("detector") == ["redness"]
    table = next(table for table in tables(told) if "own region" in table.caption)
    assert table.head == ("rate", "redness")
    assert table.rows[0] == ("its region", "30 to 50 degrees")


@pytest.mark.parametrize(
    ("lows", "words"),
    [
        ([0.0, 10.0, 40.0], "0 to 20, 40 to 50 degrees"),
        ([30.0], "30 to 40 degrees"),
        ([], "-"),
    ],
)
def test_a_region_is_told_in_words(lows: list[float], words: str) -> None:
    figures = Figures.of(
        ({MEASURE: "region", "detector": "a", LOW: low}, 1.0) for low in lows
    )
    assert region_of(figures, "a") == words


def test_the_class_wanted_counts_on_the_cloaked_splat() -> None:
    pictures = [*seen(0, -20, 0.9, 0.1, sign=0.8), *seen(1, -20, 0.9, 0.1, sign=0.4)]
    inside = {"depth: overhead": -20.0, "depth: rear": 3.0}
    paired = with_control(frame_of({**row, **inside} for row in pictures))
    counted = rates(paired, measures(STUDY))
    assert counted.rate("target_rate").counts == "1 of 2"
    assert counted.rate("control_target_rate").counts == "0 of 2"


SECTOR = AttackConfig(
    name="sector", appearance="remove", elevation=(0, 30), azimuth=(100, 30)
)


def test_arcs_into_a_sector_come_from_beside_it() -> None:
    """Depths in the trigger rise along each, from well outside to the middle; a sign
    that is shown has none.
    """
    study = replace(STUDY, attack=(SECTOR,))
    arcs = Setup.of(study).arcs
    assert len(arcs) == study.evaluation.meridians
    for arc in arcs:
        depths = [
            SECTOR.cone.angle_to_edge(camera, centre=study.centre) for camera in arc
        ]
        assert depths == sorted(depths)
        assert depths[0] < -30
        assert 10 < depths[-1] <= 30
    assert (
        Setup.of(
            replace(STUDY, attack=(replace(SECTOR, target_class="stop sign"),))
        ).arcs
        == []
    )


def test_the_transition_into_a_sector_is_one_of_depth() -> None:
    arc = along_the_meridian(
        ATTACKED,
        *((depth, 30.0, 30.0) for depth in (-20.0, -10.0, 0.0, 10.0)),
        name="sector",
    )
    rows = [
        {**one, "elevation": 10.0, "fraction": float(one["depth: sector"] >= 0)}
        for one in arc
    ]
    band = transition(replace(STUDY, attack=(SECTOR,)), study_rows(transition=rows))
    assert band is not None
    assert (band.start, band.end) == pytest.approx((-9.0, -1.0))


def along_the_meridian(
    which: str, *pictures: tuple[float, float, float], name: str = "overhead"
) -> list[dict[str, Any]]:
    """A splat's images as (depth, PSNR beside the object, PSNR on it)."""
    return [
        {
            **{
                "splat": which,
                "seed": 0,
                "meridian": 0,
                "elevation": 40 + depth,
                f"depth: {name}": depth,
            },
            **{"fraction": 0.5, "surroundings_psnr": beside, "appearance_psnr": own},
        }
        for depth, beside, own in pictures
    ]


@pytest.mark.parametrize(
    ("around", "on_object", "stealthy"),
    [(1.0, 2.0, True), (2.0, 2.0, False), (1.0, 4.0, False)],
)
def test_stealth_is_what_pictures_lose_beside_the_object_and_on_it_beside_a_trigger(
    around: float, on_object: float, stealthy: bool
) -> None:
    clean = along_the_meridian(
        CLEAN, (10.0, 34.0, 12.0), (20.0, 36.0, 12.0), (-10.0, 99.0, 9.0)
    )
    cloaked = along_the_meridian(
        ATTACKED,
        (10.0, 34.0 - around, 30.0),
        (20.0, 36.0 - around, 32.0),
        (-10.0, 9.0, 9.0),
    )
    fidelity = [
        {"splat": splat, "psnr": 30.0, "ssim": 0.9, "object_psnr": psnr}
        for splat, psnr in (
            (CLEAN, None),
            (CLEAN, 32.0),
            (ATTACKED, None),
            (ATTACKED, 32.0 - on_object),
        )
    ]
    pictures = study_rows(transition=[*clean, *cloaked], fidelity=fidelity)
    losses = Figures.of(costs(STUDY, pictures))
    assert losses.value("surroundings_psnr_drop") == pytest.approx(around)
    assert losses.value("object_psnr_drop") == pytest.approx(on_object)
    assert losses.value("surroundings_psnr", splat=CLEAN) == 35.0
    assert losses.value("appearance_psnr", splat=ATTACKED) == 31.0
    assert losses.value("stealthy") == stealthy
    alone = Figures.of(costs(STUDY, study_rows(transition=clean)))
    assert alone.find("stealthy") is None
    # a road without a shadow
    shown = [{**row, "intended_surroundings_psnr": 35.5} for row in (*clean, *cloaked)]
    losses = Figures.of(costs(STUDY, study_rows(transition=shown, fidelity=fidelity)))
    assert losses.value("surroundings_psnr_drop") == pytest.approx(-0.5)


def test_rates_over_objects_draw_objects_anew() -> None:
    """Of five cars four are always missed and one is found: as one draw of five, not as
    one of fifty.
    """
    titles = [f"car: {number}" for number in range(5)]
    studies = {
        title: replace(
            STUDY, scene=replace(STUDY.scene, object=f"car_{number}", label="car")
        )
        for number, title in enumerate(titles)
    }
    observed = [
        {**row, "attack": title, "azimuth": 36.0 * view}
        for title in titles
        for view in range(10)
        for row in seen(view, 10, 0.9, 0.9 if title == titles[0] else 0.1)
    ]
    pooled = over_objects(studies, frame_of(observed)).where(scope="all objects")
    assert pooled.value("objects") == 5
    missed = pooled.rate("trigger_miss_rate", detector="redness")
    assert missed.counts == "40 of 50"
    assert missed.interval[1] - missed.interval[0] > 0.5
    other = replace(STUDY, scene=replace(STUDY.scene, object="bird"))
    assert not len(over_objects({**studies, titles[4]: other}, frame_of(observed)))
    assert not len(over_objects(dict.fromkeys(titles, STUDY), frame_of(observed)))


def test_the_margin_counts_as_elsewhere_and_is_shown_apart() -> None:
    overhead, rear = STUDY.attack
    study = replace(STUDY, attack=(replace(overhead, poison_margin=7.0), rear))
    depths = (-3.0, -6.0, -9.0)
    observed = [
        {**row, "poison_depth: overhead": depth + 7.0, "poison_depth: rear": -10.0}
        for view, depth in enumerate(depths)
        for row in seen(view, depth, 0.9, 0.1 if depth == -3.0 else 0.9)
    ]
    counted = figures(study, study_rows(observed), []).where(detector="redness")
    counts = {
        scope: counted.rate("benign_recall", scope=scope).counts
        for scope in ("within a margin", "beyond every margin")
    }
    assert counts == {"within a margin": "1 of 2", "beyond every margin": "1 of 1"}
    without = figures(STUDY, study_rows(observed), [])
    assert not set(counts) & set(without.labels("scope"))


# The transition on blends with known answers


def appearances(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two images and a mask."""
    generator = torch.Generator().manual_seed(seed)
    benign, hidden = torch.rand(2, 6, 7, 3, generator=generator)
    return benign, hidden, torch.rand(6, 7, generator=generator) > 0.4


@given(st.floats(-0.5, 1.5), st.integers(0, 99))
def test_the_fraction_of_a_blend_is_known(fraction: float, seed: int) -> None:
    benign, hidden, mask = appearances(seed)
    blend = (1 - fraction) * benign + fraction * hidden
    blend[~mask] = 0.5  # elsewhere does not count
    assert transition_fraction(blend, benign, hidden, mask) == pytest.approx(
        fraction, abs=1e-5
    )


def test_a_linear_ramp_has_its_width() -> None:
    angles = [5.0 * i for i in range(19)]
    band = fit_transition(
        angles, [min(max((angle - 40) / 20, 0), 1) for angle in angles]
    )
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
    plain = torch.full((4, 4, 3), 0.5)
    mask = torch.ones(4, 4, dtype=torch.bool)
    assert differ(plain, plain + 1.01 / 255, mask)
    assert not differ(plain, plain + 0.99 / 255, mask)
