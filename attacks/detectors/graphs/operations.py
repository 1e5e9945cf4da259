"""The operations of a graph in torch, as TensorFlow defines them: on arrays of any rank, and on pictures.

Padding SAME keeps ceil(size / stride) outputs and puts the odd row or column of padding at the end; a depthwise filter
is (height, width, channels, multiplier).
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.catalogue import DetectorError
from attacks.detectors.graphs.files import Node
from attacks.detectors.graphs.values import (
    CHANNELS_FIRST,
    Run,
    Step,
    Value,
    aligned,
    channels_first,
    composed,
    inverse,
    logical,
    plain,
)

_DTYPES = {
    "DT_FLOAT": torch.float32,
    "DT_INT32": torch.int32,
    "DT_INT64": torch.int64,
    "DT_BOOL": torch.bool,
}
Build = Callable[[Node, list[Value], Run], tuple[Value, ...]]
"""Makes an operation ready: from its node and inputs to its outputs."""
Padding = tuple[int, int, int, int]
"""Pixels left, right, above and below, in the order of `torch.nn.functional.pad`."""


def unsupported(node: Node, what: str, expected: str, got: object) -> DetectorError:
    """The error for a setting of an operation that this reader does not know."""
    name = f"{what} of {node.op} {node.name}"
    return DetectorError.of(name, expected, got, "use a model without it")


def numbers(node: Node, value: Value) -> list[int]:
    """The numbers in a constant, such as axes or a shape."""
    if not value.constant:
        raise unsupported(node, "axes or sizes", "constants", "computed ones")
    return [int(number) for number in value.logical.reshape(-1).tolist()]


def _axis(node: Node, axis: Value, rank: int) -> int:
    (number,) = numbers(node, axis)
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
    function = partial(functional.leaky_relu, negative_slope=node.number("alpha", 0.2))
    return elementwise(function)(node, inputs, run)


def cast(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Cast."""
    name = node.kind("DstT")
    if name not in _DTYPES:
        raise unsupported(node, "DstT", ", ".join(_DTYPES), name)
    return elementwise(lambda tensor: tensor.to(_DTYPES[name]))(node, inputs, run)


def transpose(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Transpose: nothing moves, only the order is another."""
    value = inputs[0]
    return (Value(value.tensor, composed(value.order, numbers(node, inputs[1])), value.slot),)


def mean(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Mean over some axes."""
    axes = [axis % len(inputs[0].order) for axis in numbers(node, inputs[1])]
    keep = node.flag("keep_dims")
    value = inputs[0] if keep else logical(inputs[0], run)
    kept = [value.order[axis] for axis in axes]
    order = value.order if keep else plain(len(value.order) - len(axes))
    return run(Step(lambda tensor: tensor.mean(dim=kept, keepdim=keep), (value,), (order,)))


def concatenate(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ConcatV2; the axis is its last input."""
    values, order = aligned(inputs[:-1], run)
    axis = order[_axis(node, inputs[-1], len(order))]
    return run(Step(lambda *tensors: torch.cat(tensors, axis), values, (order,)))


def pad(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Pad with zeros, PadV2 with another number."""
    value, amounts = inputs[0], numbers(node, inputs[1])
    number = float(inputs[2].tensor) if len(inputs) > 2 else 0.0
    # torch wants pairs of the axes in memory, the last one first.
    axes = inverse(value.order)
    pairs = [amount for axis in reversed(axes) for amount in amounts[2 * axis : 2 * axis + 2]]
    return run(Step(partial(functional.pad, pad=pairs, value=number), (value,), (value.order,)))


def split(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SplitV into parts of given sizes."""
    value, sizes = inputs[0], numbers(node, inputs[1])
    axis = value.order[_axis(node, inputs[2], len(value.order))]
    length = value.tensor.shape[axis]
    sizes = [length - sum(sizes) - 1 if size == -1 else size for size in sizes]
    return run(Step(lambda tensor: torch.split(tensor, sizes, axis), (value,), (value.order,) * len(sizes)))


def reshape(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Reshape."""
    value, shape = logical(inputs[0], run), numbers(node, inputs[1])
    return run(Step(lambda tensor: tensor.reshape(shape), (value,), (plain(len(shape)),)))


def expand_dims(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ExpandDims: one more axis of length 1."""
    value = logical(inputs[0], run)
    axis = _axis(node, inputs[1], len(value.order) + 1)
    return run(Step(lambda tensor: tensor.unsqueeze(axis), (value,), (plain(len(value.order) + 1),)))


def strided_slice(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """StridedSlice with positive strides."""
    if node.integer("ellipsis_mask") or node.integer("new_axis_mask"):
        raise unsupported(node, "mask", "no ellipsis and no new axis", "one of them")
    value = logical(inputs[0], run)
    begins, ends, strides = (numbers(node, value) for value in inputs[1:4])
    if min(strides) < 1:
        raise unsupported(node, "strides", "positive numbers", strides)
    index: list[slice | int] = []
    for axis, (begin, end, stride) in enumerate(zip(begins, ends, strides, strict=True)):
        bit = 1 << axis
        if node.integer("shrink_axis_mask") & bit:
            index.append(begin)
        else:
            first = None if node.integer("begin_mask") & bit else begin
            last = None if node.integer("end_mask") & bit else end
            index.append(slice(first, last, stride))
    rank = len(value.order) - sum(isinstance(part, int) for part in index)
    return run(Step(lambda tensor: tensor[tuple(index)], (value,), (plain(rank),)))


def gather(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """GatherV2 without batch axes."""
    if node.integer("batch_dims"):
        raise unsupported(node, "batch_dims", "0", node.integer("batch_dims"))
    values, indices = (logical(value, run) for value in inputs[:2])
    axis = _axis(node, inputs[2], len(values.order))

    def gathered(tensor: Tensor, where: Tensor) -> Tensor:
        shape = (*tensor.shape[:axis], *where.shape, *tensor.shape[axis + 1 :])
        return tensor.index_select(axis, where.reshape(-1).long()).reshape(shape)

    rank = len(values.order) + len(indices.order) - 1
    return run(Step(gathered, (values, indices), (plain(rank),)))


def top_k(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """TopKV2: the largest values along the last axis, and where they are."""
    value = logical(inputs[0], run)
    (count,) = numbers(node, inputs[1])

    def largest(tensor: Tensor) -> tuple[Tensor, ...]:
        top = tensor.topk(count, dim=-1)
        return top.values, top.indices.to(torch.int32)

    return run(Step(largest, (value,), (value.order,) * 2))


def sparse_to_dense(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SparseToDense: values at positions of an array that is otherwise of one number."""
    indices, values, default = (logical(inputs[i], run) for i in (0, 2, 3))
    shape = numbers(node, inputs[1])

    def dense(positions: Tensor, sparse: Tensor, rest: Tensor) -> Tensor:
        whole = rest.expand(shape).clone()
        whole[tuple(positions.reshape(-1, len(shape)).long().unbind(1))] = sparse.expand(len(positions))
        return whole

    return run(Step(dense, (indices, values, default), (plain(len(shape)),)))


def same_padding(size: int, kernel: int, stride: int, dilation: int) -> tuple[int, int]:
    """Pixels before and after one side of a picture, so that ceil(size / stride) outputs come out."""
    wanted = (math.ceil(size / stride) - 1) * stride + (kernel - 1) * dilation + 1
    missing = max(wanted - size, 0)
    return missing // 2, missing - missing // 2


def _padding(node: Node, picture: Value, kernel: tuple[int, int]) -> Padding:
    kind = node.word("padding", "VALID")
    if kind == "VALID":
        return 0, 0, 0, 0
    if kind != "SAME":
        raise unsupported(node, "padding", "SAME or VALID", kind)
    _, high, wide, _ = picture.shape
    strides, dilations = node.ints("strides"), _dilations(node)
    above, below = same_padding(high, kernel[0], strides[1], dilations[0])
    left, right = same_padding(wide, kernel[1], strides[2], dilations[1])
    return left, right, above, below


def _dilations(node: Node) -> tuple[int, int]:
    return node.ints("dilations")[1:3] if "dilations" in node.attributes else (1, 1)  # type: ignore[return-value]


def _pad(picture: Tensor, padding: Padding, value: float = 0.0) -> Tensor:
    return functional.pad(picture, padding, value=value) if any(padding) else picture


def convolution(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Conv2D, DepthwiseConv2dNative, and both with what is fused to them: a bias and an activation."""
    if node.word("data_format", "NHWC") != "NHWC":
        raise unsupported(node, "data_format", "NHWC", node.word("data_format", ""))
    picture, weights = channels_first(inputs[0], run), inputs[1]
    if not weights.constant:
        raise unsupported(node, "filter", "a constant", "a computed one")
    kernel = weights.logical
    high, wide, channels, multiplier = kernel.shape
    depthwise = "Depthwise" in node.op
    if depthwise:
        kernel = kernel.permute(2, 3, 0, 1).reshape(channels * multiplier, 1, high, wide)
    else:
        kernel = kernel.permute(3, 2, 0, 1)
    padding = _padding(node, picture, (high, wide))
    even = padding[0] == padding[1] and padding[2] == padding[3]
    fused = list(node.words("fused_ops")) if "fused_ops" in node.attributes else []
    taken = [picture, Value(kernel.contiguous(), (0, 1, 2, 3))]
    if fused[:1] == ["BiasAdd"]:
        fused.pop(0)
        taken.append(inputs[2])
    convolve = partial(
        _convolve,
        stride=node.ints("strides")[1:3],
        dilation=_dilations(node),
        groups=channels if depthwise else 1,
        around=(padding[2], padding[0]) if even else (0, 0),
        uneven=(0, 0, 0, 0) if even else padding,
        activation=_activation(node, fused),
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


def _activation(node: Node, fused: list[str]) -> Callable[[Tensor], Tensor] | None:
    known: dict[str, Callable[[Tensor], Tensor]] = {
        "Relu": torch.relu,
        "Relu6": functional.relu6,
        "Elu": functional.elu,
        "Sigmoid": torch.sigmoid,
        "LeakyRelu": partial(functional.leaky_relu, negative_slope=node.number("leakyrelu_alpha", 0.2)),
    }
    if not fused:
        return None
    if len(fused) > 1 or fused[0] not in known:
        raise unsupported(node, "fused_ops", f"BiasAdd, then one of {', '.join(known)}", ", ".join(fused))
    return known[fused[0]]


def max_pool(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """MaxPool; what is padded counts for nothing."""
    picture = channels_first(inputs[0], run)
    size = node.ints("ksize")[1:3]
    padding = _padding(node, picture, (size[0], size[1]))
    stride = node.ints("strides")[1:3]
    return run(
        Step(
            lambda tensor: functional.max_pool2d(_pad(tensor, padding, -math.inf), size, stride),
            (picture,),
            (CHANNELS_FIRST,),
        )
    )


def resize_bilinear(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ResizeBilinear in its three forms: pixel centres, aligned corners, and the old one that aligns first pixels."""
    picture = channels_first(inputs[0], run)
    if not inputs[1].constant:
        raise unsupported(node, "size", "a constant", "a computed one")
    rows, columns = (int(size) for size in inputs[1].logical.tolist())
    settings = {"corners": node.flag("align_corners"), "centres": node.flag("half_pixel_centers")}
    down = Value(interpolation(picture.shape[1], rows, **settings), (0, 1))
    across = Value(interpolation(picture.shape[2], columns, **settings), (0, 1))
    return run(
        Step(lambda tensor, rows, columns: rows @ tensor @ columns.mT, (picture, down, across), (CHANNELS_FIRST,))
    )


def interpolation(size: int, wanted: int, *, corners: bool, centres: bool) -> Tensor:
    """(wanted, size) weights of linear interpolation along one side."""
    at = torch.arange(wanted, dtype=torch.float64)
    if corners:
        at = at * ((size - 1) / max(wanted - 1, 1))
    elif centres:
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
    "Add": pairwise(torch.add),
    "AddV2": pairwise(torch.add),
    "Cast": cast,
    "ConcatV2": concatenate,
    "Conv2D": convolution,
    "DepthwiseConv2dNative": convolution,
    "Equal": pairwise(torch.eq),
    "ExpandDims": expand_dims,
    "FloorDiv": pairwise(torch.floor_divide),
    "FloorMod": pairwise(torch.remainder),
    "FusedDepthwiseConv2dNative": convolution,
    "GatherV2": gather,
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
    "StridedSlice": strided_slice,
    "Sub": pairwise(torch.sub),
    "TopKV2": top_k,
    "Transpose": transpose,
    "_FusedConv2D": convolution,
}
"""What each operation of TensorFlow becomes."""
