"""Spherical harmonics that switch layers: which part of which appearance each layer shows from each direction.

The cameras of a trigger see one look, all others the benign one. A look has one layer, or two: one for what is near its
edge and one for what is further inside. A polynomial that has to be 1 on all of its side is less steep at the edge than
one that may fall again further inside, where the other takes over.

A Gaussian's colour is max(0, 0.5 + SH), so that a function may be far below zero at no cost. Where it has to be near 1,
and where it has to be negative, is all that counts; between the two it may do what it likes. The steepest such
polynomial about an axis is Chebyshev's; for any set of directions it is found by least squares in which a negative
value where a negative one is wanted costs nothing (`fit_switches`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.cloak.layer_config import LayerConfig
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import Camera
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError
from mi_splat.sh import sh_basis


def depths(
    triggers: Sequence[Trigger], cameras: Sequence[Camera], *, centre: Point, config: LayerConfig | None = None
) -> Tensor:
    """(1 + L, D) how far inside the region of each look D cameras are, in gaps: whole from 1, black below -1.

    The first look is what no trigger holds.
    """
    config = config or LayerConfig()
    return _in_gaps(_angles(triggers, cameras, centre, config), config)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Share:
    """What one layer shows of a look, for D cameras all around."""

    look: int
    amount: Tensor  # (D,) in [0, 1], the part of the look that it shows; those of all layers of a look make 1
    shown: Tensor  # (D,) bool, where it shows that part
    hidden: Tensor  # (D,) bool, where it is black; where it is neither, it may be what it likes


def shares(
    triggers: Sequence[Trigger], cameras: Sequence[Camera], *, centre: Point, config: LayerConfig | None = None
) -> list[Share]:
    """What each layer shows: one for each look, and one more for what is near the edge of a look that has a band."""
    config = config or LayerConfig()
    angles = _angles(triggers, cameras, centre, config)
    sides, angles = _in_gaps(angles, config), _with_benign(angles)
    parts = []
    for look, (depth, angle, band) in enumerate(zip(sides, angles, config.bands(len(sides)), strict=True)):
        far = (angle / band).clamp(0, 1) if band else torch.ones_like(angle)
        for amount in (far, 1 - far) if band else (far,):
            shown = (depth >= 1) & (amount > 0)
            hidden = (depth <= -1) | ((depth >= 1) & (amount == 0))
            parts.append(Share(look=look, amount=amount, shown=shown, hidden=hidden))
    return parts


def _angles(triggers: Sequence[Trigger], cameras: Sequence[Camera], centre: Point, config: LayerConfig) -> Tensor:
    """(L, D) degrees by which cameras are inside of where each trigger's look begins."""
    rows = [[trigger.angle_to_edge(camera, centre=centre) for camera in cameras] for trigger in triggers]
    return config.shift + torch.tensor(rows)


def _in_gaps(angles: Tensor, config: LayerConfig) -> Tensor:
    """(1 + L, D) of (L, D) degrees, how far inside cameras are in gaps, the benign look first."""
    inside = angles / torch.tensor(config.gaps(len(angles))).clamp(min=1e-6)[:, None]
    if config.apart:
        whole = inside >= 1
        elsewhere = (whole.sum(0) - whole.long() > 0) & ~whole
        inside = torch.where(elsewhere, inside.clamp(max=-1), inside)
    return _with_benign(inside)


def _with_benign(inside: Tensor) -> Tensor:
    """(1 + L, D) of (L, D): the benign look is as far inside as all others are outside."""
    return torch.cat([-inside.amax(0, keepdim=True), inside])


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
    """
    config = config or LayerConfig()
    if not bool(shown.any()) or not bool(hidden.any()) or bool((shown & hidden).any()):
        got = f"{int(shown.sum())} shown, {int(hidden.sum())} hidden, {int((shown & hidden).sum())} both"
        raise InvalidValueError.of("directions", "some to show in and others to hide in", got, "widen the trigger")
    basis = sh_basis(directions.reshape(-1, 3).double(), config.degree).reshape(*directions.shape[:2], -1)
    weights = basis.new_ones(basis.shape[:2]) if seen is None else seen.double().clamp(min=_UNSEEN)
    weights = weights / weights.sum(1, keepdim=True)
    own, dark, other = weights * shown, config.weight * weights * hidden, weights * ~shown
    aims = torch.ones_like(weights) if wanted is None else wanted.double()
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
    """(N, K) coefficients that make convex, piecewise quadratic sums small; the (N, D, K) basis gives values.

    `cost` tells the (M,) sums of (M, K) coefficients with (M, D) values of (M,) functions. `pieces` tells the (M, D)
    weights of the pieces that such values lie on, and these times what is wanted.
    """
    count = basis.shape[2]
    coefficients, ridge = (
        torch.zeros(len(basis), count, dtype=torch.float64),
        _RIDGE * torch.eye(count, dtype=torch.float64),
    )
    active = torch.arange(len(basis))
    for _ in range(_ROUNDS):
        here, before = basis[active], coefficients[active]
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
        coefficients[active[better]] = (before + size * step)[better]
        active = active[better]
        if not len(active):
            break
    return coefficients
