"""Which pictures a rate of a CLOAK study counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from attacks.cloak import setup
from attacks.cloak.config import AttackConfig
from attacks.cloak.observations import Blend, Fidelity, Observation, ObservedSplat, StudyRows
from attacks.cloak.rates import by_elevation, figures, rates, stealth, transition
from attacks.cloak.study.trained_splats import TrainedSplat
from tests.cloak.tiny_study import STUDY


def seen(
    view: int, depth: float, clean: float, cloaked: float, *, sign: float = 0.0, other: float = 0.0
) -> list[ObservedSplat]:
    """Both splats from one camera that is `depth` degrees inside the overhead trigger."""
    observed = []
    for which, score in (("clean", clean), ("cloaked", cloaked)):
        observation = Observation(
            detector="redness",
            view=view,
            azimuth=0.0,
            elevation=38.2 + depth,
            depths={"overhead": depth, "rear": -10.0},
            scores={"car": score, "stop sign": sign if which == "cloaked" else 0.0},
            any_overlap=score,
            any_class=max(score, other) if which == "cloaked" else score,
        )
        trained = TrainedSplat(splat=which, seed=0, file=Path(), content="", gaussians=1, hash="")
        observed.append(ObservedSplat(trained=trained, observations=(observation,), fidelities=(), blends=()))
    return observed


def test_rates_have_the_denominators_that_they_say() -> None:
    observed = [
        *seen(0, 10, 0.9, 0.1, other=0.8),
        *seen(1, 10, 0.9, 0.9),
        *seen(2, 10, 0.2, 0.1),  # the control is not found
        *seen(3, 2, 0.9, 0.1),  # near the edge
        *seen(4, -5, 0.9, 0.9),
        *seen(5, -5, 0.9, 0.3),
        *seen(6, -5, 0.3, 0.3),
    ]
    found = rates(STUDY, StudyRows.of(observed).rows)[()]

    def numbers(name: str) -> tuple[int, int]:
        rate = found[name]
        assert rate is not None
        return rate.successes, rate.total

    assert numbers("control_recall") == (3, 4)
    assert numbers("trigger_miss_rate") == (1, 2)
    assert numbers("nothing_reported") == (0, 2)  # what is no car any more is something else
    assert numbers("trigger_miss_rate_all") == (2, 3)
    assert numbers("trigger_miss_rate_unconditional") == (2, 3)
    assert numbers("benign_recall") == (1, 2)
    assert numbers("control_benign_recall") == (2, 3)
    assert numbers("target_rate") == (0, 0)
    rows = {
        low: (clean.successes, cloaked.successes, clean.total)
        for low, clean, cloaked in by_elevation(STUDY, StudyRows.of(observed).rows)["redness"]
    }
    assert rows == {30.0: (2, 1, 3), 40.0: (1, 0, 1), 45.0: (2, 1, 3)}


def test_the_class_wanted_counts_on_the_cloaked_splat() -> None:
    observed = [
        replace(
            item, observations=tuple(replace(one, depths={"overhead": -20.0, "rear": 3.0}) for one in item.observations)
        )
        for item in [*seen(0, -20, 0.9, 0.1, sign=0.8), *seen(1, -20, 0.9, 0.1, sign=0.4)]
    ]
    found = rates(STUDY, StudyRows.of(observed).rows)[()]
    assert found["target_rate"] is not None
    assert found["control_target_rate"] is not None
    assert (found["target_rate"].successes, found["target_rate"].total) == (1, 2)
    assert (found["control_target_rate"].successes, found["control_target_rate"].total) == (0, 2)


def test_meridians_rise_to_straight_above() -> None:
    target = setup.target_of(STUDY.scene)
    for arc in setup.arcs(STUDY, target):
        heights = [float(camera.position[2]) for camera in arc]
        assert heights == sorted(heights)
        assert np.ptp([float(camera.position.norm()) for camera in arc]) < 1.0


def test_arcs_into_a_sector_come_from_beside_it() -> None:
    """Depths in the trigger rise along each, from well outside to the middle; a sign that is shown has none."""
    sector = AttackConfig(name="sector", appearance="remove", elevation=(0, 30), azimuth=(100, 30))
    study, target = replace(STUDY, attack=(sector,)), setup.target_of(STUDY.scene)
    found = setup.arcs(study, target)
    assert len(found) == study.evaluation.meridians
    for arc in found:
        depths = [sector.cone.angle_to_edge(camera, centre=setup.centre_of(study)) for camera in arc]
        assert depths == sorted(depths)
        assert depths[0] < -30
        assert 10 < depths[-1] <= 30
    assert setup.arcs(replace(STUDY, attack=(replace(sector, target_class="stop sign"),)), target) == []


def test_the_transition_into_a_sector_is_one_of_depth() -> None:
    sector = AttackConfig(name="sector", appearance="remove", elevation=(0, 30), azimuth=(100, 30))
    study = replace(STUDY, attack=(sector,))
    splat = along_the_meridian("cloaked", *((depth, 30.0, 30.0) for depth in (-20, -10, 0, 10)))
    fractions = (0.0, 0.0, 1.0, 1.0)
    blends = tuple(
        replace(one, elevation=10.0, fraction=part) for one, part in zip(splat.blends, fractions, strict=True)
    )
    band = transition(study, StudyRows.of([replace(splat, blends=blends)]))
    assert band is not None
    assert band.start == pytest.approx(-9.0)
    assert band.end == pytest.approx(-1.0)


def test_edges_belong_to_what_lies_inside_them() -> None:
    """A camera just at the depth that counts as well inside, and one at the lower end of a band of elevations."""
    observed = [*seen(0, STUDY.evaluation.well_inside, 0.9, 0.1), *seen(1, 1.8, 0.9, 0.1)]
    miss = rates(STUDY, StudyRows.of(observed).rows)[()]["trigger_miss_rate"]
    assert miss is not None
    assert (miss.successes, miss.total) == (1, 1)
    assert {low: clean.total for low, clean, _ in by_elevation(STUDY, StudyRows.of(observed).rows)["redness"]} == {
        40.0: 2
    }


def test_a_fragment_counts_as_found_by_any_overlap() -> None:
    observed = [
        replace(item, observations=tuple(replace(one, any_overlap=0.8) for one in item.observations))
        for item in seen(0, 10, 0.9, 0.1)
    ]
    found = rates(STUDY, StudyRows.of(observed).rows)[()]
    for key, successes in (("trigger_miss_rate", 1), ("trigger_miss_rate_any_overlap", 0)):
        rate = found[key]
        assert rate is not None
        assert (rate.successes, rate.total) == (successes, 1)


def test_a_cloaked_splat_that_is_less_true_has_a_positive_drop() -> None:
    observed = [
        replace(item, fidelities=(Fidelity(view=0, elevation=5.0, psnr=psnr, ssim=0.9),))
        for item, psnr in zip(seen(0, -20, 0.9, 0.9), (34.0, 32.5), strict=True)
    ]
    found = figures(
        replace(STUDY, evaluation=replace(STUDY.evaluation, detectors=("redness",))), StudyRows.of(observed)
    )
    assert found["benign_psnr_drop"] == 1.5
    assert found["benign_psnr"] == {"clean": 34.0, "cloaked": 32.5}


def along_the_meridian(which: str, *pictures: tuple[float, float, float]) -> ObservedSplat:
    """A splat's pictures as (depth, PSNR beside the object, PSNR on it)."""
    trained = TrainedSplat(splat=which, seed=0, file=Path(), content="", gaussians=1, hash="")
    blends = tuple(
        Blend(
            meridian=0, elevation=40 + depth, depth=depth, fraction=0.5, surroundings_psnr=beside, appearance_psnr=own
        )
        for depth, beside, own in pictures
    )
    return ObservedSplat(trained=trained, observations=(), fidelities=(), blends=blends)


@pytest.mark.parametrize(("lost", "stealthy"), [(1.0, True), (2.0, False)])
def test_stealth_is_what_the_surroundings_lose_inside_the_trigger(lost: float, stealthy: bool) -> None:
    clean = along_the_meridian("clean", (10, 34.0, 12.0), (20, 36.0, 12.0), (-10, 99.0, 9.0))
    cloaked = along_the_meridian("cloaked", (10, 34.0 - lost, 30.0), (20, 36.0 - lost, 32.0), (-10, 9.0, 9.0))
    found = stealth(StudyRows.of([clean, cloaked]))
    assert found is not None
    assert found["surroundings_psnr_drop"] == pytest.approx(lost)
    assert found["surroundings_psnr"]["clean"] == 35.0
    assert found["appearance_psnr"]["cloaked"] == 31.0
    assert found["stealthy"] is stealthy
    assert stealth(StudyRows.of([clean])) is None
