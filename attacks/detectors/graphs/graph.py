"""Graphs of operations, and how they are read from TensorFlow.js, TFLite and frozen
graphs of TensorFlow.

The files that are read here are known by their content (`PACKAGED`), so what they say
is not checked again.
"""

import base64
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.detectors.catalogue import DetectorError
from mi_splat.errors import install

_DTYPES = {
    "float32": np.float32,
    "int32": np.int32,
    "bool": np.bool_,
    "float16": np.float16,
}
_TFLITE_DTYPES = {"FLOAT32": np.float32, "FLOAT16": np.float16, "INT32": np.int32}
_ACTIVATIONS = {"NONE": (), "RELU": ("Relu",), "RELU6": ("Relu6",)}
_SETTINGS = {
    "CONV_2D": "Conv2DOptions",
    "DEPTHWISE_CONV_2D": "DepthwiseConv2DOptions",
    "CONCATENATION": "ConcatenationOptions",
}


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One operation of a graph."""

    op: str  # name of the operation in TensorFlow
    inputs: tuple[str, ...] = ()
    """Names of the tensors that it takes: `node`, or `node:1` for the second output of
    a node.
    """
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Its attributes: numbers, strings, truth values, and tuples of them."""


@dataclass(frozen=True, slots=True, eq=False)
class GraphModel:
    """A graph and its constants."""

    nodes: Mapping[str, Node]  # by name, in any order; a placeholder has its `shape`
    constants: Mapping[str, Tensor]  # name of a `Const` node to its value


def read_graph_model(model_json: bytes, weights: bytes) -> GraphModel:
    """A graph model from the two files of TensorFlow.js' converter."""
    document = json.loads(model_json)
    nodes = {
        entry["name"]: Node(
            entry["op"],
            tuple(name for name in entry.get("input", ()) if not name.startswith("^")),
            {name: _plain(value) for name, value in entry.get("attr", {}).items()},
        )
        for entry in document["modelTopology"]["node"]
    }
    return GraphModel(nodes, _constants(document["weightsManifest"], weights))


def _plain(attribute: Mapping[str, Any]) -> Any:
    """The value of an attribute, whose numbers the JSON has as strings, and whose
    strings in base 64.
    """
    if not attribute:
        return None
    kind, value = next(iter(attribute.items()))
    if kind == "list":
        return tuple(
            _plain({of: item}) for of, items in value.items() for item in items
        )
    if kind == "shape":
        return tuple(int(part["size"]) for part in value.get("dim", ()))
    if kind == "s":
        return base64.b64decode(value).decode()
    if kind == "i":
        return int(value)
    return value


def _constants(manifest: list[Any], weights: bytes) -> dict[str, Tensor]:
    """The constants in the order of the manifest; those in half precision as what they
    stand for.
    """
    constants = dict[str, Tensor]()
    at = 0
    for entry in (entry for group in manifest for entry in group["weights"]):
        dtype = np.dtype(_DTYPES[entry.get("quantization", entry)["dtype"]])
        count = math.prod(entry["shape"])
        values = np.frombuffer(weights, dtype, count, at).reshape(entry["shape"])
        if dtype == np.float16:
            values = values.astype(np.float32)
        constants[entry["name"]] = torch.from_numpy(values.copy())
        at += count * dtype.itemsize
    return constants


# A frozen graph is a message of protocol buffers (GraphDef of
# tensorflow/core/framework): fields of a number and a value, which is a number, bytes
# of a fixed length, or bytes with their length before them, as of a message in it.

_FLOATS = 1


def read_frozen(content: bytes, shapes: Mapping[str, tuple[int, ...]]) -> GraphModel:
    """A frozen graph of TensorFlow; nodes whose shapes are given become its inputs, no
    others.
    """
    nodes = dict[str, Node]()
    constants = dict[str, Tensor]()
    for message in parts(content, 1):
        name, op = (bytes(next(parts(message, field))).decode() for field in (1, 2))
        inputs = [bytes(part).decode() for part in parts(message, 3)]
        values = {
            bytes(next(parts(entry, 1))).decode(): next(parts(entry, 2))
            for entry in parts(message, 5)
        }
        if (
            op == "Const"
            and (tensor := _tensor(next(parts(values["value"], 8)))) is not None
        ):
            constants[name] = tensor
        settings = {
            key: value
            for key, part in values.items()
            if (value := _setting(part)) is not None
        }
        if op != "Placeholder":
            nodes[name] = Node(
                op, tuple(of for of in inputs if not of.startswith("^")), settings
            )
    for name, shape in shapes.items():
        nodes[name] = Node("Placeholder", settings={"shape": shape})
    return GraphModel(nodes, constants)


def fields(message: memoryview | bytes) -> Iterator[tuple[int, Any]]:
    """The number and the value of each field of a message of protocol buffers."""
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(message):
        field, kind = divmod(number(), 8)
        if kind == 0:
            yield field, number()
        else:
            length = {1: 8, 5: 4}[kind] if kind != 2 else number()
            yield field, memoryview(message)[at : at + length]
            at += length


def parts(message: memoryview | bytes, wanted: int) -> Iterator[Any]:
    """The values of the fields of one number."""
    return (value for field, value in fields(message) if field == wanted)


def _setting(value: memoryview) -> Any:
    """An attribute: a string, a number, or a list of whole numbers; None for what
    counts nowhere.
    """
    field, content = next(fields(value), (0, b""))
    if field == 2:
        return bytes(content).decode(errors="replace")
    if field == 4:
        return float(np.frombuffer(content, np.float32)[0])
    if field != 1:
        if field in (3, 5):
            return content
        return None
    (packed,) = [*parts(content, 3)] or [b""]
    return tuple(packed)  # small numbers, of a byte each


def _tensor(message: memoryview) -> Tensor | None:
    """A TensorProto of floats: all of them, or one for all places; None for other
    numbers, which no convolution has.
    """
    of = dict(fields(message))
    if of[1] != _FLOATS:
        return None
    shape = [next(parts(axis, 1), 0) for axis in parts(of.get(2, b""), 2)]
    values = np.frombuffer(of.get(4, of.get(5, b"")), np.float32)
    return torch.from_numpy(
        np.broadcast_to(values, math.prod(shape)).reshape(shape).copy()
    )


def read_tflite(content: bytes) -> GraphModel:
    """The graph of a TFLite model, which the schema package `tflite` reads.

    Of its operations those are read that the detector here needs. TensorFlow's have
    filters of other axes: a transposition or another shape of a constant stands before
    them, which is worked out once.
    """
    try:
        import tflite
    except ImportError as error:
        raise DetectorError.of(
            "TFLite model", "the package tflite", "none", install("tflite")
        ) from error
    return _Reader(content, tflite).read()


class _Reader:
    """A graph on its way from one form to the other."""

    def __init__(self, content: bytes, schema: Any) -> None:
        self.schema, self.model = schema, schema.Model.GetRootAsModel(content, 0)
        self.parts = self.model.Subgraphs(0)
        self.tensors = [
            self.parts.Tensors(number) for number in range(self.parts.TensorsLength())
        ]
        self.names = [tensor.Name().decode() for tensor in self.tensors]
        self.shapes = [
            tuple(t.Shape(axis) for axis in range(t.ShapeLength()))
            for t in self.tensors
        ]
        self.nodes: dict[str, Node] = {}
        self.constants: dict[str, Tensor] = {}

    def read(self) -> GraphModel:
        """The graph: constants, inputs and operations."""
        types = {
            getattr(self.schema.TensorType, name): dtype
            for name, dtype in _TFLITE_DTYPES.items()
        }
        for name, shape, tensor in zip(
            self.names, self.shapes, self.tensors, strict=True
        ):
            buffer = self.model.Buffers(tensor.Buffer())
            if buffer.DataLength():
                values = buffer.DataAsNumpy().view(types[tensor.Type()]).reshape(shape)
                self.constant(name, torch.from_numpy(values.copy()))
        for number in range(self.parts.InputsLength()):
            tensor = self.parts.Inputs(number)
            self.nodes[self.names[tensor]] = Node(
                "Placeholder", settings={"shape": self.shapes[tensor]}
            )
        kinds = {
            getattr(self.schema.BuiltinOperator, name): name for name in _OPERATIONS
        }
        for number in range(self.parts.OperatorsLength()):
            operator = self.parts.Operators(number)
            code = self.model.OperatorCodes(operator.OpcodeIndex())
            kind = kinds[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]
            inputs = [operator.Inputs(i) for i in range(operator.InputsLength())]
            _OPERATIONS[kind](
                self, inputs, operator.Outputs(0), self.options(operator, kind)
            )
        return GraphModel(self.nodes, self.constants)

    def options(self, operator: Any, kind: str) -> Any:
        """The settings of an operation; None where this kind has none that count
        here.
        """
        if kind not in _SETTINGS:
            return None
        table = operator.BuiltinOptions()
        options = getattr(self.schema, _SETTINGS[kind])()
        options.Init(table.Bytes, table.Pos)
        return options

    def convolution(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """CONV_2D: its filters are (outputs, height, width, inputs)."""
        self.convolve(
            "_FusedConv2D", inputs, output, options, "Transpose", [1, 2, 3, 0]
        )

    def depthwise(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """DEPTHWISE_CONV_2D: its filters are (1, height, width, inputs *
        multiplier).
        """
        _, high, wide, outputs = self.shapes[inputs[1]]
        channels = self.shapes[inputs[0]][3]
        shape = [high, wide, channels, outputs // channels]
        self.convolve(
            "FusedDepthwiseConv2dNative", inputs, output, options, "Reshape", shape
        )

    def concatenate(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """CONCATENATION."""
        axis = self.listed(f"{self.names[output]}/axis", [options.Axis()])
        self.nodes[self.names[output]] = Node(
            "ConcatV2", (*(self.names[number] for number in inputs), axis)
        )

    def convolve(
        self,
        op: str,
        inputs: Sequence[int],
        output: int,
        options: Any,
        change: str,
        numbers: list[int],
    ) -> None:
        """A convolution whose filters are changed by an operation first."""
        picture, filters, bias = (self.names[number] for number in inputs)
        name = self.names[output]
        self.nodes[f"{name}/filters"] = Node(
            change, (filters, self.listed(f"{name}/axes", numbers))
        )
        activations = {
            getattr(self.schema.ActivationFunctionType, of): words
            for of, words in _ACTIVATIONS.items()
        }
        settings = {
            "strides": (1, options.StrideH(), options.StrideW(), 1),
            "dilations": (1, options.DilationHFactor(), options.DilationWFactor(), 1),
            "padding": {
                self.schema.Padding.SAME: "SAME",
                self.schema.Padding.VALID: "VALID",
            }[options.Padding()],
            "fused_ops": ("BiasAdd", *activations[options.FusedActivationFunction()]),
        }
        self.nodes[name] = Node(op, (picture, f"{name}/filters", bias), settings)

    def plain(
        self,
        inputs: Sequence[int],
        output: int,
        options: Any,
        *,
        op: str,
        **settings: Any,
    ) -> None:
        """An operation that TensorFlow has, too."""
        self.nodes[self.names[output]] = Node(
            op, tuple(self.names[number] for number in inputs), settings
        )

    def listed(self, name: str, numbers: Sequence[int]) -> str:
        """A constant of numbers that the file has as settings; its name."""
        self.constant(name, torch.tensor(numbers, dtype=torch.int32))
        return name

    def constant(self, name: str, value: Tensor) -> None:
        """A node of a known value."""
        self.constants[name] = value
        self.nodes[name] = Node("Const")


_OPERATIONS: Mapping[str, Callable[[_Reader, Sequence[int], int, Any], None]] = {
    "CONV_2D": _Reader.convolution,
    "DEPTHWISE_CONV_2D": _Reader.depthwise,
    "ADD": partial(_Reader.plain, op="AddV2"),
    "RESHAPE": partial(_Reader.plain, op="Reshape"),
    "CONCATENATION": _Reader.concatenate,
    # half precision stands for its numbers
    "DEQUANTIZE": partial(_Reader.plain, op="Cast", DstT="DT_FLOAT"),
}
"""What each operation of TFLite becomes."""
