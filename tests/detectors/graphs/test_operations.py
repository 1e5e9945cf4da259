"""Each operation of the reader against its definition, with tensors kept as the graph has them and otherwise."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from attacks.detectors.graphs.network import GraphNetwork
from attacks.detectors.graphs.operations import OPERATIONS
from tests.detectors.graphs.graphs import (
    Array,
    convolved,
    ints,
    model,
    node,
    placeholder,
    pooled,
    resized,
    string,
    strings,
)

RNG = np.random.default_rng(7)
PICTURE = RNG.normal(size=(2, 5, 6, 3)).astype(np.float32)
KERNEL = RNG.normal(size=(3, 3, 3, 4)).astype(np.float32)
SMALL = RNG.normal(size=(3, 2, 3, 2)).astype(np.float32)
BIAS = RNG.normal(size=4).astype(np.float32)
BIASES = RNG.normal(size=6).astype(np.float32)
ROW = RNG.normal(size=3).astype(np.float32)
OTHER = RNG.normal(size=(2, 5, 6, 3)).astype(np.float32)


def whole(*values: int) -> Array:
    return np.array(values, np.int32)


def number(value: float) -> Array:
    return np.full((), value, np.float32)


@dataclass(frozen=True)
class Case:
    """An operation on PICTURE and constants, and what must come out; several outputs if `outputs` says so."""

    op: str
    expected: Callable[[Array], Any]
    constants: tuple[Array, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    first: bool = True
    outputs: int = 1


def picture_case(stride: int, dilation: int, padding: str, **more: Any) -> dict[str, Any]:
    return {
        "strides": ints(1, stride, stride, 1),
        "dilations": ints(1, dilation, dilation, 1),
        "padding": string(padding),
        "data_format": string("NHWC"),
        **more,
    }


def convolution(stride: int, dilation: int, padding: str) -> Case:
    def expected(x: Array) -> Array:
        return convolved(x, KERNEL, stride, dilation, same=padding == "SAME", depthwise=False)

    return Case("Conv2D", expected, (KERNEL,), picture_case(stride, dilation, padding))


def depthwise(stride: int, dilation: int, padding: str) -> Case:
    def expected(x: Array) -> Array:
        return convolved(x, SMALL, stride, dilation, same=padding == "SAME", depthwise=True)

    return Case("DepthwiseConv2dNative", expected, (SMALL,), picture_case(stride, dilation, padding))


def max_pool(stride: int, padding: str) -> Case:
    def expected(x: Array) -> Array:
        return pooled(x, 3, stride, same=padding == "SAME")

    return Case("MaxPool", expected, (), {**picture_case(stride, 1, padding), "ksize": ints(1, 3, 3, 1)})


def fused(*names: str, activation: Callable[[Array], Array]) -> Case:
    def expected(x: Array) -> Array:
        return activation(convolved(x, KERNEL, 2, 1, same=True, depthwise=False) + BIAS)

    attributes = picture_case(2, 1, "SAME", fused_ops=strings(*names), leakyrelu_alpha={"f": 0.3})
    return Case("_FusedConv2D", expected, (KERNEL, BIAS), attributes)


def resize(rows: int, columns: int, *, corners: bool, centres: bool) -> Case:
    def expected(x: Array) -> Array:
        return resized(x, rows, columns, corners=corners, centres=centres)

    attributes = {"align_corners": {"b": corners}, "half_pixel_centers": {"b": centres}}
    return Case("ResizeBilinear", expected, (whole(rows, columns),), attributes)


def sliced(begin: tuple[int, ...], end: tuple[int, ...], step: tuple[int, ...], **masks: int) -> dict[str, Any]:
    return {
        "constants": (whole(*begin), whole(*end), whole(*step)),
        "attributes": {k: {"i": str(v)} for k, v in masks.items()},
    }


CASES = [
    *(convolution(s, d, p) for s, d in ((1, 1), (2, 1), (1, 2)) for p in ("SAME", "VALID")),
    *(depthwise(s, d, p) for s, d in ((1, 1), (2, 1), (1, 2)) for p in ("SAME", "VALID")),
    fused("BiasAdd", activation=lambda y: y),
    fused("BiasAdd", "Relu", activation=lambda y: np.maximum(y, 0)),
    fused("BiasAdd", "Relu6", activation=lambda y: np.clip(y, 0, 6)),
    fused("BiasAdd", "Elu", activation=lambda y: np.where(y > 0, y, np.expm1(y))),
    fused("BiasAdd", "Sigmoid", activation=lambda y: 1 / (1 + np.exp(-y))),
    fused("BiasAdd", "LeakyRelu", activation=lambda y: np.where(y > 0, y, 0.3 * y)),
    Case(
        "FusedDepthwiseConv2dNative",
        lambda x: np.maximum(convolved(x, SMALL, 2, 1, same=True, depthwise=True) + BIASES, 0),
        (SMALL, BIASES),
        picture_case(2, 1, "SAME", fused_ops=strings("BiasAdd", "Relu")),
    ),
    *(max_pool(s, p) for s in (1, 2) for p in ("SAME", "VALID")),
    resize(10, 12, corners=False, centres=False),
    resize(10, 12, corners=False, centres=True),
    resize(9, 11, corners=True, centres=False),
    resize(3, 4, corners=False, centres=True),
    resize(3, 4, corners=False, centres=False),
    Case("Add", lambda x: x + ROW, (ROW,)),
    Case("AddV2", lambda x: ROW + x, (ROW,), first=False),
    Case("Add", lambda x: x + OTHER, (OTHER,)),
    Case("Sub", lambda x: OTHER - x, (OTHER,), first=False),
    Case("Mul", lambda x: x * np.float32(3), (number(3),)),
    Case("Mul", lambda x: x * OTHER[:, :1, :1], (OTHER[:, :1, :1],)),
    Case("Equal", lambda x: x == PICTURE[:, :, :, 1:2], (PICTURE[:, :, :, 1:2],)),
    Case("FloorDiv", lambda x: np.floor(x / np.float32(0.3)), (number(0.3),)),
    Case("FloorMod", lambda x: x - 2 * np.floor(x / 2), (number(2),)),
    Case("Relu", lambda x: np.maximum(x, 0)),
    Case("Relu6", lambda x: np.clip(x, 0, 6)),
    Case("LeakyRelu", lambda x: np.where(x > 0, x, 0.1 * x), attributes={"alpha": {"f": 0.1}}),
    Case("Sigmoid", lambda x: 1 / (1 + np.exp(-x))),
    Case("Identity", lambda x: x),
    Case("Cast", lambda x: np.trunc(x).astype(np.int32), attributes={"DstT": {"type": "DT_INT32"}}),
    Case("Transpose", lambda x: x.transpose(3, 0, 2, 1), (whole(3, 0, 2, 1),)),
    Case("Mean", lambda x: x.mean((1, 2), keepdims=True), (whole(1, 2),), {"keep_dims": {"b": True}}),
    Case("Mean", lambda x: x.mean((1, -1)), (whole(1, -1),)),
    Case("ConcatV2", lambda x: np.concatenate([x, OTHER], 3), (OTHER, np.array(-1, np.int32))),
    Case("ConcatV2", lambda x: np.concatenate([x, OTHER], 1), (OTHER, np.array(1, np.int32))),
    Case("Pad", lambda x: np.pad(x, ((0, 0), (1, 2), (0, 3), (0, 1))), (whole(0, 0, 1, 2, 0, 3, 0, 1).reshape(4, 2),)),
    Case(
        "PadV2",
        lambda x: np.pad(x, ((1, 0), (1, 2), (0, 3), (0, 0)), constant_values=-5),
        (whole(1, 0, 1, 2, 0, 3, 0, 0).reshape(4, 2), np.array(-5, np.float32)),
    ),
    Case("SplitV", lambda x: (x[:, :2], x[:, 2:]), (whole(2, -1), np.array(1, np.int32)), outputs=2),
    Case("SplitV", lambda x: (x[..., :1], x[..., 1:]), (whole(1, 2), np.array(-1, np.int32)), outputs=2),
    Case("Reshape", lambda x: x.reshape(2, 30, 3), (whole(2, -1, 3),)),
    Case("ExpandDims", lambda x: x[:, :, None], (np.array(2, np.int32),)),
    Case("ExpandDims", lambda x: x[..., None], (np.array(-1, np.int32),)),
    Case(
        "StridedSlice", lambda x: x[:, 1:5:2, :4], **sliced((7, 1, 0), (7, 5, 4), (1, 2, 1), begin_mask=1, end_mask=1)
    ),
    Case(
        "StridedSlice",
        lambda x: x[:, 2, :, -1],
        **sliced((0, 2, 0, -1), (0, 3, 6, 0), (1, 1, 1, 1), begin_mask=1, end_mask=1, shrink_axis_mask=10),
    ),
    Case("GatherV2", lambda x: x[:, [[4, 0], [1, 1]]], (whole(4, 0, 1, 1).reshape(2, 2), np.array(1, np.int32))),
    Case(
        "TopKV2",
        lambda x: (-np.sort(-x, -1)[..., :2], np.argsort(-x, -1)[..., :2]),
        (np.array(2, np.int32),),
        outputs=2,
    ),
]


def build(case: Case, *, moved: bool) -> tuple[GraphNetwork, torch.Tensor]:
    """The case as a graph; if `moved`, its input comes channels first and is transposed, so it is kept otherwise."""
    constants = {f"c{i}": value for i, value in enumerate(case.constants)}
    shape = PICTURE.transpose(0, 3, 1, 2).shape if moved else PICTURE.shape
    nodes = [placeholder("x", shape)]
    source = "x"
    if moved:
        constants["perm"] = whole(0, 2, 3, 1)
        nodes.append(node("turned", "Transpose", ["x", "perm"]))
        source = "turned"
    names = list(constants)[: len(case.constants)]
    inputs = [source, *names] if case.first else [*names, source]
    nodes.append(node("y", case.op, inputs, **case.attributes))
    outputs = ["y"] if case.outputs == 1 else [f"y:{i}" if i else "y" for i in range(case.outputs)]
    picture = torch.from_numpy(PICTURE)
    return GraphNetwork(model(nodes, constants, outputs)), picture.permute(0, 3, 1, 2) if moved else picture


@pytest.mark.parametrize("moved", [False, True], ids=["channels-last", "moved"])
@pytest.mark.parametrize("number", range(len(CASES)), ids=[f"{i}-{case.op}" for i, case in enumerate(CASES)])
def test_operation_is_what_its_definition_says(number: int, moved: bool) -> None:
    case = CASES[number]
    network, picture = build(case, moved=moved)
    wanted = case.expected(PICTURE)
    wanted = wanted if isinstance(wanted, tuple) else (wanted,)
    computed = network(picture)
    assert len(computed) == len(wanted)
    for one, other in zip(computed, wanted, strict=True):
        assert tuple(one.shape) == other.shape
        np.testing.assert_allclose(one.numpy(), other, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("number", range(len(CASES)), ids=[f"{i}-{case.op}" for i, case in enumerate(CASES)])
def test_gradient_is_that_of_the_definition(number: int) -> None:
    """The change along a random direction, by central differences of the definition in float64."""
    case = CASES[number]
    if case.op in ("Equal", "FloorDiv", "Cast"):
        return
    network, picture = build(case, moved=True)
    picture = picture.clone().requires_grad_(True)
    weights = [torch.randn(tuple(one.shape)) for one in network(picture)]
    kept = [i for i, one in enumerate(network(picture)) if one.is_floating_point()]
    torch.stack([(network(picture)[i] * weights[i]).sum() for i in kept]).sum().backward()  # type: ignore[no-untyped-call]
    assert picture.grad is not None
    direction = np.random.default_rng(1).normal(size=PICTURE.shape)

    def value(step: float) -> float:
        values = case.expected(PICTURE.astype(np.float64) + step * direction)
        values = values if isinstance(values, tuple) else (values,)
        return float(sum((values[i] * weights[i].numpy()).sum() for i in kept))

    slope = (value(1e-6) - value(-1e-6)) / 2e-6
    analytic = float((picture.grad.permute(0, 2, 3, 1).numpy() * direction).sum())
    assert analytic == pytest.approx(slope, rel=2e-3, abs=2e-3)


def test_every_operation_has_a_case() -> None:
    tested = {case.op for case in CASES} | {"SparseToDense"}  # of constants alone: see test_network.py
    assert tested == set(OPERATIONS)
