"""Rules about the numbers of a splat, each with its threshold and the threshold's
reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.io.loaded import Arrays, Loaded
from mi_splat.maths.sh import band, degree_of, even_directions
from mi_splat.registry import Registry

Severity = Literal["error", "warning", "note"]
"""An error breaks a file or a renderer, a warning is hardly ever wanted, a note is no
fault.
"""

SHOWN = 100  # so many rows a finding lists; it counts all of them


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a rule found."""

    rule: str  # its name in docs/audit.md
    severity: Severity
    reason: str  # what is wrong, in a plain sentence
    # the first Gaussians that it is about, in the file's order; none if all
    rows: tuple[int, ...] = ()
    count: int = 0  # how many Gaussians it is about

    @classmethod
    def of(
        cls, rule: str, severity: Severity, reason: str, mask: NDArray[np.bool_]
    ) -> Finding:
        """A finding about some rows."""
        rows = np.flatnonzero(mask)
        return cls(
            rule=rule,
            severity=severity,
            reason=reason,
            rows=tuple(rows[:SHOWN].tolist()),
            count=len(rows),
        )


Mask = NDArray[np.bool_]

# opacity from which a Gaussian reaches a pixel: renderers leave out what is fainter
VISIBLE = 1 / 255
_DIRECTIONS = even_directions(32)
_CHUNK = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """The Gaussians of a file as it stores them, in its order."""

    arrays: Arrays  # N Gaussians, unchecked; quaternions are normalised
    valid: Mask  # (N,) those that a scene can hold
    shown: Mask  # (N,) those of them with an opacity from `VISIBLE`
    # (N,) those valid ones whose file holds an infinite logarithm or logit
    infinite: Mask

    @classmethod
    def of(cls, loaded: Loaded) -> Stored:
        """What a reader handed over."""
        valid = np.ones(len(loaded.arrays["means"]), np.bool_)
        valid[loaded.invalid] = False
        with np.errstate(invalid="ignore"):
            shown = valid & (loaded.arrays["opacities"] >= VISIBLE)
        infinite = np.zeros(len(valid), np.bool_)
        infinite[list(loaded.infinite)] = True
        return cls(loaded.arrays, valid, shown, infinite)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One rule."""

    name: str  # as findings state it
    severity: Severity  # of its findings
    threshold: float  # from where it finds something
    reason: str  # why that matters, in a sentence
    # from the Gaussians and the threshold to the (N,) rows that it is about
    find: Callable[[Stored, float], Mask]

    def __call__(self, stored: Stored) -> Finding | None:
        """The finding; None if there is none."""
        with np.errstate(all="ignore"):
            rows = np.asarray(self.find(stored, self.threshold))
        if rows.shape != stored.valid.shape or rows.dtype != np.bool_:
            expected = f"bool {stored.valid.shape}"
            got = f"{rows.dtype} {rows.shape}"
            raise InvalidValueError.of(
                f"rule {self.name}", expected, got, "give one truth for each Gaussian"
            )
        if rows.any():
            return Finding.of(self.name, self.severity, self.reason, rows)
        return None


def _any(values: NDArray[np.bool_]) -> Mask:
    """(N,) whether anything in a row holds."""
    return np.asarray(values.any(axis=tuple(range(1, values.ndim))))


def _out_of_range(stored: Stored, largest: float) -> Mask:
    arrays = stored.arrays
    if stored.valid.all():
        return ~stored.valid
    rows = _any((arrays["scales"] <= 0) | (arrays["scales"] > largest))
    rows |= _any((arrays["opacities"] < 0) | (arrays["opacities"] > 1))
    for name in ("means", "sh"):
        size = np.abs(arrays[name])
        rows |= _any((size > largest) & np.isfinite(size))
    return rows


def _quaternion(stored: Stored, _: float) -> Mask:
    return _any(~np.isfinite(stored.arrays["rotations"]))


def _not_finite(stored: Stored, largest: float) -> Mask:
    arrays = stored.arrays
    if stored.valid.all():
        return ~stored.valid
    rows = _any(np.isnan(arrays["scales"]))
    for name in ("means", "opacities", "sh"):
        rows |= _any(~np.isfinite(arrays[name]))
    # What a reader refuses for another reason is not finite in the file only.
    return rows | (
        ~stored.valid & ~_out_of_range(stored, largest) & ~_quaternion(stored, 0)
    )


def _infinite(stored: Stored, _: float) -> Mask:
    return stored.infinite


def _giant(stored: Stored, factor: float) -> Mask:
    radius = scene_radius(stored)
    return stored.shown & _any(stored.arrays["scales"] > (factor * radius or np.inf))


def scene_radius(stored: Stored) -> float:
    """Half of the diagonal of the box around the middle 98 % of the means; 0 without
    any.
    """
    means = stored.arrays["means"][stored.valid]
    if not len(means):
        return 0.0
    low, high = np.quantile(means, (0.01, 0.99), axis=0)
    return float(np.linalg.norm(high - low) / 2)


def _needle(stored: Stored, ratio: float) -> Mask:
    a, b, c = stored.arrays["scales"].T
    low = np.minimum(a, b)
    high = np.maximum(a, b)
    return np.asarray(
        stored.shown
        & (np.maximum(high, c) > ratio * np.maximum(low, np.minimum(high, c)))
    )


def _if_many(rows: Mask, share: float) -> Mask:
    """The rows if they are at least so large a share of all, else none."""
    if rows.sum() >= share * len(rows):
        return rows
    return np.zeros_like(rows)


def repeats(arrays: Arrays) -> Mask:
    """(N,) which Gaussians equal an earlier one to the bit; by a hash of 64 bits."""
    rows = np.arange(len(arrays["means"]))
    # few share a position, and only these are looked at whole
    for names in (("means",), tuple(arrays)):
        key = np.zeros(len(rows), np.uint64)
        for name in names:
            for column in arrays[name].view(np.uint32).reshape(len(arrays[name]), -1).T:
                key = (key ^ column[rows]) * np.uint64(0x9E3779B97F4A7C15)
                key ^= key >> np.uint64(32)
        ordered = np.sort(key)
        shared = np.isin(key, ordered[1:][ordered[1:] == ordered[:-1]])
        rows = rows[shared]
        key = key[shared]
    repeated = np.zeros(len(arrays["means"]), np.bool_)
    repeated[rows] = True
    repeated[rows[np.unique(key, return_index=True)[1]]] = False
    return repeated


def _colour(stored: Stored, by: float) -> Mask:
    return _if_many(stored.shown & _overshoots(stored.arrays["sh"], by), COLOUR_SHARE)


def _overshoots(sh: NDArray[np.float32], by: float) -> Mask:
    """(N,) whether a channel of a Gaussian's colour leaves [0, 1] (sRGB) by more than
    so much in some direction.
    """
    x, y, z = _DIRECTIONS.T
    values = [
        value
        for degree in range(degree_of(sh.shape[1]) + 1)
        for value in band((x, y, z), degree)
    ]
    basis = np.stack(values, axis=1).astype(np.float32)
    largest = np.kron(np.abs(basis).max(0)[:, None], np.eye(3, dtype=np.float32))
    far = np.zeros(len(sh), np.bool_)
    for first in range(0, len(sh), _CHUNK):
        part = sh[first : first + _CHUNK]
        most = np.abs(part).reshape(len(part), -1) @ largest  # few can be as far
        rows = np.flatnonzero((most > 0.999 * (by + 0.5)).any(1))
        from_grey = np.tensordot(basis, part[rows], (1, 1))
        far[first + rows] = (np.abs(from_grey, out=from_grey).max(0) - 0.5 > by).any(1)
    return far


def _empty_degree(stored: Stored, _: float) -> Mask:
    sh = stored.arrays["sh"]
    top = sh[:, degree_of(sh.shape[1]) ** 2 :]
    return stored.valid & (sh.shape[1] > 1 and not top[:SHOWN].any() and not top.any())


def _partial_degree(stored: Stored, share: float) -> Mask:
    sh = stored.arrays["sh"]
    for degree in range(1, degree_of(sh.shape[1]) + 1):
        # at once what is so in nearly all files
        if np.count_nonzero(sh[:, degree**2, 0]) > share * len(sh):
            continue
        rows = _any(sh[:, degree**2 : (degree + 1) ** 2] != 0)
        if 0 < rows.sum() <= share * len(rows):
            return rows
    return np.zeros_like(stored.valid)


COLOUR_SHARE = 0.01  # of all Gaussians, from which colours out of range are a finding

RULES = (
    Rule(
        name="not-finite",
        severity="error",
        threshold=LARGEST,
        reason=(
            "A number is not finite (NaN or infinite): renderers show black squares, or"
            " nothing."
        ),
        find=_not_finite,
    ),
    Rule(
        name="out-of-range",
        severity="error",
        threshold=LARGEST,
        reason=(
            "A scale is 0 or negative, an opacity is outside 0 to 1, or a number is"
            f" above {LARGEST:g}."
        ),
        find=_out_of_range,
    ),
    Rule(
        name="quaternion",
        severity="error",
        threshold=0,
        reason=(
            "The quaternion is zero or not finite, so the Gaussian has no orientation."
        ),
        find=_quaternion,
    ),
    Rule(
        name="infinite",
        severity="note",
        threshold=0,
        reason=(
            "An opacity logit is infinite, or a log-scale is minus infinity, which not"
            " every program reads."
        ),
        find=_infinite,
    ),
    Rule(
        name="giant",
        severity="warning",
        threshold=2.0,
        reason=(
            "A standard deviation is larger than the diameter of the whole splat: it"
            " covers every image."
        ),
        find=_giant,
    ),
    Rule(
        name="needle",
        severity="note",
        threshold=1000.0,
        reason=(
            "It is more than 1,000 times as long as wide: renderers that compute in"
            " float32 draw it wrong."
        ),
        find=_needle,
    ),
    Rule(
        name="invisible",
        severity="note",
        threshold=0.05,
        reason=(
            "The opacity is under 1/255: no renderer shows it, but it is in the file."
        ),
        find=lambda stored, share: _if_many(stored.valid & ~stored.shown, share),
    ),
    Rule(
        name="duplicate",
        severity="warning",
        threshold=0.01,
        reason="It repeats an earlier Gaussian in every number.",
        find=lambda stored, share: _if_many(
            repeats(stored.arrays) & stored.valid, share
        ),
    ),
    Rule(
        name="colour",
        severity="warning",
        threshold=1.0,
        reason=(
            "From some directions its colour is more than 1 below black or above white."
            " Renderers cut that off, and looks in layers need this: each is black"
            " where another shows."
        ),
        find=_colour,
    ),
    Rule(
        name="empty-degree",
        severity="note",
        threshold=0,
        reason=(
            "The highest band of its SH is 0, as in all of the file: the file is larger"
            " than it need be."
        ),
        find=_empty_degree,
    ),
    Rule(
        name="partial-degree",
        severity="warning",
        threshold=0.1,
        reason=(
            "Only it has SH of a band that is 0 in all others: it was made or changed"
            " in another way."
        ),
        find=_partial_degree,
    ),
)
"""The table; docs/audit.md gives the reason of each threshold."""

ADDED: Registry[Rule] = Registry(
    "mi_splat.audit_rules", "a Rule", lambda value: isinstance(value, Rule), what="rule"
)
"""Rules of other packages, by name; they follow those of the table."""


def findings_of(stored: Stored) -> Iterator[Finding]:
    """What all rules find, those of other packages last."""
    for rule in RULES:
        finding = rule(stored)
        if finding is not None:
            yield finding
    known = {rule.name for rule in RULES}
    for name in ADDED:
        try:
            if name in known:
                raise InvalidValueError.of(
                    f"rule {name}",
                    "a name that is free",
                    repr(name),
                    "choose another name",
                )
            finding = ADDED[name](stored)
        except Exception as error:  # noqa: BLE001
            # whatever a plug-in raises, the other rules have to be heard
            reason = f"The rule {name} of {ADDED.package(name)} did not run: {error}"
            finding = Finding(rule=name, severity="warning", reason=reason)
        if finding is not None:
            yield finding
