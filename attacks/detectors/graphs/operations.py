"""The operations of a graph in torch, as TensorFlow defines them: on arrays of any
rank, and on images.

Padding SAME keeps ceil(size / stride) outputs and puts the odd row or column of padding
at the end; a depthwise filter is (height, width, channels, multiplier).

Tensors have the axes that the graph gives them, images channels-last. What torch
wants channels first is a view.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.graphs.graph import Node

Function = Callable[..., "Tensor | tuple[Tensor, ...]"]


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """A tensor of the graph at the size that the graph was made for."""

    tensor: Tensor  # of a constant its value, otherwise that for an input of zeros
    # under which name it is when the network runs; None for a constant
    slot: str | None = None


Run = Callable[..., tuple[Value, ...]]
"""Calls a function with the tensors of values and, unless all are constant, keeps it
for when the network runs.
"""


_DTYPES = {"DT_FLOAT": torch.float32, "DT_INT32": torch.int32}
_ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "Relu": torch.relu,
    "Relu6": functional.relu6,
}
Build = Callable[[Node, list[Value], Run], tuple[Value, ...]]
"""Makes an operation ready: from its node and inputs to its outputs."""
Padding = tuple[int, int, int, int]
"""Pixels left, right, above and below, in the order of `torch.nn.functional.pad`."""


def numbers(value: Value) -> list[int]:
    """The numbers in a constant, such as axes or a shape."""
    return [int(number) for number in value.tensor.reshape(-1).tolist()]


def on_tensors(function: Function) -> Build:
    """An operation without settings, whose inputs are the arguments of a function;
    elements are broadcast.
    """
    return lambda node, inputs, run: run(function, *inputs)


def identity(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Identity."""
    return (inputs[0],)


def leaky_relu(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """LeakyRelu."""
    return run(
        partial(functional.leaky_relu, negative_slope=node.settings.get("alpha", 0.2)),
        *inputs,
    )


def batch_norm(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """FusedBatchNorm in evaluation: its inputs are the image, scale, offset, mean and
    variance.
    """
    least = node.settings["epsilon"]

    def normed(
        picture: Tensor, scale: Tensor, offset: Tensor, mean: Tensor, variance: Tensor
    ) -> Tensor:
        result: Tensor = (picture - mean) * (
            scale * (variance + least).rsqrt()
        ) + offset
        return result

    return run(normed, *inputs)


def cast(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Cast."""
    return run(lambda tensor: tensor.to(_DTYPES[node.settings["DstT"]]), *inputs)


def transpose(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Transpose."""
    axes = numbers(inputs[1])
    return run(lambda tensor: tensor.permute(axes), inputs[0])


def mean(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Mean over some axes."""
    axes = numbers(inputs[1])
    keep = node.settings.get("keep_dims", False)
    return run(lambda tensor: tensor.mean(dim=axes, keepdim=keep), inputs[0])


def concatenate(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ConcatV2; the axis is its last input."""
    (axis,) = numbers(inputs[-1])
    return run(lambda *tensors: torch.cat(tensors, axis), *inputs[:-1])


def pad(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Pad with zeros, PadV2 with another number."""
    value = inputs[0]
    amounts = numbers(inputs[1])
    number = float(inputs[2].tensor) if len(inputs) > 2 else 0.0
    # torch wants the pairs of the last axis first.
    pairs = [
        amount
        for axis in reversed(range(value.tensor.ndim))
        for amount in amounts[2 * axis : 2 * axis + 2]
    ]
    return run(partial(functional.pad, pad=pairs, value=number), value)


def split(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SplitV into parts of given sizes."""
    value, sizes, (axis,) = inputs[0], numbers(inputs[1]), numbers(inputs[2])
    length = value.tensor.shape[axis]
    sizes = [length - sum(sizes) - 1 if size == -1 else size for size in sizes]
    return run(lambda tensor: torch.split(tensor, sizes, axis), value)


def reshape(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Reshape."""
    shape = numbers(inputs[1])
    return run(lambda tensor: tensor.reshape(shape), inputs[0])


def sparse_to_dense(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SparseToDense: values at positions of an array that is otherwise of one
    number.
    """
    shape = numbers(inputs[1])

    def dense(positions: Tensor, sparse: Tensor, rest: Tensor) -> Tensor:
        whole = rest.expand(shape).clone()
        whole[tuple(positions.reshape(-1, len(shape)).long().unbind(1))] = (
            sparse.expand(len(positions))
        )
        return whole

    return run(dense, inputs[0], inputs[2], inputs[3])


def on_pictures(
    function: Callable[..., Tensor], *inputs: Value, run: Run
) -> tuple[Value, ...]:
    """A function of an image (B, C, H, W), and of other tensors, for one that is (B,
    H, W, C).
    """

    def call(picture: Tensor, *others: Tensor) -> Tensor:
        return function(picture.permute(0, 3, 1, 2), *others).permute(0, 2, 3, 1)

    return run(call, *inputs)


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Pixels before and after one side of an image, so that ceil(size / stride)
    outputs come out.
    """
    missing = max((math.ceil(size / stride) - 1) * stride + kernel - size, 0)
    return missing // 2, missing - missing // 2


def _padding(node: Node, picture: Value, kernel: tuple[int, int]) -> Padding:
    if node.settings["padding"] == "VALID":
        return 0, 0, 0, 0
    (_, high, wide, _), strides = picture.tensor.shape, node.settings["strides"]
    above, below = same_padding(high, kernel[0], strides[1])
    left, right = same_padding(wide, kernel[1], strides[2])
    return left, right, above, below


def _pad(picture: Tensor, padding: Padding, value: float = 0.0) -> Tensor:
    if any(padding):
        return functional.pad(picture, padding, value=value)
    return picture


def convolution(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Conv2D, DepthwiseConv2dNative, and both with what is fused to them: a bias and an
    activation.
    """
    picture = inputs[0]
    kernel = inputs[1].tensor
    high, wide, channels, multiplier = kernel.shape
    depthwise = "Depthwise" in node.op
    if depthwise:
        kernel = kernel.permute(2, 3, 0, 1).reshape(
            channels * multiplier, 1, high, wide
        )
    else:
        kernel = kernel.permute(3, 2, 0, 1)
    padding = _padding(node, picture, (high, wide))
    even = padding[0] == padding[1] and padding[2] == padding[3]
    fused = node.settings.get("fused_ops", ())  # BiasAdd, and perhaps an activation
    taken = [picture, Value(kernel.contiguous()), *(inputs[2:3] if fused else ())]
    around, uneven = (
        ((padding[2], padding[0]), (0, 0, 0, 0)) if even else ((0, 0), padding)
    )
    settings: dict[str, Any] = {
        "stride": node.settings["strides"][1:3],
        "padding": around,
    }
    settings["groups"] = channels if depthwise else 1
    activation = _ACTIVATIONS[fused[1]] if len(fused) > 1 else lambda tensor: tensor

    def convolve(picture: Tensor, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
        return activation(
            functional.conv2d(_pad(picture, uneven), kernel, bias, **settings)
        )

    return on_pictures(convolve, *taken, run=run)


def max_pool(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """MaxPool; what is padded counts for nothing."""
    size = node.settings["ksize"][1:3]
    stride = node.settings["strides"][1:3]
    padding = _padding(node, inputs[0], (size[0], size[1]))

    def pooled(picture: Tensor) -> Tensor:
        return functional.max_pool2d(_pad(picture, padding, -math.inf), size, stride)

    return on_pictures(pooled, inputs[0], run=run)


def resize_bilinear(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ResizeBilinear by pixel centres, or in the old form that aligns first pixels."""
    centres = node.settings["half_pixel_centers"]
    sides = zip(inputs[0].tensor.shape[1:3], numbers(inputs[1]), strict=True)
    down, across = (
        Value(interpolation(side, wanted, centres=centres)) for side, wanted in sides
    )
    return on_pictures(
        lambda picture, rows, columns: rows @ picture @ columns.mT,
        inputs[0],
        down,
        across,
        run=run,
    )


def interpolation(size: int, wanted: int, *, centres: bool) -> Tensor:
    """(wanted, size) weights of linear interpolation along one side."""
    at = torch.arange(wanted, dtype=torch.float64)
    if centres:
        at = ((at + 0.5) * (size / wanted) - 0.5).clamp(min=0)
    else:
        at = at * (size / wanted)
    low = at.floor().long().clamp(max=size - 1)
    high = (low + 1).clamp(max=size - 1)
    fraction = at - low
    weights = torch.zeros(wanted, size, dtype=torch.float64)
    rows = torch.arange(wanted)
    weights[rows, low] += 1 - fraction
    weights[rows, high] += fraction
    return weights.float()


OPERATIONS: Mapping[str, Build] = {
    "Add": on_tensors(torch.add),
    "AddV2": on_tensors(torch.add),
    "BiasAdd": on_tensors(torch.add),
    "Cast": cast,
    "ConcatV2": concatenate,
    "Conv2D": convolution,
    "DepthwiseConv2dNative": convolution,
    "FusedBatchNorm": batch_norm,
    "FusedDepthwiseConv2dNative": convolution,
    "Identity": identity,
    "LeakyRelu": leaky_relu,
    "MaxPool": max_pool,
    "Mean": mean,
    "Mul": on_tensors(torch.mul),
    "Pad": pad,
    "PadV2": pad,
    "Relu": on_tensors(torch.relu),
    "Relu6": on_tensors(functional.relu6),
    "Reshape": reshape,
    "ResizeBilinear": resize_bilinear,
    "Sigmoid": on_tensors(torch.sigmoid),
    "SparseToDense": sparse_to_dense,
    "SplitV": split,
    "Transpose": transpose,
    "_FusedConv2D": convolution,
}
"""What each operation of TensorFlow becomes."""
