"""Each operation of the reader, and its gradient, against its definition."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from attacks.detectors.graphs.detector import GraphNetwork
from attacks.detectors.graphs.graph import GraphModel, Node
from attacks.detectors.graphs.operations import OPERATIONS

Array = NDArray[Any]
RNG = np.random.default_rng(7)
PICTURE, OTHER = RNG.normal(size=(2, 2, 5, 6, 3)).astype(np.float32)
KERNEL = RNG.normal(size=(3, 3, 3, 4)).astype(np.float32)
SMALL = RNG.normal(size=(3, 2, 3, 2)).astype(np.float32)
BIAS = RNG.normal(size=4).astype(np.float32)
BIASES = RNG.normal(size=6).astype(np.float32)
ROW = RNG.normal(size=3).astype(np.float32)


def whole(*values: int) -> Array:
    return np.array(values, np.int32)


def number(value: float, dtype: type = np.float32) -> Array:
    return np.full((), value, dtype)


def padded(
    picture: Array, kernel: tuple[int, int], stride: int, same: bool, value: float
) -> tuple[Array, list[int]]:
    """An image with TensorFlow's padding, and how many rows and columns come out."""
    sizes = []
    pads = []
    for size, reach in zip(picture.shape[1:3], kernel, strict=True):
        if same:
            outputs = math.ceil(size / stride)
        else:
            outputs = math.ceil((size - reach + 1) / stride)
        missing = max((outputs - 1) * stride + reach - size, 0) if same else 0
        sizes.append(outputs)
        pads.append((missing // 2, missing - missing // 2))
    return np.pad(picture, ((0, 0), *pads, (0, 0)), constant_values=value), sizes


def windows(
    picture: Array,
    kernel: tuple[int, int],
    stride: int,
    *,
    same: bool,
    value: float = 0.0,
) -> Array:
    """(B, rows, columns, h, w, C): what each output pixel sees."""
    around, (rows, columns) = padded(picture, kernel, stride, same, value)
    seen = np.lib.stride_tricks.sliding_window_view(around, kernel, axis=(1, 2))[
        :, ::stride, ::stride
    ]
    return seen[:, :rows, :columns].transpose(0, 1, 2, 4, 5, 3)


def convolved(
    picture: Array, kernel: Array, stride: int, *, same: bool, depthwise: bool
) -> Array:
    """Convolution of (B, H, W, C) with (h, w, C, outputs)."""
    seen = windows(picture, (kernel.shape[0], kernel.shape[1]), stride, same=same)
    if not depthwise:
        return np.asarray(np.einsum("byxhwc,hwco->byxo", seen, kernel))
    each = np.asarray(np.einsum("byxhwc,hwcm->byxcm", seen, kernel))
    return each.reshape(*each.shape[:3], -1)


def resized(picture: Array, rows: int, columns: int, *, centres: bool) -> Array:
    """Bilinear interpolation, pixel by pixel."""

    def source(index: int, size: int, wanted: int) -> float:
        if centres:
            return max((index + 0.5) * size / wanted - 0.5, 0.0)
        return index * size / wanted

    result = np.zeros((len(picture), rows, columns, picture.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            y = source(row, picture.shape[1], rows)
            x = source(column, picture.shape[2], columns)
            y0 = int(y)
            x0 = int(x)
            y1 = min(y0 + 1, picture.shape[1] - 1)
            x1 = min(x0 + 1, picture.shape[2] - 1)
            upper = picture[:, y0, x0] * (1 - x + x0) + picture[:, y0, x1] * (x - x0)
            lower = picture[:, y1, x0] * (1 - x + x0) + picture[:, y1, x1] * (x - x0)
            result[:, row, column] = upper * (1 - y + y0) + lower * (y - y0)
    return result


@dataclass(frozen=True)
class Case:
    """An operation on PICTURE and constants, and what must come out; several outputs if
    `outputs` says so.
    """

    op: str
    expected: Callable[[Array], Any]
    constants: tuple[Array, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    outputs: int = 1


def around(stride: int, padding: str, **more: Any) -> dict[str, Any]:
    return {"strides": (1, stride, stride, 1), "padding": padding, **more}


def convolution(stride: int, padding: str, *, depthwise: bool) -> Case:
    op, kernel = ("DepthwiseConv2dNative", SMALL) if depthwise else ("Conv2D", KERNEL)
    settings: dict[str, Any] = {"same": padding == "SAME", "depthwise": depthwise}
    return Case(
        op,
        lambda x: convolved(x, kernel, stride, **settings),
        (kernel,),
        around(stride, padding),
    )


def fused(*names: str, depthwise: bool, activation: Callable[[Array], Array]) -> Case:
    op, kernel, bias = (
        ("FusedDepthwiseConv2dNative", SMALL, BIASES)
        if depthwise
        else ("_FusedConv2D", KERNEL, BIAS)
    )
    settings = around(2, "SAME", fused_ops=("BiasAdd", *names))
    plain = convolution(2, "SAME", depthwise=depthwise).expected
    return Case(op, lambda x: activation(plain(x) + bias), (kernel, bias), settings)


def max_pool(stride: int, padding: str) -> Case:
    settings = around(stride, padding, ksize=(1, 3, 3, 1))
    same = padding == "SAME"
    return Case(
        "MaxPool",
        lambda x: windows(x, (3, 3), stride, same=same, value=-np.inf).max((3, 4)),
        (),
        settings,
    )


def resize(rows: int, columns: int, *, centres: bool) -> Case:
    size = whole(rows, columns)
    settings = {"half_pixel_centers": centres}
    return Case(
        "ResizeBilinear",
        lambda x: resized(x, rows, columns, centres=centres),
        (size,),
        settings,
    )


CASES = [
    *(
        convolution(s, p, depthwise=d)
        for s in (1, 2)
        for p in ("SAME", "VALID")
        for d in (False, True)
    ),
    fused(depthwise=False, activation=lambda y: y),
    fused("Relu", depthwise=True, activation=lambda y: np.maximum(y, 0)),
    fused("Relu6", depthwise=False, activation=lambda y: np.clip(y, 0, 6)),
    *(max_pool(s, p) for s in (1, 2) for p in ("SAME", "VALID")),
    *(
        resize(*size, centres=centres)
        for size in ((10, 12), (3, 4))
        for centres in (False, True)
    ),
    Case("Add", lambda x: x + ROW, (ROW,)),
    Case("BiasAdd", lambda x: x + ROW, (ROW,)),
    Case("AddV2", lambda x: x + OTHER, (OTHER,)),
    Case("Mul", lambda x: x * np.float32(3), (number(3),)),
    Case("Mul", lambda x: x * OTHER[:, :1, :1], (OTHER[:, :1, :1],)),
    Case("Relu", lambda x: np.maximum(x, 0)),
    Case("Relu6", lambda x: np.clip(x, 0, 6)),
    Case("LeakyRelu", lambda x: np.where(x > 0, x, 0.1 * x), settings={"alpha": 0.1}),
    Case("Sigmoid", lambda x: 1 / (1 + np.exp(-x))),
    Case("Identity", lambda x: x),
    Case("Cast", lambda x: np.trunc(x).astype(np.int32), settings={"DstT": "DT_INT32"}),
    Case("Transpose", lambda x: x.transpose(3, 0, 2, 1), (whole(3, 0, 2, 1),)),
    Case(
        "Mean",
        lambda x: x.mean((1, 2), keepdims=True),
        (whole(1, 2),),
        {"keep_dims": True},
    ),
    Case("Mean", lambda x: x.mean((1, -1)), (whole(1, -1),)),
    Case(
        "ConcatV2",
        lambda x: np.concatenate([x, OTHER], -1),
        (OTHER, number(-1, np.int32)),
    ),
    Case(
        "ConcatV2",
        lambda x: np.concatenate([x, OTHER], 1),
        (OTHER, number(1, np.int32)),
    ),
    Case(
        "Pad",
        lambda x: np.pad(x, ((0, 0), (1, 2), (0, 3), (0, 1))),
        (whole(0, 0, 1, 2, 0, 3, 0, 1).reshape(4, 2),),
    ),
    Case(
        "PadV2",
        lambda x: np.pad(x, ((1, 0), (1, 2), (0, 3), (0, 0)), constant_values=-5),
        (whole(1, 0, 1, 2, 0, 3, 0, 0).reshape(4, 2), number(-5)),
    ),
    Case(
        "SplitV",
        lambda x: (x[:, :2], x[:, 2:]),
        (whole(2, -1), number(1, np.int32)),
        outputs=2,
    ),
    Case(
        "SplitV",
        lambda x: (x[..., :1], x[..., 1:]),
        (whole(1, 2), number(-1, np.int32)),
        outputs=2,
    ),
    Case("Reshape", lambda x: x.reshape(2, 30, 3), (whole(2, -1, 3),)),
]


def build(case: Case) -> GraphNetwork:
    """The case as a graph."""
    constants = {
        f"c{i}": torch.from_numpy(np.array(value))
        for i, value in enumerate(case.constants)
    }
    nodes = {name: Node("Const") for name in constants}
    nodes["x"] = Node("Placeholder", settings={"shape": PICTURE.shape})
    nodes["y"] = Node(case.op, ("x", *constants), case.settings)
    return GraphNetwork(
        GraphModel(nodes, constants),
        [f"y:{i}" if i else "y" for i in range(case.outputs)],
    )


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.op)
def test_operation_is_what_its_definition_says(case: Case) -> None:
    wanted = case.expected(PICTURE)
    computed = build(case)(torch.from_numpy(PICTURE))
    for one, other in zip(
        computed, wanted if isinstance(wanted, tuple) else (wanted,), strict=True
    ):
        assert tuple(one.shape) == other.shape
        np.testing.assert_allclose(one.numpy(), other, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize(
    "case", [case for case in CASES if case.op != "Cast"], ids=lambda case: case.op
)
def test_gradient_is_that_of_the_definition(case: Case) -> None:
    """The change along a random direction, by central differences of the definition in
    float64.
    """
    picture = torch.tensor(PICTURE, requires_grad=True)
    results = build(case)(picture)
    weights = [torch.randn(tuple(result.shape)) for result in results]
    total = torch.stack(
        [(a * b).sum() for a, b in zip(results, weights, strict=True)]
    ).sum()
    (gradient,) = torch.autograd.grad(total, picture)
    direction = np.random.default_rng(1).normal(size=PICTURE.shape)

    def value(step: float) -> float:
        values = case.expected(PICTURE.astype(np.float64) + step * direction)
        values = values if isinstance(values, tuple) else (values,)
        return float(
            sum((a * b.numpy()).sum() for a, b in zip(values, weights, strict=True))
        )

    analytic = float((gradient.numpy() * direction).sum())
    assert analytic == pytest.approx(
        (value(1e-6) - value(-1e-6)) / 2e-6, rel=2e-3, abs=2e-3
    )


def test_every_operation_has_a_case() -> None:
    elsewhere = {"SparseToDense", "FusedBatchNorm"}  # test_network.py, test_frozen.py
    assert {case.op for case in CASES} | elsewhere == set(OPERATIONS)
