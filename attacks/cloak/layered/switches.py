"""Functions on the sphere that switch: near 1 for some directions and below 0 for others, as spherical harmonics.

A Gaussian's colour is max(0, 0.5 + SH), so that a function may be far below zero at no cost. Where it has to be near 1,
and where it has to be negative, is all that counts; between the two it may do what it likes. The steepest such
polynomial about an axis is Chebyshev's (`chebyshev_width`); for any set of directions it is found by least squares in
which a negative value where a negative one is wanted costs nothing (`fit_switches`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message
from mi_splat.sh import coefficient_count, sh_basis

_ROUNDS = 25
"""Newton steps; each solves a least-squares problem over what is on the wrong side."""

_RIDGE = 1e-7
"""Of the coefficients' squares, so that the problem has one solution."""


def fit_switches(
    directions: Tensor, shown: Tensor, hidden: Tensor, *, degree: int = 3, weight: float = 1.0, lowest: float = -100.0
) -> Tensor:
    """Spherical harmonics that are 1 in some directions and at most 0 in others, as nearly as their degree allows.

    Minimises mean (p - 1)^2 over the directions where it is shown, plus `weight` times the mean of max(0, p)^2 over
    those where it is hidden, plus the mean of min(0, p - lowest)^2 over all others. The sum is convex and piecewise
    quadratic, and Newton's method on the active pieces finds its minimum.

    Args:
        directions: (N, D, 3) unit vectors, for each of N functions.
        shown: (D,) bool, where it shall be 1.
        hidden: (D,) bool, where it shall not be above 0.
        degree: Of the spherical harmonics.
        weight: What a value above 0 costs where it is hidden, against one that is not 1 where it is shown.
        lowest: Value that it shall not go below; large negative coefficients do not survive coarse file formats.

    Returns:
        (N, K) coefficients, K = (degree + 1)^2.

    Raises:
        InvalidValueError: No direction is shown or none is hidden, a direction is both, or `lowest` is not negative.
    """
    if not bool(shown.any()) or not bool(hidden.any()) or bool((shown & hidden).any()):
        got = f"{int(shown.sum())} shown, {int(hidden.sum())} hidden, {int((shown & hidden).sum())} both"
        raise InvalidValueError(
            message("directions", "some to show in and others to hide in", got, "widen the trigger")
        )
    if not lowest < 0:
        raise InvalidValueError(message("lowest", "a number < 0", lowest, "-100 leaves much room"))
    basis = sh_basis(directions.reshape(-1, 3).double(), degree).reshape(*directions.shape[:2], -1)
    own = shown.double() / shown.sum()
    black = weight * hidden.double() / hidden.sum()
    other = (~shown).double() / max(int((~shown).sum()), 1)
    found = torch.zeros(len(basis), coefficient_count(degree), dtype=torch.float64)
    ridge = _RIDGE * torch.eye(found.shape[1], dtype=torch.float64)
    for _ in range(_ROUNDS):
        values = torch.einsum("ndk,nk->nd", basis, found)
        above = black * (values > 0)
        below = other * (values < lowest)
        weights = own + above + below
        wanted = own + below * lowest
        normal = torch.einsum("nd,ndk,ndl->nkl", weights, basis, basis) + ridge
        right = torch.einsum("nd,ndk->nk", wanted, basis)
        after = torch.linalg.solve(normal, right)
        change = float((after - found).abs().max())
        found = after
        if change < 1e-9:
            break
    return found


def chebyshev_width(edge: float, *, degree: int, ripple: float, inside: bool) -> float:
    """Degrees of elevation in which the steepest polynomial about the vertical falls from 1 - ripple to 0.

    The polynomial is 1 + c T(x) in s = sin(elevation), T that of Chebyshev of the degree and x a scale that maps the
    side on which it is shown to [-1, 1]: among all polynomials that stay within 1 +- ripple there, it falls fastest
    beyond. It is 0 where |T(x)| = 1 / ripple, that is at
    |x| = cosh(arcosh(1 / ripple) / degree).

    Args:
        edge: Elevation of the edge of the side where it is shown, degrees, in (0, 90).
        degree: Of the polynomial.
        ripple: In (0, 1).
        inside: Whether the side is that above the edge (a trigger overhead), or that from the horizon up to it.

    Raises:
        InvalidValueError: A value is out of its range.
    """
    if not (0 < edge < 90 and 0 < ripple < 1 and degree >= 1):
        got = f"edge {edge:g}, ripple {ripple:g}, degree {degree}"
        raise InvalidValueError(
            message("switch", "an edge in (0, 90), ripple in (0, 1), degree >= 1", got, "change it")
        )
    top = math.sin(math.radians(edge))
    low, high = (top, 1.0) if inside else (0.0, top)
    reach = math.cosh(math.acosh(1 / ripple) / degree)
    half = (high - low) / 2
    zero = (low + high) / 2 + (-reach if inside else reach) * half
    if not -1 <= zero <= 1:
        return math.inf
    return abs(math.degrees(math.asin(zero)) - edge)
