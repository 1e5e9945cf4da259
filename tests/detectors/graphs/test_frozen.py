"""Frozen graphs of TensorFlow become graphs that compute what their definition says."""

from __future__ import annotations

import struct

import numpy as np
import torch

from attacks.detectors.graphs.detector import GraphNetwork
from attacks.detectors.graphs.graph import read_frozen
from tests.detectors.graphs.test_operations import convolved


def number(value: int) -> bytes:
    if value < 128:
        return bytes([value])
    return bytes([value & 127 | 128]) + number(value >> 7)


def field(key: int, content: bytes) -> bytes:
    return number(8 * key + 2) + number(len(content)) + content


def node(name: str, op: str, *inputs: str, **settings: bytes) -> bytes:
    """A NodeDef in a GraphDef."""
    taken = b"".join(field(3, of.encode()) for of in inputs)
    values = b"".join(
        field(5, field(1, key.encode()) + field(2, value))
        for key, value in settings.items()
    )
    return field(1, field(1, name.encode()) + field(2, op.encode()) + taken + values)


def constant(
    name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
) -> bytes:
    """A Const of floats, as bytes, or as one number if all are the same."""
    shape = b"".join(field(2, number(8) + number(side)) for side in values.shape)
    same = values.size > 1 and len(np.unique(values)) == 1
    if same:
        content = field(5, struct.pack("<f", values.flat[0]))
    else:
        content = field(4, values.tobytes())
    return node(
        name, "Const", value=field(8, number(8) + number(1) + field(2, shape) + content)
    )


def test_operations_are_those_of_the_definition() -> None:
    generator = np.random.default_rng(0)
    filters = generator.normal(size=(3, 3, 2, 4)).astype(np.float32)
    scale, offset, mean = generator.normal(size=(3, 4)).astype(np.float32)
    variance = np.full(4, 0.3, np.float32)
    strides = field(1, field(3, bytes([1, 2, 2, 1])))
    least = number(8 * 4 + 5) + struct.pack("<f", 0.01)
    named = {
        "filters": filters,
        "scale": scale,
        "offset": offset,
        "mean": mean,
        "variance": variance,
    }
    parts = [constant(name, values) for name, values in named.items()]
    parts.append(node("read", "Identity", "filters", "^mean"))
    parts.append(
        node("conv", "Conv2D", "x", "read", strides=strides, padding=field(2, b"SAME"))
    )
    parts.append(
        node("norm", "FusedBatchNorm", "conv", *list(named)[1:], epsilon=least)
    )
    text = node(
        "text", "Const", value=field(8, number(8) + number(7) + field(8, b"words"))
    )
    content = b"".join(
        [
            node("image_tensor", "Placeholder"),
            *parts,
            node("out", "Relu6", "norm"),
            text,
        ]
    )
    graph = read_frozen(content, {"x": (1, 7, 6, 2)})
    picture = generator.normal(size=(1, 7, 6, 2))
    (computed,) = GraphNetwork(graph, ["out"])(torch.from_numpy(picture).float())
    plain = convolved(
        picture, filters.astype(np.float64), 2, same=True, depthwise=False
    )
    wanted = ((plain - mean) / np.sqrt(variance + 0.01) * scale + offset).clip(0, 6)
    np.testing.assert_allclose(computed.numpy(), wanted, atol=1e-5)
