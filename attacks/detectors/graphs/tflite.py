"""The file form of a TFLite model, turned into that in which this project keeps a graph: nodes as JSON, and constants.

The schema package `tflite` reads the file; what it says is checked before anything of that size is made. Of TFLite's
operations those are known that the detector here needs. They become TensorFlow's, whose filters have other axes: a
transposition or another shape of a constant stands before them, which is worked out once.
"""

import base64
import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.detectors.catalogue import DetectorError
from attacks.detectors.graphs.files import MOST_AXES, MOST_ELEMENTS
from attacks.detectors.weights import check_finite
from mi_splat.errors import install

_DTYPES = {"FLOAT32": np.float32, "FLOAT16": np.float16, "INT32": np.int32}
_MOST = 1 << 14
"""Most tensors and operations that a graph may have, and inputs that an operation may."""
_ACTIVATIONS = {"NONE": [], "RELU": ["Relu"], "RELU6": ["Relu6"]}
_UNREADABLE = (struct.error, ArithmeticError, LookupError, TypeError, ValueError, AttributeError)
"""What the schema package raises where an offset leads out of the file, or a part of it is missing."""
_Nodes = list[dict[str, Any]]


def read_tflite(content: bytes) -> tuple[bytes, dict[str, Tensor]]:
    """The nodes of a TFLite model in the form of `files.topology`, and its constants by name."""
    try:
        import tflite
    except ImportError as error:
        raise DetectorError.of("TFLite model", "the package tflite", "none", install("tflite")) from error

    if content[4:8] != b"TFL3":
        raise _wrong("a TFLite model, with TFL3 at its fifth byte", repr(content[4:8]))
    try:
        graph = _Graph(content, tflite)
        for number in range(_count(graph.parts.OperatorsLength(), "operations")):
            graph.add(graph.parts.Operators(number))
        return graph.written()
    except _UNREADABLE as error:
        raise _wrong("a whole TFLite model", " ".join(str(error).split())[:120] or type(error).__name__) from error


class _Graph:
    """A graph on its way from one form to the other."""

    def __init__(self, content: bytes, schema: Any) -> None:
        self.schema, self.model = schema, schema.Model.GetRootAsModel(content, 0)
        if self.model.SubgraphsLength() != 1:
            raise _wrong("one graph", self.model.SubgraphsLength())
        self.parts = self.model.Subgraphs(0)
        self.nodes: _Nodes = []
        self.constants: dict[str, Tensor] = {}
        self._left = MOST_ELEMENTS
        self._types = {getattr(schema.TensorType, name): name for name in _DTYPES}
        tensors = [self.parts.Tensors(i) for i in range(_count(self.parts.TensorsLength(), "tensors"))]
        self.names = [tensor.Name().decode() for tensor in tensors]
        self.shapes = [self._shape(tensor) for tensor in tensors]
        for name, shape, tensor in zip(self.names, self.shapes, tensors, strict=True):
            self._add_constant(name, shape, tensor)
        for number in self._numbers(self.parts.InputsLength(), self.parts.Inputs):
            dimensions = [{"size": str(size)} for size in self.shapes[number]]
            self._node(self.names[number], "Placeholder", [], shape={"shape": {"dim": dimensions}})

    def add(self, operator: Any) -> None:
        """One operation."""
        code = self.model.OperatorCodes(_count(operator.OpcodeIndex(), "kinds of operations"))
        kind = max(code.BuiltinCode(), code.DeprecatedBuiltinCode())
        known = {getattr(self.schema.BuiltinOperator, name): (name, build) for name, build in _OPERATIONS.items()}
        if kind not in known:
            raise _wrong(f"operations among {', '.join(_OPERATIONS)}", f"number {kind}")
        name, build = known[kind]
        inputs = self._numbers(operator.InputsLength(), operator.Inputs)
        (output,) = self._numbers(operator.OutputsLength(), operator.Outputs)
        build(self, inputs, output, self._options(operator, name))

    def written(self) -> tuple[bytes, dict[str, Tensor]]:
        """What `read_tflite` returns."""
        outputs = [self.names[number] for number in self._numbers(self.parts.OutputsLength(), self.parts.Outputs)]
        document = {
            "modelTopology": {"node": self.nodes},
            "signature": {"outputs": {name: {"name": name} for name in outputs}},
        }
        check_finite(self.constants, "TFLite model")
        return json.dumps(document, separators=(",", ":")).encode(), self.constants

    def convolution(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """CONV_2D: its filters are (outputs, height, width, inputs)."""
        self._convolve("_FusedConv2D", inputs, output, options, "Transpose", [1, 2, 3, 0])

    def depthwise(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """DEPTHWISE_CONV_2D: its filters are (1, height, width, inputs * multiplier)."""
        batch, high, wide, outputs = self.shapes[inputs[1]]
        channels = self.shapes[inputs[0]][3]
        if batch != 1 or channels < 1 or outputs % channels:
            raise _wrong(f"filters (1, height, width, a multiple of {channels})", self.shapes[inputs[1]])
        shape = [high, wide, channels, outputs // channels]
        self._convolve("FusedDepthwiseConv2dNative", inputs, output, options, "Reshape", shape)

    def add_up(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """ADD."""
        self._unfused("ADD", options)
        self._node(self.names[output], "AddV2", [self.names[number] for number in inputs])

    def reshape(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """RESHAPE to a shape that is its second input."""
        if len(inputs) != 2:
            raise _wrong("RESHAPE with its shape as an input", f"{len(inputs)} inputs")
        self._node(self.names[output], "Reshape", [self.names[number] for number in inputs])

    def concatenate(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """CONCATENATION."""
        self._unfused("CONCATENATION", options)
        axis = self._listed(f"{self.names[output]}/axis", [options.Axis()])
        self._node(self.names[output], "ConcatV2", [*(self.names[number] for number in inputs), axis])

    def dequantize(self, inputs: Sequence[int], output: int, options: Any) -> None:
        """DEQUANTIZE of numbers in half precision: they are what they stand for."""
        (number,) = inputs
        constant = self.constants.get(self.names[number])
        if constant is None or constant.dtype != torch.float16:
            raise _wrong("DEQUANTIZE of constants in half precision", f"{self.names[number]:.60}")
        self._node(self.names[output], "Cast", [self.names[number]], DstT={"type": "DT_FLOAT"})

    def _convolve(
        self, op: str, inputs: Sequence[int], output: int, options: Any, change: str, numbers: list[int]
    ) -> None:
        picture, filters, bias = (self.names[number] for number in inputs)
        name = self.names[output]
        self._node(f"{name}/filters", change, [filters, self._listed(f"{name}/axes", numbers)])
        padding = {self.schema.Padding.SAME: "SAME", self.schema.Padding.VALID: "VALID"}[options.Padding()]
        steps = [1, options.StrideH(), options.StrideW(), 1]
        dilations = [1, options.DilationHFactor(), options.DilationWFactor(), 1]
        self._node(
            name,
            op,
            [picture, f"{name}/filters", bias],
            strides={"list": {"i": steps}},
            dilations={"list": {"i": dilations}},
            padding={"s": _base64(padding)},
            fused_ops={"list": {"s": [_base64(word) for word in ("BiasAdd", *self._activation(options))]}},
        )

    def _activation(self, options: Any) -> list[str]:
        known = {getattr(self.schema.ActivationFunctionType, name): name for name in _ACTIVATIONS}
        number = options.FusedActivationFunction()
        if number not in known:
            raise _wrong(f"an activation among {', '.join(_ACTIVATIONS)}", f"number {number}")
        return _ACTIVATIONS[known[number]]

    def _unfused(self, name: str, options: Any) -> None:
        if self._activation(options):
            raise _wrong(f"{name} without an activation", *self._activation(options))

    def _options(self, operator: Any, name: str) -> Any:
        """The settings of an operation; None where this kind has none that count here."""
        if name not in _SETTINGS:
            return None
        table, options = operator.BuiltinOptions(), getattr(self.schema, _SETTINGS[name])()
        if operator.BuiltinOptionsType() != getattr(self.schema.BuiltinOptions, _SETTINGS[name]) or table is None:
            raise _wrong(f"{_SETTINGS[name]} of {name}", "others")
        options.Init(table.Bytes, table.Pos)
        return options

    def _add_constant(self, name: str, shape: tuple[int, ...], tensor: Any) -> None:
        """Note the tensor's numbers, if the file has them, once they are known to be as many as its shape says."""
        kind = self._types.get(tensor.Type(), "")
        quantisation = tensor.Quantization()
        if not kind or tensor.Sparsity() is not None or (quantisation is not None and quantisation.ScaleLength()):
            raise _wrong(f"plain tensors of {', '.join(_DTYPES)}", f"another, {name:.60}")
        if not 0 <= tensor.Buffer() < self.model.BuffersLength():
            raise _wrong(f"one of {self.model.BuffersLength()} buffers", tensor.Buffer())
        buffer = self.model.Buffers(tensor.Buffer())
        held = buffer.DataLength()
        if not held:
            return
        dtype, count = np.dtype(_DTYPES[kind]), math.prod(shape)
        if held != count * dtype.itemsize:
            raise _wrong(f"{count * dtype.itemsize} bytes of {name:.60}, as its shape says", held)
        self._left -= count
        if self._left < 0:
            raise _wrong(f"at most {MOST_ELEMENTS:,} numbers in all constants", "more")
        values = buffer.DataAsNumpy()  # a view, which raises where it would end outside the file
        self._constant(name, torch.from_numpy(values.view(dtype).reshape(shape).copy()))

    def _shape(self, tensor: Any) -> tuple[int, ...]:
        axes = tensor.ShapeLength()
        if axes > MOST_AXES:
            raise _wrong(f"tensors of at most {MOST_AXES} axes", axes)
        shape = tuple(tensor.Shape(axis) for axis in range(axes))
        if min(shape, default=0) < 0 or math.prod(shape) > MOST_ELEMENTS:
            raise _wrong(f"tensors of at most {MOST_ELEMENTS:,} numbers", f"the shape {shape}")
        return shape

    def _numbers(self, length: int, at: Callable[[int], int]) -> list[int]:
        """Numbers of tensors, each of which is there."""
        numbers = [at(i) for i in range(_count(length, "inputs or outputs"))]
        if not all(0 <= number < len(self.names) for number in numbers):
            raise _wrong(f"tensors among {len(self.names)}", numbers[:8])
        return numbers

    def _listed(self, name: str, numbers: Sequence[int]) -> str:
        """A constant of numbers that the file has as settings; its name."""
        self._constant(name, torch.tensor(numbers, dtype=torch.int32))
        return name

    def _constant(self, name: str, value: Tensor) -> None:
        if name in self.constants:
            raise _wrong("tensors of different names", f"two called {name:.60}")
        self.constants[name] = value
        self._node(name, "Const", [])

    def _node(self, name: str, op: str, inputs: Sequence[str], **attributes: Mapping[str, Any]) -> None:
        self.nodes.append({"name": name, "op": op, "input": list(inputs), "attr": attributes})


_OPERATIONS: Mapping[str, Callable[[_Graph, Sequence[int], int, Any], None]] = {
    "CONV_2D": _Graph.convolution,
    "DEPTHWISE_CONV_2D": _Graph.depthwise,
    "ADD": _Graph.add_up,
    "RESHAPE": _Graph.reshape,
    "CONCATENATION": _Graph.concatenate,
    "DEQUANTIZE": _Graph.dequantize,
}
"""What each operation of TFLite becomes."""
_SETTINGS = {
    "CONV_2D": "Conv2DOptions",
    "DEPTHWISE_CONV_2D": "DepthwiseConv2DOptions",
    "ADD": "AddOptions",
    "CONCATENATION": "ConcatenationOptions",
}


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _count(number: int, what: str) -> int:
    if number > _MOST:
        raise _wrong(f"at most {_MOST:,} {what}", f"{number:,}")
    return number


def _wrong(expected: str, got: object) -> DetectorError:
    return DetectorError.of("TFLite model", expected, got, "get the file again, or report it")
