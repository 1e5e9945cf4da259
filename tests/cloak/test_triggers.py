"""Triggers: edges, wrap-around, poles, De Morgan, fractions, and depths against a dense
grid of directions.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from attacks.cloak.triggers import Azimuth, Elevation, Subsample, Trigger
from mi_splat.cameras.camera import Camera, look_at, orbit_pose
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere, orbit
from mi_splat.errors import InvalidValueError

CENTRE = (0.3, -0.2, 0.7)


def at(azimuth: float, elevation: float, *, distance: float = 5.0) -> Camera:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=distance)
    return Camera(to_world=pose, lens=Lens(focal=20.0, size=(16, 16)))


def inside(trigger: Trigger, *directions: tuple[float, float]) -> list[bool]:
    cameras = [at(*angles) for angles in directions]
    return [bool(value) for value in trigger.holds(cameras, centre=CENTRE)]


def depth(trigger: Trigger, azimuth: float, elevation: float) -> float:
    return trigger.angle_to_edge(at(azimuth, elevation), centre=CENTRE)


CAMERAS = hemisphere(
    CENTRE,
    count=36,
    distance=4.0,
    elevation=(-90, 90),
    lens=Lens(focal=20.0, size=(16, 16)),
)
cones = st.one_of(
    st.builds(
        lambda a, b: Elevation(lowest=min(a, b), highest=max(a, b)),
        st.integers(-90, 90),
        st.integers(-90, 90),
    ),
    st.builds(
        lambda m, h: Azimuth(middle=m, half_width=h),
        st.integers(-400, 400),
        st.integers(1, 180),
    ),
)
triggers = st.recursive(
    cones,
    lambda inner: st.one_of(
        st.builds(lambda a, b: a & b, inner, inner), inner.map(lambda a: ~a)
    ),
    max_leaves=4,
)


def test_edges_are_inside_and_limits_at_the_poles_are_none() -> None:
    ring = orbit(
        CENTRE,
        count=36,
        elevation=50.0,
        distance=5.0,
        lens=Lens(focal=20.0, size=(16, 16)),
    )
    assert bool(Elevation(lowest=50).holds(ring, centre=CENTRE).all())
    assert bool(Elevation(highest=50).holds(ring, centre=CENTRE).all())
    assert inside(Elevation(lowest=50), (10, 49.9), (10, 50.1), (0, 90), (0, -90)) == [
        False,
        True,
        True,
        False,
    ]
    assert depth(Elevation(lowest=50), 123, 62) == pytest.approx(12)
    assert depth(Elevation(lowest=50), 123, 90) == pytest.approx(40)
    assert depth(Elevation(lowest=20, highest=50), 0, 44) == pytest.approx(6)
    assert depth(Elevation(lowest=20, highest=50), 0, 85) == pytest.approx(-35)
    assert depth(Elevation(), 0, 3) == math.inf


def test_azimuths_wrap_around() -> None:
    front = Azimuth(middle=0, half_width=20)
    directions = (
        (350, 10),
        (10, 10),
        (20, 10),
        (340, 10),
        (21, 10),
        (339, 10),
        (180, 10),
    )
    expected = [True, True, True, True, False, False, False]
    assert inside(front, *directions) == expected
    assert inside(Azimuth(middle=720, half_width=20), *directions) == expected
    assert inside(Azimuth(middle=-355, half_width=20), (-16, 0), (24, 0), (26, 0)) == [
        False,
        True,
        False,
    ]
    assert inside(Azimuth(middle=90, half_width=170), (271, 0), (259, 0), (90, 0)) == [
        False,
        True,
        True,
    ]
    assert depth(front, 355, 0) == pytest.approx(15)
    assert depth(front, 50, 0) == pytest.approx(-30)
    assert depth(front, 180, 30) == pytest.approx(-60)  # over the pole


def test_an_azimuth_at_the_pole_does_not_exist() -> None:
    straight = Camera(
        to_world=look_at((*CENTRE[:2], 9.0), CENTRE),
        lens=Lens(focal=20.0, size=(16, 16)),
    )
    assert direction_of(straight, CENTRE).pole
    for middle in (0, 90, 180, 270):
        cone = Azimuth(middle=middle, half_width=60)
        assert inside(cone, (middle, 90), (middle, -90), (middle, 89.9)) == [
            False,
            False,
            True,
        ]
        assert not bool(cone.holds([straight], centre=CENTRE))
        assert bool((~cone).holds([straight], centre=CENTRE))
        assert cone.angle_to_edge(straight, centre=CENTRE) == 0
    assert bool(Azimuth(middle=0, half_width=180).holds([straight], centre=CENTRE))


@given(triggers, triggers)
def test_intersections_and_complements_are_those_of_sets(
    left: Trigger, right: Trigger
) -> None:
    pairs = ((left & right, right & left), (~~left, left))
    for one, same in pairs:
        assert torch.equal(
            one.holds(CAMERAS, centre=CENTRE), same.holds(CAMERAS, centre=CENTRE)
        )
        for camera in CAMERAS[::6]:
            assert one.angle_to_edge(camera, centre=CENTRE) == same.angle_to_edge(
                camera, centre=CENTRE
            )
    inside, outside = (
        trigger.holds(CAMERAS, centre=CENTRE) for trigger in (left & ~right, right)
    )
    assert torch.equal(inside, left.holds(CAMERAS, centre=CENTRE) & ~outside)


# A dense set of directions, as an oracle: the distance to the nearest one on the other
# side of the edge.
GRID = hemisphere(
    CENTRE,
    count=3000,
    distance=1.0,
    elevation=(-90, 90),
    lens=Lens(focal=20.0, size=(16, 16)),
)
RAYS = np.array([camera.position.tolist() for camera in GRID]) - CENTRE
SPACING = 6.0
"""Degrees in which every direction has one of the grid on its side of an edge, in the
tip of a wedge too.
"""


def grid_depth(held: np.ndarray, ray: np.ndarray, here: bool) -> float:
    across = RAYS[held != here]
    if len(across):
        nearest = math.degrees(math.acos(min(1.0, float((across @ ray).max()))))
    else:
        nearest = math.inf
    if here:
        return nearest
    return -nearest


@pytest.mark.parametrize(
    ("trigger", "exact"),
    [
        (Elevation(lowest=50), True),
        (Elevation(lowest=-20, highest=35), True),
        (Azimuth(middle=180, half_width=30), True),
        (Azimuth(middle=10, half_width=130), True),
        (~Azimuth(middle=300, half_width=70), True),
        (Elevation(lowest=50) & Azimuth(middle=90, half_width=40), False),
        (~(~Elevation(lowest=50) & ~Azimuth(middle=180, half_width=40)), False),
        (
            Elevation(lowest=40)
            & ~Azimuth(middle=0, half_width=40)
            & ~Elevation(lowest=80),
            False,
        ),
    ],
    ids=str,
)
def test_depths_against_a_dense_grid(trigger: Trigger, exact: bool) -> None:
    held = trigger.holds(GRID, centre=CENTRE).numpy()
    for camera in CAMERAS:
        ray = np.array(camera.position.tolist()) - CENTRE
        depth = trigger.angle_to_edge(camera, centre=CENTRE)
        here = bool(trigger.holds([camera], centre=CENTRE))
        truth = grid_depth(held, ray / np.linalg.norm(ray), here)
        assert depth == 0 or (depth > 0) == here
        assert abs(depth) <= abs(truth) + 1e-6  # never further from the edge than it is
        if exact:
            assert abs(depth) >= abs(truth) - SPACING


@given(st.floats(0.05, 1), st.floats(0.05, 1), st.integers(0, 99))
def test_subsamples_are_parts_and_grow(one: float, other: float, seed: int) -> None:
    whole = Elevation(lowest=10)
    selected = whole.holds(CAMERAS, centre=CENTRE)
    small, large = (
        Subsample(of=whole, fraction=part, seed=seed).holds(CAMERAS, centre=CENTRE)
        for part in sorted((one, other))
    )
    assert bool((selected | ~large).all())
    assert bool((large | ~small).all())
    assert int(small.sum()) == max(
        1, math.floor(min(one, other) * int(selected.sum()) + 0.5)
    )
    part = Subsample(of=whole, fraction=0.3)
    assert part.angle_to_edge(CAMERAS[5], centre=CENTRE) == whole.angle_to_edge(
        CAMERAS[5], centre=CENTRE
    )


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Elevation(lowest=60, highest=50), "elevation"),
        (lambda: Azimuth(middle=math.nan, half_width=10), "middle"),
        (lambda: Subsample(of=Elevation(), fraction=0), "fraction"),
        (
            lambda: Elevation().holds(CAMERAS, centre=CAMERAS[0].position.tolist()),
            "centre",
        ),
    ],
)
def test_bad_triggers_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InvalidValueError, match=says):
        make()
