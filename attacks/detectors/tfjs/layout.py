"""Steps that bring tensors into the order of axes that an operation needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from attacks.detectors.tfjs.values import CHANNELS_FIRST, Order, Step, Value, composed, inverse, plain

Run = Callable[[Step], tuple[Value, ...]]
"""Runs a step at once and, unless all it takes is constant, keeps it for when the network runs."""


def ordered(value: Value, order: Order, run: Run) -> Value:
    """The value kept in this order; a view of the same memory."""
    if value.order == order:
        return value
    # In memory the new axis k is the graph's axis inverse(order)[k], which the old memory has at value.order.
    axes = composed(value.order, inverse(order))

    def permute(tensor: Tensor) -> Tensor:
        return tensor.permute(axes)

    return run(Step(permute, (value,), (order,)))[0]


def logical(value: Value, run: Run) -> Value:
    """The value kept as the graph has it."""
    return ordered(value, plain(len(value.order)), run)


def channels_first(value: Value, run: Run) -> Value:
    """A (B, H, W, C) value kept as (B, C, H, W)."""
    return ordered(value, CHANNELS_FIRST, run)


def of_rank(value: Value, rank: int, run: Run) -> Value:
    """A value with as many axes of length 1 before the others as it takes to reach a rank, as broadcasting has it."""
    missing = rank - len(value.order)
    if missing <= 0:
        return value
    value = logical(value, run)

    def unsqueeze(tensor: Tensor) -> Tensor:
        return tensor.reshape((1,) * missing + tuple(tensor.shape))

    return run(Step(unsqueeze, (value,), (plain(rank),)))[0]


def aligned(values: Sequence[Value], run: Run) -> tuple[tuple[Value, ...], Order]:
    """Values of one rank and one order, that of the first which is no constant, if any, and that order."""
    rank = max(len(value.order) for value in values)
    leading = [value.order for value in values if not value.constant and len(value.order) == rank]
    order = leading[0] if leading else plain(rank)
    return tuple(ordered(of_rank(value, rank, run), order, run) for value in values), order
