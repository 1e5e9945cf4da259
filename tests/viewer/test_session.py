"""Which image is due: coarse ones while the camera moves, a full one at rest, then
what was found in it.
"""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.session import LOWEST_SCALE, REST, Pace, Session, Step, ViewState

STATE = ViewState(
    orbit=Orbit(target=(0, 0, 0), azimuth=0.0, elevation=0.0, distance=1.0, fov=45.0),
    mode="side by side",
)
MOVED = replace(STATE, orbit=replace(STATE.orbit, azimuth=1.0))


@pytest.mark.parametrize(("scale", "between"), [(0.3, [Step.HALF]), (0.6, [])])
def test_the_order_of_pictures(scale: float, between: list[Step]) -> None:
    session = Session(state=STATE, changed=10.0, pace=Pace(scale=scale))
    seen = list[Step | None]()
    for now in (
        10.0,
        10.0 + 0.9 * REST,
        *(10.1 + REST for _ in range(3 + len(between))),
    ):
        seen.append(step := session.due(now, inspector=True))
        session = session if step is None else session.done(step, session.state, 0.01)
    assert seen == [Step.COARSE, None, *between, Step.FULL, Step.INSPECTED, None]
    assert session.change(replace(STATE), 15.0) is session
    assert session.change(MOVED, 15.0).due(15.0, inspector=True) is Step.COARSE


@pytest.mark.parametrize(("inspector", "inspected"), [(False, True), (True, False)])
def test_no_inspection_without_an_inspector_or_when_it_is_off(
    inspector: bool, inspected: bool
) -> None:
    session = Session(
        state=replace(STATE, inspected=inspected), changed=0.0, painted=Step.FULL
    )
    assert session.due(100.0, inspector=inspector) is None


def test_a_picture_of_an_older_state_counts_only_for_the_pace() -> None:
    session = Session(state=STATE, changed=0.0).change(MOVED, 1.0)
    late = session.done(Step.COARSE, STATE, 0.5)
    assert late.due(1.0, inspector=True) is Step.COARSE
    assert late.pace.scale < session.pace.scale
    assert session.done(Step.FULL, STATE, 9.0).pace == session.pace


@given(st.floats(1e-3, 0.4))
def test_the_pace_finds_the_size_whose_time_is_wanted(cost: float) -> None:
    """A machine that takes `cost` seconds for a full image, in proportion to its
    pixels.
    """
    pace = Pace()
    for _ in range(30):
        pace = pace.after(cost * pace.scale**2)
    took = cost * pace.scale**2
    assert LOWEST_SCALE <= pace.scale <= 1
    assert took <= 1.3 * pace.seconds
    assert took >= pace.seconds / 1.3 or pace.scale == 1.0
    assert pace.after(took) == pace  # and there it stays
