"""The contract of a projection: what cameras and the ray tracer rely on."""

from __future__ import annotations

import numpy as np

from attacks.testing.promises import Contract, expect
from mi_splat.cameras.lens import Projection

_POINTS = np.array([[0.0, 0.0], [0.3, -0.2], [-0.4, 0.1], [0.05, 0.45]])
_DEPTHS = (0.5, 1.0, 4.0)
_CLOSE = 1e-9


def check_projection(projection: Projection) -> None:
    """Raise unless a projection keeps its contract.

    The ray of each point of the image plane grows by 1 in z, and all its points are
    placed where it comes from; arrays are taken as numbers are.

    Args:
        projection: The projection, which need not be registered.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"projection {projection.name}")
    u, v = _POINTS.T
    with contract.promise("the ray"):
        start, direction = projection.ray(u, v)
        steps = np.broadcast_to(direction[2], u.shape)
        expect(
            bool((steps == 1).all()),
            "a direction whose z is 1",
            steps.tolist(),
            "divide it by its z",
        )
    contract.settle()
    for depth in _DEPTHS:
        with contract.promise(f"points of rays at depth {depth:g}"):
            x, y, z = (
                begin + depth * step
                for begin, step in zip(start, direction, strict=True)
            )
            placed = np.stack(np.broadcast_arrays(*projection.place(x, y, z)), 1)
            error = float(np.abs(placed - _POINTS).max())
            expect(
                error <= _CLOSE,
                "the point of the image plane that the ray comes from",
                f"one {error:.3g} away",
                "make `place` the inverse of `ray`",
            )
    contract.settle()
