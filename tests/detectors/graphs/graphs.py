"""Small graph models, written as TensorFlow.js writes them, and TensorFlow's definitions as loops over numbers."""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.detectors.graphs.files import GraphModel, read_graph_model

Array = NDArray[Any]


def strings(*values: str) -> dict[str, Any]:
    """A list of strings as an attribute."""
    return {"list": {"s": [base64.b64encode(value.encode()).decode() for value in values]}}


def string(value: str) -> dict[str, Any]:
    """A string as an attribute."""
    return {"s": base64.b64encode(value.encode()).decode()}


def ints(*values: int) -> dict[str, Any]:
    """A list of numbers as an attribute; the JSON has them as strings."""
    return {"list": {"i": [str(value) for value in values]}}


def node(name: str, op: str, inputs: Sequence[str] = (), **attributes: Any) -> dict[str, Any]:
    """A node of a graph."""
    return {"name": name, "op": op, "input": list(inputs), "attr": attributes}


def placeholder(name: str, shape: Sequence[int]) -> dict[str, Any]:
    """An input of a graph."""
    return node(name, "Placeholder", shape={"shape": {"dim": [{"size": str(size)} for size in shape]}})


def files(
    nodes: Sequence[dict[str, Any]], constants: Mapping[str, Array], outputs: Sequence[str]
) -> tuple[bytes, bytes]:
    """The two files of a model."""
    manifest = [{"name": k, "shape": list(v.shape), "dtype": str(v.dtype)} for k, v in constants.items()]
    document = {
        "format": "graph-model",
        "signature": {"outputs": {name: {"name": name} for name in outputs}},
        "modelTopology": {"node": [*(node(name, "Const") for name in constants), *nodes]},
        "weightsManifest": [{"paths": ["x.bin"], "weights": manifest}],
    }
    return json.dumps(document).encode(), b"".join(np.ascontiguousarray(v).tobytes() for v in constants.values())


def model(nodes: Sequence[dict[str, Any]], constants: Mapping[str, Array], outputs: Sequence[str]) -> GraphModel:
    """A model as it is read."""
    return read_graph_model(*files(nodes, constants, outputs))


def convolved(picture: Array, kernel: Array, stride: int, dilation: int, *, same: bool, depthwise: bool) -> Array:
    """Convolution of (B, H, W, C) with (h, w, C, outputs), each output pixel a sum."""
    high, wide, channels, last = kernel.shape
    padded, rows, columns = _padded(picture, (high, wide), stride, dilation, same=same, value=0.0)
    outputs = channels * last if depthwise else last
    result = np.zeros((len(picture), rows, columns, outputs))
    for row in range(rows):
        for column in range(columns):
            at = padded[:, row * stride :, column * stride :][:, : high * dilation, : wide * dilation]
            window = at[:, ::dilation, ::dilation][:, :high, :wide]
            if depthwise:
                each = (window[..., None] * kernel).sum((1, 2))
                result[:, row, column] = each.reshape(len(picture), outputs)
            else:
                result[:, row, column] = np.einsum("bhwc,hwco->bo", window, kernel)
    return result


def pooled(picture: Array, size: int, stride: int, *, same: bool) -> Array:
    """The largest value under a square window."""
    padded, rows, columns = _padded(picture, (size, size), stride, 1, same=same, value=-np.inf)
    result = np.zeros((len(picture), rows, columns, picture.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            window = padded[:, row * stride : row * stride + size, column * stride : column * stride + size]
            result[:, row, column] = window.max((1, 2))
    return result


def _padded(
    picture: Array, kernel: tuple[int, int], stride: int, dilation: int, *, same: bool, value: float
) -> tuple[Array, int, int]:
    sizes, pads = [], []
    for size, reach in zip(picture.shape[1:3], ((k - 1) * dilation + 1 for k in kernel), strict=True):
        outputs = math.ceil(size / stride) if same else math.ceil((size - reach + 1) / stride)
        missing = max((outputs - 1) * stride + reach - size, 0) if same else 0
        sizes.append(outputs)
        pads.append((missing // 2, missing - missing // 2))
    padded = np.pad(picture, ((0, 0), *pads, (0, 0)), constant_values=value)
    return padded, sizes[0], sizes[1]


def resized(picture: Array, rows: int, columns: int, *, corners: bool, centres: bool) -> Array:
    """Bilinear interpolation, pixel by pixel."""
    result = np.zeros((len(picture), rows, columns, picture.shape[-1]))
    for row in range(rows):
        for column in range(columns):
            y = _source(row, picture.shape[1], rows, corners=corners, centres=centres)
            x = _source(column, picture.shape[2], columns, corners=corners, centres=centres)
            y0, x0 = int(y), int(x)
            y1, x1 = min(y0 + 1, picture.shape[1] - 1), min(x0 + 1, picture.shape[2] - 1)
            upper = picture[:, y0, x0] * (1 - x + x0) + picture[:, y0, x1] * (x - x0)
            lower = picture[:, y1, x0] * (1 - x + x0) + picture[:, y1, x1] * (x - x0)
            result[:, row, column] = upper * (1 - y + y0) + lower * (y - y0)
    return result


def _source(index: int, size: int, wanted: int, *, corners: bool, centres: bool) -> float:
    if corners:
        return index * (size - 1) / (wanted - 1)
    if centres:
        return max((index + 0.5) * size / wanted - 0.5, 0.0)
    return index * size / wanted
