"""The transition: how sharply a hidden appearance sets in, from images along an arc of
cameras.

A splat of few SH bands shows a blend of both appearances there. The transition lies
between the angles at which a monotone fit crosses `LEVELS`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from attacks.cloak.config import StudyConfig, switching
from attacks.observe.rows import ATTACKED, DEPTH, TRANSITION

LEVELS = (0.1, 0.9)
"""Fractions of the way from the benign to the hidden appearance at which a transition
starts and ends.
"""

Tables = Mapping[str, pl.DataFrame]
"""Rows, fidelity and transition by their names (`attacks.observe.rows`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """Where a hidden appearance sets in, along an arc."""

    angles: tuple[float, ...]  # K rising angles in degrees, each once
    fractions: tuple[float, ...]
    fitted: tuple[float, ...]
    start: float | None
    end: float | None

    @property
    def width(self) -> float | None:
        """Degrees from start to end; None unless both were seen."""
        return None if self.start is None or self.end is None else self.end - self.start


def fit_transition(angles: Sequence[float], fractions: Sequence[float]) -> Transition:
    """The band in which a hidden appearance sets in, of one fraction for each of two or
    more different angles.
    """
    groups: dict[float, list[float]] = {angle: [] for angle in sorted(angles)}
    for angle, value in zip(angles, fractions, strict=True):
        groups[angle].append(value)
    means = [sum(values) / len(values) for values in groups.values()]
    from scipy.optimize import isotonic_regression  # half a second

    fitted = isotonic_regression(
        means, weights=[len(values) for values in groups.values()]
    ).x.tolist()
    start, end = (_crossing(list(groups), fitted, level) for level in LEVELS)
    return Transition(
        angles=tuple(groups),
        fractions=tuple(means),
        fitted=tuple(fitted),
        start=start,
        end=end,
    )


def _crossing(
    angles: Sequence[float], fitted: Sequence[float], level: float
) -> float | None:
    """Where a rising broken line first reaches a level; None if it is above it from the
    start, or never gets there.
    """
    if fitted[0] > level:
        return None
    for right, value in enumerate(fitted):
        if value >= level:
            if right == 0:
                return angles[0]
            left, below = angles[right - 1], fitted[right - 1]
            return left + (angles[right] - left) * (level - below) / (value - below)
    return None


def transition(
    study: StudyConfig, tables: Tables, splat: str = ATTACKED
) -> Transition | None:
    """The transition of all seeds and arcs together: over elevation from overhead, over
    depth in a sector's trigger.
    """
    if switching(study.attack) is None:
        return None
    blends = tables[TRANSITION].filter(splat=splat)
    degrees = [round(degree, 3) for degree in blends[_arc_column(study)]]
    if len(set(degrees)) < 2:
        return None
    return fit_transition(degrees, blends["fraction"].to_list())


def meridians(
    study: StudyConfig, tables: Tables
) -> dict[tuple[int, int], float | None]:
    """Degrees of the transition along each arc of each cloaked splat, by seed and arc;
    None where it is not seen.
    """
    on = ["seed", "meridian"]
    cloaked = tables[TRANSITION].filter(splat=ATTACKED)
    widths = {}
    for (seed, meridian), arc in cloaked.group_by(on, maintain_order=True):
        if len(arc) > 1:
            angles = arc[_arc_column(study)].to_list()
            fit = fit_transition(angles, arc["fraction"].to_list())
            widths[seed, meridian] = fit.width
    return widths


def _arc_column(study: StudyConfig) -> str:
    """The column that says where on its arc an image was taken, degrees: elevation, or
    depth in a sector.
    """
    attack = switching(study.attack)
    return (
        "elevation"
        if attack is None or study.overhead is not None
        else f"{DEPTH}{attack.name}"
    )
