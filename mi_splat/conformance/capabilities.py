"""What simulators may lack, such as cameras with a principal point off the centre, and
which scenes need it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from mi_splat.conformance.setups import Setup
from mi_splat.errors import InvalidValueError, nearest

_NEAR = 0.2
"""Depth of the near plane of 3DGS, world units."""


class Capability(NamedTuple):
    """Something that a renderer is able to do."""

    text: str
    needed: Callable[[Setup], bool]


def _off_centre(setup: Setup) -> bool:
    camera = setup.camera
    return (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2)


def _non_square_pixels(setup: Setup) -> bool:
    return setup.camera.fx != setup.camera.fy


def _non_square_images(setup: Setup) -> bool:
    return setup.camera.width != setup.camera.height


def _rolled(setup: Setup) -> bool:
    """Whether the image's x is not level, where the world's z is up."""
    return bool(abs(setup.camera.to_world[2, 0]) > 1e-6)


def _vertical(setup: Setup) -> bool:
    return bool(abs(setup.camera.to_world[2, 2]) > 1 - 1e-6)


def _wide(setup: Setup) -> bool:
    camera = setup.camera
    return max(camera.width / camera.fx, camera.height / camera.fy) > 2.0


def _near(setup: Setup) -> bool:
    pose = setup.camera.to_world
    depths = (setup.splat.means - pose[:3, 3]) @ pose[:3, 2]
    return bool(np.any((depths > 0) & (depths < _NEAR)))


def _background(setup: Setup) -> bool:
    return any(setup.background)


CAPABILITIES = {
    "off-centre": Capability("principal points off the image's centre", _off_centre),
    "non-square-pixels": Capability(
        "different horizontal and vertical focal lengths", _non_square_pixels
    ),
    "non-square-images": Capability(
        "images whose sides differ in length", _non_square_images
    ),
    "roll": Capability("cameras that are rolled, with z up", _rolled),
    "vertical": Capability("cameras that look straight up or down", _vertical),
    "wide-angle": Capability(
        f"fields of view above {2 * math.degrees(math.atan(1)):.0f} degrees", _wide
    ),
    "near": Capability(f"Gaussians nearer to the camera than {_NEAR:g}", _near),
    "background": Capability("backgrounds that are not black", _background),
}
"""What a renderer may be declared not to be able to do, by name."""


def not_applicable(
    setups: Mapping[str, Setup], cannot: Iterable[str]
) -> dict[str, list[str]]:
    """The scenes that need what a renderer cannot do, each with what it needs.

    Args:
        setups: Of every scene.
        cannot: Keys of `CAPABILITIES`.
    """
    lacking = list(cannot)
    for key in lacking:
        if key not in CAPABILITIES:
            do = nearest(key, CAPABILITIES, "pass one of these")
            raise InvalidValueError.of("cannot", ", ".join(CAPABILITIES), key, do)
    found = dict[str, list[str]]()
    for name, setup in setups.items():
        needed = [key for key in lacking if CAPABILITIES[key].needed(setup)]
        if needed:
            found[name] = needed
    return found
