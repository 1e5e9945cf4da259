"""Operations on arrays of any rank, as TensorFlow defines them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.tfjs.convolutions import unsupported
from attacks.detectors.tfjs.files import Node
from attacks.detectors.tfjs.layout import Run, aligned, logical
from attacks.detectors.tfjs.values import Step, Value, composed, inverse, plain

_DTYPES = {
    "DT_FLOAT": torch.float32,
    "DT_INT32": torch.int32,
    "DT_INT64": torch.int64,
    "DT_BOOL": torch.bool,
}
Build = Callable[[Node, list[Value], Run], tuple[Value, ...]]


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
    return run(Step(function, (inputs[0],), (inputs[0].order,)))


def cast(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Cast."""
    name = node.kind("DstT")
    if name not in _DTYPES:
        raise unsupported(node, "DstT", ", ".join(_DTYPES), name)
    dtype = _DTYPES[name]

    def convert(tensor: Tensor) -> Tensor:
        return tensor.to(dtype)

    return run(Step(convert, (inputs[0],), (inputs[0].order,)))


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

    def average(tensor: Tensor) -> Tensor:
        return tensor.mean(dim=kept, keepdim=keep)

    return run(Step(average, (value,), (value.order if keep else plain(len(value.order) - len(axes)),)))


def concatenate(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ConcatV2; the axis is its last input."""
    values, order = aligned(inputs[:-1], run)
    axis = order[_axis(node, inputs[-1], len(order))]

    def together(*tensors: Tensor) -> Tensor:
        return torch.cat(tensors, axis)

    return run(Step(together, values, (order,)))


def pad(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Pad with zeros, PadV2 with another number."""
    value, amounts = inputs[0], numbers(node, inputs[1])
    number = float(inputs[2].tensor) if len(inputs) > 2 else 0.0
    # torch wants pairs of the axes in memory, the last one first.
    axes = inverse(value.order)
    pairs = [amount for axis in reversed(axes) for amount in amounts[2 * axis : 2 * axis + 2]]

    def padded(tensor: Tensor) -> Tensor:
        return functional.pad(tensor, pairs, value=number)

    return run(Step(padded, (value,), (value.order,)))


def split(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SplitV into parts of given sizes."""
    value, sizes = inputs[0], numbers(node, inputs[1])
    axis = value.order[_axis(node, inputs[2], len(value.order))]
    length = value.tensor.shape[axis]
    sizes = [length - sum(sizes) - 1 if size == -1 else size for size in sizes]

    def parts(tensor: Tensor) -> tuple[Tensor, ...]:
        return torch.split(tensor, sizes, axis)

    return run(Step(parts, (value,), (value.order,) * len(sizes)))


def reshape(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """Reshape."""
    value, shape = logical(inputs[0], run), numbers(node, inputs[1])

    def reshaped(tensor: Tensor) -> Tensor:
        return tensor.reshape(shape)

    return run(Step(reshaped, (value,), (plain(len(shape)),)))


def expand_dims(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ExpandDims: one more axis of length 1."""
    value = logical(inputs[0], run)
    axis = _axis(node, inputs[1], len(value.order) + 1)

    def expanded(tensor: Tensor) -> Tensor:
        return tensor.unsqueeze(axis)

    return run(Step(expanded, (value,), (plain(len(value.order) + 1),)))


def strided_slice(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """StridedSlice with positive strides."""
    if node.integer("ellipsis_mask") or node.integer("new_axis_mask"):
        raise unsupported(node, "mask", "no ellipsis and no new axis", "one of them")
    value = logical(inputs[0], run)
    begins, ends, strides = (numbers(node, one) for one in inputs[1:4])
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
    rank = len(value.order) - sum(isinstance(one, int) for one in index)

    def sliced(tensor: Tensor) -> Tensor:
        return tensor[tuple(index)]

    return run(Step(sliced, (value,), (plain(rank),)))


def gather(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """GatherV2 without batch axes."""
    if node.integer("batch_dims"):
        raise unsupported(node, "batch_dims", "0", node.integer("batch_dims"))
    values, indices = logical(inputs[0], run), logical(inputs[1], run)
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
        found = tensor.topk(count, dim=-1)
        return found.values, found.indices.to(torch.int32)

    return run(Step(largest, (value,), (value.order,) * 2))


def sparse_to_dense(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """SparseToDense: values at places of an array that is otherwise of one number."""
    indices, values, default = (logical(inputs[i], run) for i in (0, 2, 3))
    shape = numbers(node, inputs[1])

    def dense(places: Tensor, numbers_there: Tensor, other: Tensor) -> Tensor:
        found = other.expand(shape).clone()
        where = tuple(places.reshape(-1, len(shape)).long().unbind(1))
        found[where] = numbers_there.expand(len(places))
        return found

    return run(Step(dense, (indices, values, default), (plain(len(shape)),)))
