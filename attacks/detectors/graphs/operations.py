"""The operations of a graph in torch, as TensorFlow defines them: on arrays of any rank, and on pictures.

Padding SAME keeps ceil(size / stride) outputs and puts the odd row or column of padding at the end; a depthwise filter
is (height, width, channels, multiplier).

TensorFlow keeps pictures channels-last and a graph moves axes about; torch's convolutions want channels first. So each
tensor has an order: `order[i]` is the axis in memory of the graph's axis i. A transposition changes only the order.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.graphs.graph import Node

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
    """A tensor of the graph at the size that the graph was made for."""

    tensor: Tensor  # as it is kept in memory: of a constant its value, otherwise that for an input of zeros
    order: Order  # axis in memory of each of the graph's axes
    slot: str | None = None  # under which name it is when the network runs; None for a constant

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
    """One call when the network runs."""

    function: Function  # of the tensors of `inputs` as they are in memory
    inputs: tuple[Value, ...]  # what it takes
    orders: tuple[Order, ...]  # order of each output


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


_DTYPES = {"DT_FLOAT": torch.float32, "DT_INT32": torch.int32}
_ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {"Relu": torch.relu, "Relu6": functional.relu6}
Build = Callable[[Node, list[Value], Run], tuple[Value, ...]]
"""Makes an operation ready: from its node and inputs to its outputs."""
Padding = tuple[int, int, int, int]
"""Pixels left, right, above and below, in the order of `torch.nn.functional.pad`."""


def numbers(value: Value) -> list[int]:
    """The numbers in a constant, such as axes or a shape."""
    return [int(number) for number in value.logical.reshape(-1).tolist()]


def _axis(axis: Value, rank: int) -> int:
    (number,) = numbers(axis)
    return number % rank


def elementwise(function: Callable[[Tensor], Tensor]) -> Build:
    """An operation on each element."""

    def build(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
        return run(Step(function, (inputs[0],), (inputs[0].order,)))

    return build


def pairwise(function: Callable[[Tensor, Tensor], Tensor]) -> Build:
    """An operation on pairs of elements, with broadcasting."""

    def build(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
        values, order = aligned(inputs, run)
        return run(Step(function, values, (order,)))

    return build


def identity(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Identity."""
    return (inputs[0],)


def leaky_relu(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """LeakyRelu."""
    function = partial(functional.leaky_relu, negative_slope=node.settings.get("alpha", 0.2))
    return elementwise(function)(node, inputs, run)


def cast(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Cast."""
    return elementwise(lambda tensor: tensor.to(_DTYPES[node.settings["DstT"]]))(node, inputs, run)


def transpose(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Transpose: nothing moves, only the order is another."""
    value = inputs[0]
    return (Value(value.tensor, composed(value.order, numbers(inputs[1])), value.slot),)


def mean(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Mean over some axes."""
    axes = [axis % len(inputs[0].order) for axis in numbers(inputs[1])]
    keep = node.settings.get("keep_dims", False)
    value = inputs[0] if keep else logical(inputs[0], run)
    kept = [value.order[axis] for axis in axes]
    order = value.order if keep else plain(len(value.order) - len(axes))
    return run(Step(lambda tensor: tensor.mean(dim=kept, keepdim=keep), (value,), (order,)))


def concatenate(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ConcatV2; the axis is its last input."""
    values, order = aligned(inputs[:-1], run)
    axis = order[_axis(inputs[-1], len(order))]
    return run(Step(lambda *tensors: torch.cat(tensors, axis), values, (order,)))


def pad(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Pad with zeros, PadV2 with another number."""
    value, amounts = inputs[0], numbers(inputs[1])
    number = float(inputs[2].tensor) if len(inputs) > 2 else 0.0
    # torch wants pairs of the axes in memory, the last one first.
    axes = inverse(value.order)
    pairs = [amount for axis in reversed(axes) for amount in amounts[2 * axis : 2 * axis + 2]]
    return run(Step(partial(functional.pad, pad=pairs, value=number), (value,), (value.order,)))


def split(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SplitV into parts of given sizes."""
    value, sizes = inputs[0], numbers(inputs[1])
    axis = value.order[_axis(inputs[2], len(value.order))]
    length = value.tensor.shape[axis]
    sizes = [length - sum(sizes) - 1 if size == -1 else size for size in sizes]
    return run(Step(lambda tensor: torch.split(tensor, sizes, axis), (value,), (value.order,) * len(sizes)))


def reshape(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Reshape."""
    value, shape = logical(inputs[0], run), numbers(inputs[1])
    return run(Step(lambda tensor: tensor.reshape(shape), (value,), (plain(len(shape)),)))


def sparse_to_dense(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SparseToDense: values at positions of an array that is otherwise of one number."""
    indices, values, default = (logical(inputs[i], run) for i in (0, 2, 3))
    shape = numbers(inputs[1])

    def dense(positions: Tensor, sparse: Tensor, rest: Tensor) -> Tensor:
        whole = rest.expand(shape).clone()
        whole[tuple(positions.reshape(-1, len(shape)).long().unbind(1))] = sparse.expand(len(positions))
        return whole

    return run(Step(dense, (indices, values, default), (plain(len(shape)),)))


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Pixels before and after one side of a picture, so that ceil(size / stride) outputs come out."""
    missing = max((math.ceil(size / stride) - 1) * stride + kernel - size, 0)
    return missing // 2, missing - missing // 2


def _padding(node: Node, picture: Value, kernel: tuple[int, int]) -> Padding:
    if node.settings["padding"] == "VALID":
        return 0, 0, 0, 0
    (_, high, wide, _), strides = picture.shape, node.settings["strides"]
    above, below = same_padding(high, kernel[0], strides[1])
    left, right = same_padding(wide, kernel[1], strides[2])
    return left, right, above, below


def _pad(picture: Tensor, padding: Padding, value: float = 0.0) -> Tensor:
    return functional.pad(picture, padding, value=value) if any(padding) else picture


def convolution(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Conv2D, DepthwiseConv2dNative, and both with what is fused to them: a bias and an activation."""
    picture, weights = channels_first(inputs[0], run), inputs[1]
    kernel = weights.logical
    high, wide, channels, multiplier = kernel.shape
    depthwise = "Depthwise" in node.op
    if depthwise:
        kernel = kernel.permute(2, 3, 0, 1).reshape(channels * multiplier, 1, high, wide)
    else:
        kernel = kernel.permute(3, 2, 0, 1)
    padding = _padding(node, picture, (high, wide))
    even = padding[0] == padding[1] and padding[2] == padding[3]
    fused = node.settings.get("fused_ops", ())  # BiasAdd, and perhaps an activation
    taken = [picture, Value(kernel.contiguous(), (0, 1, 2, 3)), *(inputs[2:3] if fused else ())]
    convolve = partial(
        _convolve,
        stride=node.settings["strides"][1:3],
        groups=channels if depthwise else 1,
        around=(padding[2], padding[0]) if even else (0, 0),
        uneven=(0, 0, 0, 0) if even else padding,
        activation=_ACTIVATIONS[fused[1]] if len(fused) > 1 else None,
    )
    return run(Step(convolve, tuple(taken), (CHANNELS_FIRST,)))


def _convolve(
    picture: Tensor,
    kernel: Tensor,
    bias: Tensor | None = None,
    *,
    uneven: Padding,
    around: tuple[int, int],
    activation: Callable[[Tensor], Tensor] | None,
    **settings: Any,
) -> Tensor:
    result = functional.conv2d(_pad(picture, uneven), kernel, bias, padding=around, **settings)
    return result if activation is None else activation(result)


def max_pool(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """MaxPool; what is padded counts for nothing."""
    picture = channels_first(inputs[0], run)
    size = node.settings["ksize"][1:3]
    padding = _padding(node, picture, (size[0], size[1]))
    stride = node.settings["strides"][1:3]
    return run(
        Step(
            lambda tensor: functional.max_pool2d(_pad(tensor, padding, -math.inf), size, stride),
            (picture,),
            (CHANNELS_FIRST,),
        )
    )


def resize_bilinear(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ResizeBilinear by pixel centres, or in the old form that aligns first pixels."""
    picture, (rows, columns) = channels_first(inputs[0], run), numbers(inputs[1])
    centres = node.settings["half_pixel_centers"]
    down = Value(interpolation(picture.shape[1], rows, centres=centres), (0, 1))
    across = Value(interpolation(picture.shape[2], columns, centres=centres), (0, 1))
    return run(
        Step(lambda tensor, rows, columns: rows @ tensor @ columns.mT, (picture, down, across), (CHANNELS_FIRST,))
    )


def interpolation(size: int, wanted: int, *, centres: bool) -> Tensor:
    """(wanted, size) weights of linear interpolation along one side."""
    at = torch.arange(wanted, dtype=torch.float64)
    at = ((at + 0.5) * (size / wanted) - 0.5).clamp(min=0) if centres else at * (size / wanted)
    low = at.floor().long().clamp(max=size - 1)
    high = (low + 1).clamp(max=size - 1)
    fraction = at - low
    weights = torch.zeros(wanted, size, dtype=torch.float64)
    rows = torch.arange(wanted)
    weights[rows, low] += 1 - fraction
    weights[rows, high] += fraction
    return weights.float()


OPERATIONS: Mapping[str, Build] = {
    "Add": pairwise(torch.add),
    "AddV2": pairwise(torch.add),
    "Cast": cast,
    "ConcatV2": concatenate,
    "Conv2D": convolution,
    "DepthwiseConv2dNative": convolution,
    "FusedDepthwiseConv2dNative": convolution,
    "Identity": identity,
    "LeakyRelu": leaky_relu,
    "MaxPool": max_pool,
    "Mean": mean,
    "Mul": pairwise(torch.mul),
    "Pad": pad,
    "PadV2": pad,
    "Relu": elementwise(torch.relu),
    "Relu6": elementwise(functional.relu6),
    "Reshape": reshape,
    "ResizeBilinear": resize_bilinear,
    "Sigmoid": elementwise(torch.sigmoid),
    "SparseToDense": sparse_to_dense,
    "SplitV": split,
    "Transpose": transpose,
    "_FusedConv2D": convolution,
}
"""What each operation of TensorFlow becomes."""
