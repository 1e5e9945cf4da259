"""The limits of a perturbation as plain values; light, so that options can be parsed without torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Literal, get_args

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError, message

NormName = Literal["linf", "l2", "l2_per_gaussian"]
"""`linf`: largest change of a coefficient; `l2`: one ball over the object; `l2_per_gaussian`: a ball for each row."""

NORM_NAMES: tuple[NormName, ...] = get_args(NormName)

Schedule = Literal["constant", "linear", "cosine"]
"""How the steps of a search become shorter: not at all, along a line to 0, or along half a cosine to 0."""

SearchName = Literal["paper", "strong"]
"""How the six pairs are searched (`attacks.dagger.pairs.SEARCHES`)."""

OptimiserName = Literal["momentum", "adam"]
"""What makes a step of the gradients (`attacks.optimisers`)."""

OPTIMISERS: tuple[OptimiserName, ...] = get_args(OptimiserName)

SCHEDULES: tuple[Schedule, ...] = get_args(Schedule)


def check_limits(radius: Mapping[str, float], norm: str) -> None:
    """Refuse what no budget can be made of.

    Args:
        radius: Largest size of the perturbation by attribute, in the units of the splat file.
        norm: Name of the norm.

    Raises:
        InvalidValueError: An attribute or the norm is unknown, nothing may move, or a radius is negative or not finite.
    """
    if norm not in NORM_NAMES:
        raise InvalidValueError(message("norm", f"one of {', '.join(NORM_NAMES)}", norm, "choose one of these"))
    if not radius:
        raise InvalidValueError(message("radius", "at least one attribute", "none", "say what may move, and how far"))
    for name, value in radius.items():
        if name not in ATTRIBUTES:
            raise InvalidValueError(message("attribute", f"one of {', '.join(ATTRIBUTES)}", name, "choose among these"))
        if not (isinstance(value, Real) and math.isfinite(value) and value >= 0):
            raise InvalidValueError(
                message(f"radius of {name}", "a finite number >= 0", value, "use a large one for 'no limit'")
            )
