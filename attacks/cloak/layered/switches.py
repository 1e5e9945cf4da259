"""Functions on the sphere that switch: near 1 for some directions and below 0 for others, as spherical harmonics.

A Gaussian's colour is max(0, 0.5 + SH), so that a function may be far below zero at no cost. Where it has to be near 1,
and where it has to be negative, is all that counts; between the two it may do what it likes. The steepest such
polynomial about an axis is Chebyshev's (`chebyshev_width`); for any set of directions it is found by least squares in
which a negative value where a negative one is wanted costs nothing (`fit_switches`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from attacks.cloak.layered.config import LayerConfig
from mi_splat.errors import InvalidValueError, message
from mi_splat.sh import sh_basis

_ROUNDS, _HALVINGS = 40, 30
"""Newton steps, each a least-squares problem over what is on the wrong side; how often one is halved."""

_PRECISION = 1e-8
"""Of the sum that is minimised."""

_RIDGE = 1e-7
"""Of the coefficients' squares, so that the problem has one solution."""

_UNSEEN = 1e-9
"""Least that a direction counts, where nothing is seen of a Gaussian from anywhere."""


def fit_switches(
    directions: Tensor,
    shown: Tensor,
    hidden: Tensor,
    *,
    wanted: Tensor | None = None,
    seen: Tensor | None = None,
    config: LayerConfig | None = None,
) -> Tensor:
    """Spherical harmonics that have wanted values in some directions and are below 0 in others, as nearly as they can.

    Minimises the mean over all directions of (p - wanted)^2 where it is shown, plus `weight` times max(0, p - black)^2
    where it is hidden, plus min(0, p - lowest)^2 wherever it is not shown; each direction counts as much as the
    Gaussian is seen from there. The sum is convex and piecewise quadratic; Newton's method on the active pieces, with
    steps halved until the sum falls, goes towards its minimum for at most `_ROUNDS` steps. Narrow regions may need
    more.

    Args:
        directions: (N, D, 3) unit vectors, for each of N functions.
        shown: (D,) bool, where it shall have its values.
        hidden: (D,) bool, where it shall not be above `black`; below it, there is room for a training of the colours.
        wanted: (N, D) values where it is shown; None is 1.
        seen: (N, D) how much is seen of it from each direction, >= 0; None is the same from all.
        config: Degree, `weight`, `black`, and `lowest`: large coefficients do not survive coarse file formats.

    Returns:
        (N, K) coefficients, K = (degree + 1)^2.

    Raises:
        InvalidValueError: No direction is shown or none is hidden, or a direction is both.
    """
    config = config or LayerConfig()
    if not bool(shown.any()) or not bool(hidden.any()) or bool((shown & hidden).any()):
        got = f"{int(shown.sum())} shown, {int(hidden.sum())} hidden, {int((shown & hidden).sum())} both"
        raise InvalidValueError(
            message("directions", "some to show in and others to hide in", got, "widen the trigger")
        )
    basis = sh_basis(directions.reshape(-1, 3).double(), config.degree).reshape(*directions.shape[:2], -1)
    much = basis.new_ones(basis.shape[:2]) if seen is None else seen.double().clamp(min=_UNSEEN)
    much = much / much.sum(1, keepdim=True)
    own, dark, other = much * shown, config.weight * much * hidden, much * ~shown
    aims = torch.ones_like(much) if wanted is None else wanted.double()
    black, lowest = config.black, config.lowest

    def cost(coefficients: Tensor, values: Tensor, which: Tensor) -> Tensor:
        errors = own[which] * (values - aims[which]) ** 2
        errors += dark[which] * (values - black).clamp(min=0) ** 2 + other[which] * (values - lowest).clamp(max=0) ** 2
        return errors.sum(1) + _RIDGE * coefficients.square().sum(1)

    def pieces(values: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        above, below = dark[which] * (values > black), other[which] * (values < lowest)
        return own[which] + above + below, own[which] * aims[which] + above * black + below * lowest

    return _minimised(basis, cost, pieces)


def _minimised(
    basis: Tensor,
    cost: Callable[[Tensor, Tensor, Tensor], Tensor],
    pieces: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
) -> Tensor:
    """(N, K) coefficients that make convex, piecewise quadratic sums small.

    Args:
        basis: (N, D, K) from coefficients to values.
        cost: Of (M, K) coefficients, their (M, D) values and the (M,) functions that they are of, the (M,) sums.
        pieces: Of (M, D) values of (M,) functions, the (M, D) weights of the pieces that they lie on, and these times
            what is wanted.
    """
    count = basis.shape[2]
    found, ridge = torch.zeros(len(basis), count, dtype=torch.float64), _RIDGE * torch.eye(count, dtype=torch.float64)
    active = torch.arange(len(basis))
    for _ in range(_ROUNDS):
        here, before = basis[active], found[active]
        values = (here @ before[..., None])[..., 0]
        weights, wanted = pieces(values, active)
        normal = (here * weights[..., None]).mT @ here + ridge
        step = torch.linalg.solve(normal, (here.mT @ wanted[..., None])[..., 0]) - before
        change, least = (here @ step[..., None])[..., 0], cost(before, values, active)
        size, now = torch.ones(len(active), 1, dtype=torch.float64), torch.empty_like(least)
        tried = torch.arange(len(active))
        for _ in range(_HALVINGS):
            part = size[tried]
            now[tried] = cost(before[tried] + part * step[tried], values[tried] + part * change[tried], active[tried])
            tried = tried[now[tried] > least[tried] + _PRECISION]
            if not len(tried):
                break
            size[tried] /= 2
        better = now < least - _PRECISION
        found[active[better]] = (before + size * step)[better]
        active = active[better]
        if not len(active):
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
