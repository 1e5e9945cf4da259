"""The limits of a perturbation as plain values; light, so that options can be parsed without torch."""

from typing import Annotated, Literal, get_args

from mi_splat.fields import Metavar, at_least

NormName = Literal["linf", "l2", "l2_per_gaussian"]
"""`linf`: largest change of a coefficient; `l2`: one ball over the object; `l2_per_gaussian`: a ball for each row."""

NORM_NAMES: tuple[NormName, ...] = get_args(NormName)

Schedule = Literal["constant", "linear", "cosine"]
"""How the steps of a search become shorter: not at all, along a line to 0, or along half a cosine to 0."""

SCHEDULES: tuple[Schedule, ...] = get_args(Schedule)

Radius = Annotated[float, at_least(0, "units of the splat file", "5 is the paper's"), Metavar("RADIUS")]
"""Largest size of a perturbation; 0 changes nothing."""
