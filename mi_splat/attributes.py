"""Names of a splat's tensors, and how large their values may be; light, so that options can be parsed without torch."""

from __future__ import annotations

from typing import Literal, get_args

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]
"""The name of one tensor of a `GaussianScene`."""

ATTRIBUTES: tuple[Attribute, ...] = get_args(Attribute)
"""The five tensors of a scene, in the order in which renderers take them."""

LARGEST = 1e9
"""Largest coordinate, scale and SH coefficient of a scene, and largest coordinate and focal length of a camera.

Renderers compute in float32, which ends at 3e38: the fourth power of this number, as in the determinant of a footprint,
is just inside. Coordinates on Earth, whatever their origin, are below 3e7 metres. At 1e9, float32 steps are 64 units.
"""
