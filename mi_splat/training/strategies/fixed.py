"""A fixed number of Gaussians: only their values are trained."""

from __future__ import annotations

from mi_splat.training.strategies.base import Strategy


class FixedStrategy(Strategy):
    """All hooks as they are: nothing is remembered, added or changed."""
