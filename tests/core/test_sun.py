"""Where the sun stands: closed forms at the equinoxes and at midsummer."""

from __future__ import annotations

import math

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.sun import sun_direction


def test_at_noon_it_stands_in_the_south_at_90_degrees_less_the_latitude() -> None:
    assert sun_direction(12, latitude=30) == pytest.approx((0, -0.5, math.sqrt(0.75)))
    assert sun_direction(12, latitude=0) == pytest.approx((0, 0, 1))
    elevation = math.degrees(math.asin(sun_direction(12, latitude=45, declination=23.4)[2]))
    assert elevation == pytest.approx(45 + 23.4)


def test_it_rises_in_the_east_and_sets_in_the_west() -> None:
    morning, evening = sun_direction(6.01, latitude=45), sun_direction(17.99, latitude=45)
    assert morning == pytest.approx((1, 0, 0), abs=0.01)
    assert evening == pytest.approx((-1, 0, 0), abs=0.01)
    early = sun_direction(9, latitude=45)
    assert early == pytest.approx((math.sqrt(0.5), -0.5, 0.5))
    assert math.hypot(*early) == pytest.approx(1)


@pytest.mark.parametrize("hour", [6, 18, 0, 22.5])
def test_at_night_it_is_refused(hour: float) -> None:
    with pytest.raises(InvalidValueError, match="when the sun is up"):
        sun_direction(hour, latitude=45)


def test_the_midnight_sun() -> None:
    assert sun_direction(0, latitude=80, declination=23.4)[2] == pytest.approx(math.sin(math.radians(13.4)))
