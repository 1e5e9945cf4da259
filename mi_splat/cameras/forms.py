"""The short texts that name sets of cameras: `hemisphere:210`, `orbit:36@20`,
`cap:40@60`, `grid:12x3`.
"""

import re

from mi_splat.errors import InvalidValueError

FORMS = (
    "hemisphere:N, orbit:N@ELEVATION, cap:N@MIN_ELEVATION, grid:AxE or a transforms"
    " .json file"
)
MOST = 100_000
"""Cameras of the largest set."""
_COUNT = r"(?P<count>\d{1,99})"
_ANGLE = r"(?P<angle>[-+]?\d{1,3}(?:\.\d*)?)"
_PATTERNS = {
    "hemisphere": re.compile(_COUNT),
    "orbit": re.compile(f"{_COUNT}@{_ANGLE}"),
    "cap": re.compile(f"{_COUNT}@{_ANGLE}"),
    "grid": re.compile(r"(?P<count>\d{1,99})x(?P<rows>\d{1,99})"),
}


def parse_form(spec: str) -> tuple[str, dict[str, str]]:
    """The kind of a set and its numbers as text, in range."""
    kind, _, rest = spec.partition(":")
    match = _PATTERNS[kind].fullmatch(rest) if kind in _PATTERNS else None
    if match is None:
        raise InvalidValueError.of(
            "cameras", FORMS, repr(spec), "write one of these forms"
        )
    numbers = match.groupdict()
    total = int(numbers["count"]) * int(numbers.get("rows", 1))
    if not 1 <= total <= MOST:
        raise InvalidValueError.of(
            f"cameras {spec}", f"1 to {MOST} cameras", total, "change the number"
        )
    angle = float(numbers.get("angle", 0.0))
    highest = 90.0 if kind != "cap" else 89.9
    if not -90 <= angle <= highest:
        raise InvalidValueError.of(
            f"cameras {spec}",
            f"an elevation from -90 to {highest:g} degrees",
            angle,
            "change it",
        )
    return kind, numbers
