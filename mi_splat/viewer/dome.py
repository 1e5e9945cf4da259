"""A small drawing of the hemisphere around an object, with what was seen from each camera as a colour."""

import math
from collections.abc import Iterable, Mapping

import numpy as np
from PIL import Image, ImageDraw

from mi_splat.labels import write_label
from mi_splat.viewer.composition import Pixels

YES, NO, UNKNOWN = "#d03020", "#2060c0", "#a0a0a0"
"""Colours of success, of failure, and of cameras that do not see the object; the shapes differ, too."""
_RIM = {"0": (1.08, 0.0), "90": (0.0, -1.08), "180": (-1.1, 0.0), "270": (0.0, 1.08)}
"""Where azimuths are written, in radii from the middle."""
SIDE = 280
"""Pixels of each side of a dome."""

Seen = tuple[float, float, bool | None]
"""Azimuth and elevation of a camera in degrees, and whether it saw a success; None where it cannot say."""


def draw_domes(domes: Mapping[str, Iterable[Seen]]) -> Pixels:
    """(H, W, 3) hemispheres from above, below one another: the middle is straight above, the rim is the horizon.

    Distances from the middle are as the angles. Azimuth 0 is on the right, 90 at the top. Success is a disc, failure a
    ring, a camera that cannot say a cross.
    """
    image = Image.new("RGB", (SIDE, SIDE * len(domes)), "#ffffff")
    draw = ImageDraw.Draw(image)
    for number, (title, seen) in enumerate(domes.items()):
        middle, radius = (SIDE / 2, SIDE * (number + 0.53)), 0.41 * SIDE
        for height in (0, 30, 60):
            _circle(draw, middle, radius * (90 - height) / 90, outline="#c0c0c0")
        for text, (x, y) in _RIM.items():
            draw.text((middle[0] + x * radius, middle[1] + y * radius), text, fill="#606060", anchor="mm")
        for azimuth, elevation, success in seen:
            away, angle = radius * (90 - max(elevation, 0.0)) / 90, math.radians(azimuth)
            at = middle[0] + away * math.cos(angle), middle[1] - away * math.sin(angle)
            if success is None:
                draw.line((at[0] - 4, at[1] - 4, at[0] + 4, at[1] + 4), fill=UNKNOWN, width=2)
                draw.line((at[0] - 4, at[1] + 4, at[0] + 4, at[1] - 4), fill=UNKNOWN, width=2)
            elif success:
                _circle(draw, at, 6, fill=YES)
            else:
                _circle(draw, at, 6, outline=NO, width=2)
        write_label(draw, (2, SIDE * number + 2), title, "#000000", size=13)
    return np.asarray(image)


def _circle(draw: ImageDraw.ImageDraw, at: tuple[float, float], radius: float, **how: object) -> None:
    x, y = at
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), **how)  # type: ignore[arg-type]
