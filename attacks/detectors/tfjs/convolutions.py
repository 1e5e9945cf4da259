"""Operations on pictures: convolutions, pooling and resizing, channels first.

What each does is defined by TensorFlow: padding SAME keeps ceil(size / stride) outputs and puts the odd row or column
of padding at the end; a depthwise filter is (height, width, channels, multiplier).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from attacks.detectors.errors import DetectorError
from attacks.detectors.tfjs.files import Node
from attacks.detectors.tfjs.layout import Run, channels_first
from attacks.detectors.tfjs.values import CHANNELS_FIRST, Step, Value
from mi_splat.errors import message

Padding = tuple[int, int, int, int]
"""Pixels left, right, above and below, in the order of `torch.nn.functional.pad`."""


def same_padding(size: int, kernel: int, stride: int, dilation: int) -> tuple[int, int]:
    """Pixels before and after one side of a picture, so that ceil(size / stride) outputs come out.

    Args:
        size: Pixels along the side.
        kernel: Of the filter.
        stride: Pixels from one output to the next.
        dilation: Pixels from one of the filter's to the next.
    """
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


def unsupported(node: Node, what: str, expected: str, got: object) -> DetectorError:
    """The error for a setting of an operation that this reader does not know.

    Args:
        node: The operation.
        what: The setting.
        expected: What is known.
        got: What the file has.
    """
    name = f"{what} of {node.op} {node.name}"
    return DetectorError(message(name, expected, got, "use a model without it"))


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
    found = functional.conv2d(_pad(picture, uneven), kernel, bias, padding=around, **settings)
    return found if activation is None else activation(found)


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

    def pool(tensor: Tensor) -> Tensor:
        return functional.max_pool2d(_pad(tensor, padding, -math.inf), size, stride)

    return run(Step(pool, (picture,), (CHANNELS_FIRST,)))


def resize_bilinear(node: Node, inputs: list[Value], run: Run) -> tuple[Value, ...]:
    """ResizeBilinear in its three forms: pixel centres, aligned corners, and the old one that aligns first pixels."""
    picture = channels_first(inputs[0], run)
    if not inputs[1].constant:
        raise unsupported(node, "size", "a constant", "a computed one")
    rows, columns = (int(size) for size in inputs[1].logical.tolist())
    settings = {"corners": node.flag("align_corners"), "centres": node.flag("half_pixel_centers")}
    down = Value(interpolation(picture.shape[1], rows, **settings), (0, 1))
    across = Value(interpolation(picture.shape[2], columns, **settings), (0, 1))

    def resize(tensor: Tensor, vertical: Tensor, horizontal: Tensor) -> Tensor:
        return vertical @ tensor @ horizontal.mT

    return run(Step(resize, (picture, down, across), (CHANNELS_FIRST,)))


def interpolation(size: int, wanted: int, *, corners: bool, centres: bool) -> Tensor:
    """(wanted, size) weights of linear interpolation along one side.

    Args:
        size: Pixels that there are.
        wanted: Pixels that shall be.
        corners: First and last pixel stay where they are.
        centres: Positions are those of pixel centres; otherwise of their first corners.
    """
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
