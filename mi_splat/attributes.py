"""Names of a splat's tensors; light, so that options can be parsed without torch."""

from __future__ import annotations

from typing import Literal, get_args

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]
"""The name of one tensor of a `GaussianScene`."""

ATTRIBUTES: tuple[Attribute, ...] = get_args(Attribute)
"""The five tensors of a scene, in the order in which renderers take them."""
