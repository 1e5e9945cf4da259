"""Which picture is due: coarse ones while the camera moves, a full one at rest, then what was found in it."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.session import LOWEST_SCALE, REST, Pace, Session, Step, ViewState

STATE = ViewState(
    orbit=Orbit(target=(0, 0, 0), azimuth=0.0, elevation=0.0, distance=1.0, fov=45.0), mode="side by side"
)
MOVED = replace(STATE, orbit=replace(STATE.orbit, azimuth=1.0))


def rest(session: Session) -> float:
    return session.changed + REST + 0.01


def test_the_order_of_pictures() -> None:
    session = Session(state=STATE, changed=10.0)
    seen = []
    now = 10.0
    while (step := session.due(now, inspector=True) or session.due(rest(session), inspector=True)) is not None:
        seen.append(step)
        session = session.done(step, session.state, 0.01)
    assert seen == [Step.COARSE, Step.FULL, Step.INSPECTED]


def test_nothing_full_before_the_rest() -> None:
    session = Session(state=STATE, changed=10.0).done(Step.COARSE, STATE, 0.01)
    assert session.due(10.0 + 0.9 * REST, inspector=True) is None
    assert session.due(rest(session), inspector=True) is Step.FULL


@pytest.mark.parametrize(("inspector", "wanted"), [(False, True), (True, False)])
def test_no_inspection_without_somebody_or_a_wish(inspector: bool, wanted: bool) -> None:
    state = replace(STATE, inspected=wanted)
    session = Session(state=state, changed=0.0, painted=Step.FULL)
    assert session.due(100.0, inspector=inspector) is None


def test_a_change_begins_anew_and_the_same_is_none() -> None:
    session = Session(state=STATE, changed=0.0, painted=Step.INSPECTED)
    assert session.change(replace(STATE), 5.0) is session
    changed = session.change(MOVED, 5.0)
    assert (changed.changed, changed.painted) == (5.0, None)
    assert changed.due(5.0, inspector=True) is Step.COARSE


def test_a_picture_of_what_has_changed_meanwhile_is_not_the_last() -> None:
    session = Session(state=STATE, changed=0.0).change(MOVED, 1.0)
    late = session.done(Step.COARSE, STATE, 0.5)
    assert late.due(1.0, inspector=True) is Step.COARSE
    assert late.pace.scale < session.pace.scale  # but its time counts


def test_only_coarse_pictures_set_the_pace() -> None:
    session = Session(state=STATE, changed=0.0)
    assert session.done(Step.FULL, STATE, 9.0).pace == session.pace


@given(st.floats(1e-3, 0.4))
def test_the_pace_finds_the_size_whose_time_is_wanted(cost: float) -> None:
    """A machine that takes `cost` seconds for a full picture, in proportion to its pixels."""
    pace = Pace()
    for _ in range(30):
        pace = pace.after(cost * pace.scale**2)
    took = cost * pace.scale**2
    assert LOWEST_SCALE <= pace.scale <= 1
    assert took <= 1.3 * pace.seconds
    assert took >= pace.seconds / 1.3 or pace.scale == 1.0
    assert pace.after(took) == pace  # and there it stays


def test_sizes_of_coarse_pictures() -> None:
    assert Pace(scale=0.5).size((101, 50)) == (50, 25)
    assert Pace(scale=0.2).size((2, 1)) == (1, 1)
