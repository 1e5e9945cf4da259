"""A small TFLite file with all operations that are read, written by the schema
package.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flatbuffers
import numpy as np
import tflite

from tests.detectors.graphs.test_operations import Array

SHAPES: Mapping[str, tuple[int, ...]] = {
    "picture": (1, 6, 7, 2),
    "half": (1, 3, 3, 4),
    "depth": (1, 3, 3, 4),
    "depth bias": (4,),
    "small": (1, 3, 4, 4),
    "filters": (3, 1, 1, 4),
    "bias": (3,),
    "thin": (1, 3, 4, 3),
    "sum": (1, 3, 4, 3),
    "shape": (3,),
    "rows": (1, 12, 3),
    "all": (1, 24, 3),
}


def tiny() -> bytes:
    """The file."""
    draw = np.random.default_rng(0)
    data: dict[str, Array] = {
        "half": draw.normal(size=(1, 3, 3, 4)).astype(np.float16),
        "depth bias": draw.normal(size=4).astype(np.float32),
        "filters": draw.normal(size=(3, 1, 1, 4)).astype(np.float32),
        "bias": draw.normal(size=3).astype(np.float32),
        "shape": np.array([1, 12, 3], np.int32),
    }
    types = {"half": tflite.TensorType.FLOAT16, "shape": tflite.TensorType.INT32}
    builder = flatbuffers.Builder(0)
    buffers = [_table(builder, "Buffer")]
    buffers += [
        _table(
            builder, "Buffer", Data=builder.CreateNumpyVector(v.view(np.uint8).ravel())
        )
        for v in data.values()
    ]
    tensors = []
    for key, shape in SHAPES.items():
        number = list(data).index(key) + 1 if key in data else 0
        parts = {
            "Name": builder.CreateString(key),
            "Shape": builder.CreateNumpyVector(np.array(shape, np.int32)),
        }
        tensors.append(
            _table(builder, "Tensor", Buffer=number, Type=types.get(key, 0), **parts)
        )
    operators = [
        _operator(builder, 0, [1], [2]),
        _operator(
            builder,
            1,
            [0, 2, 3],
            [4],
            _convolution(builder, "DepthwiseConv2DOptions", 2, DepthMultiplier=2),
        ),
        _operator(
            builder, 2, [4, 5, 6], [7], _convolution(builder, "Conv2DOptions", 1)
        ),
        _operator(builder, 3, [7, 7], [8], _options(builder, "AddOptions")),
        _operator(builder, 4, [8, 9], [10]),
        _operator(
            builder,
            5,
            [10, 10],
            [11],
            _options(builder, "ConcatenationOptions", Axis=1),
        ),
    ]
    known = tflite.BuiltinOperator
    kinds = [known.DEQUANTIZE, known.DEPTHWISE_CONV_2D, known.CONV_2D]
    kinds += [known.ADD, known.RESHAPE, known.CONCATENATION]
    codes = [
        _table(
            builder,
            "OperatorCode",
            DeprecatedBuiltinCode=kind,
            BuiltinCode=kind,
            Version=1 + (kind == known.DEQUANTIZE),
        )
        for kind in kinds
    ]
    graph = _table(
        builder,
        "SubGraph",
        Tensors=_vector(builder, tensors),
        Inputs=builder.CreateNumpyVector(np.array([0], np.int32)),
        Outputs=builder.CreateNumpyVector(np.array([11], np.int32)),
        Operators=_vector(builder, operators),
    )
    vectors = {"OperatorCodes": codes, "Subgraphs": [graph], "Buffers": buffers}
    model = _table(
        builder,
        "Model",
        Version=3,
        **{key: _vector(builder, value) for key, value in vectors.items()},
    )
    builder.Finish(model, file_identifier=b"TFL3")
    return bytes(builder.Output())


def _table(builder: Any, kind: str, **values: Any) -> int:
    """A table of the schema with these fields; its offset."""
    getattr(tflite, f"{kind}Start")(builder)
    for name, value in values.items():
        getattr(tflite, f"{kind}Add{name}")(builder, value)
    end: Callable[[Any], int] = getattr(tflite, f"{kind}End")
    return end(builder)


def _options(builder: Any, kind: str, **values: int) -> tuple[int, int]:
    return getattr(tflite.BuiltinOptions, kind), _table(builder, kind, **values)


def _convolution(
    builder: Any, kind: str, stride: int, **values: int
) -> tuple[int, int]:
    if stride > 1:
        fused = tflite.ActivationFunctionType.RELU6
    else:
        fused = tflite.ActivationFunctionType.NONE
    steps = {
        "StrideH": stride,
        "StrideW": stride,
        "DilationHFactor": 1,
        "DilationWFactor": 1,
    }
    return _options(
        builder,
        kind,
        Padding=tflite.Padding.SAME,
        FusedActivationFunction=fused,
        **steps,
        **values,
    )


def _operator(
    builder: Any,
    number: int,
    inputs: Sequence[int],
    outputs: Sequence[int],
    options: tuple[int, int] = (0, 0),
) -> int:
    lists = {
        "Inputs": builder.CreateNumpyVector(np.array(inputs, np.int32)),
        "Outputs": builder.CreateNumpyVector(np.array(outputs, np.int32)),
    }
    if options[0]:
        more = {"BuiltinOptionsType": options[0], "BuiltinOptions": options[1]}
    else:
        more = {}
    return _table(builder, "Operator", OpcodeIndex=number, **lists, **more)


def _vector(builder: Any, offsets: Sequence[int]) -> int:
    builder.StartVector(4, len(offsets), 4)
    for offset in reversed(offsets):
        builder.PrependUOffsetTRelative(offset)
    end: int = builder.EndVector()
    return end
