"""A tensor of a graph while it is made ready: what it is in TensorFlow's order of axes, and how it is kept in memory.

TensorFlow keeps pictures channels-last and a graph moves axes about; torch's convolutions want channels first. So each
tensor has an order: `order[i]` is the axis in memory of the graph's axis i. A transposition changes only the order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

Order = tuple[int, ...]
Function = Callable[..., "Tensor | tuple[Tensor, ...]"]

CHANNELS_FIRST: Order = (0, 2, 3, 1)
"""Order of a (B, H, W, C) tensor that is kept as (B, C, H, W)."""


def plain(rank: int) -> Order:
    """The order of a tensor that is kept as the graph has it."""
    return tuple(range(rank))


def composed(order: Order, axes: Sequence[int]) -> Order:
    """The order after the graph has moved its axes: its new axis i is its old one axes[i]."""
    return tuple(order[axis] for axis in axes)


def inverse(order: Order) -> Order:
    """Which of the graph's axes each axis in memory is."""
    return tuple(order.index(axis) for axis in range(len(order)))


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """A tensor of the graph at the size that the graph was made for.

    Attributes:
        tensor: As it is kept in memory: of a constant its value, otherwise that for an input of zeros.
        order: Axis in memory of each of the graph's axes.
        slot: Under which name it is when the network runs; None for a constant.
    """

    tensor: Tensor
    order: Order
    slot: str | None = None

    @property
    def constant(self) -> bool:
        """Whether it is the same for every input."""
        return self.slot is None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape in the graph's order of axes."""
        return tuple(self.tensor.shape[axis] for axis in self.order)

    @property
    def logical(self) -> Tensor:
        """The tensor in the graph's order of axes; a view."""
        return self.tensor.permute(self.order)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One call when the network runs.

    Attributes:
        function: Of the tensors of `inputs` as they are in memory.
        inputs: What it takes.
        orders: Order of each output.
    """

    function: Function
    inputs: tuple[Value, ...]
    orders: tuple[Order, ...]


Run = Callable[[Step], tuple[Value, ...]]
"""Runs a step at once and, unless all it takes is constant, keeps it for when the network runs."""


def ordered(value: Value, order: Order, run: Run) -> Value:
    """The value kept in this order; a view of the same memory."""
    if value.order == order:
        return value
    # In memory the new axis k is the graph's axis inverse(order)[k], which the old memory has at value.order.
    axes = composed(value.order, inverse(order))
    return run(Step(lambda tensor: tensor.permute(axes), (value,), (order,)))[0]


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
    shape = (1,) * missing + value.shape
    return run(Step(lambda tensor: tensor.reshape(shape), (logical(value, run),), (plain(rank),)))[0]


def aligned(values: Sequence[Value], run: Run) -> tuple[tuple[Value, ...], Order]:
    """Values of one rank and one order, that of the first which is no constant, if any, and that order."""
    rank = max(len(value.order) for value in values)
    leading = [value.order for value in values if not value.constant and len(value.order) == rank]
    order = leading[0] if leading else plain(rank)
    return tuple(ordered(of_rank(value, rank, run), order, run) for value in values), order
