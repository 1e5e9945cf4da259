"""Where the sun stands at an hour of a day."""

import math

from mi_splat.errors import InvalidValueError


def sun_direction(hour: float, *, latitude: float, declination: float = 0.0) -> tuple[float, float, float]:
    """Unit vector to the sun: east, north, up.

    The hour angle grows by 15 degrees an hour from 0 at noon (Meeus, Astronomical Algorithms, chapter 13).
    """
    angle = math.radians(15 * (hour - 12))
    phi, tilt = math.radians(latitude), math.radians(declination)
    east = -math.cos(tilt) * math.sin(angle)
    north = math.cos(phi) * math.sin(tilt) - math.sin(phi) * math.cos(tilt) * math.cos(angle)
    up = math.sin(phi) * math.sin(tilt) + math.cos(phi) * math.cos(tilt) * math.cos(angle)
    if up <= 1e-6:
        raise InvalidValueError.of("hour", "an hour when the sun is up", f"{hour:g}", "leave it out")
    return east, north, up
