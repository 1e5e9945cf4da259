"""Graphs: how they are read from TensorFlow.js' files, and how they are made ready."""

import base64
import json

import numpy as np
import torch

from attacks.detectors.graphs.detector import GraphNetwork
from attacks.detectors.graphs.graph import GraphModel, Node, read_graph_model

KERNEL = np.arange(12, dtype=np.float32).reshape(1, 1, 3, 4)


def text(value: str) -> dict[str, str]:
    return {"s": base64.b64encode(value.encode()).decode()}


def two_convolutions() -> tuple[bytes, bytes]:
    """A graph as converters from PyTorch make it: channels first, with transpositions
    about each convolution.
    """
    constants: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {
        "k": KERNEL,
        "l": KERNEL.transpose(0, 1, 3, 2).copy(),
        "out": np.array([0, 2, 3, 1], np.int32),
        "in": np.array([0, 3, 1, 2], np.int32),
        "bias": np.array([1, 2, 3], np.float16).reshape(1, 3, 1, 1),
    }
    settings = {
        "strides": {"list": {"i": ["1", "1", "1", "1"]}},
        "padding": text("VALID"),
        "explicit_paddings": {},
    }
    operations = [
        ("z", "Add", ["b2", "bias"], {}),
        ("a", "Transpose", ["x", "out"], {}),
        ("b", "Conv2D", ["a", "k", "^x"], settings),
        ("b1", "Transpose", ["b", "in"], {}),
        ("r", "Relu", ["b1"], {}),
        ("a2", "Transpose", ["r", "out"], {}),
        ("c", "Conv2D", ["a2", "l"], settings),
        ("b2", "Transpose", ["c", "in"], {}),
    ]
    nodes: list[dict[str, object]] = [
        {"name": name, "op": op, "input": taken, "attr": attr}
        for name, op, taken, attr in operations
    ]
    nodes += [{"name": name, "op": "Const"} for name in constants]
    shape = {"shape": {"dim": [{"size": str(size)} for size in (1, 3, 4, 5)]}}
    nodes.append({"name": "x", "op": "Placeholder", "attr": {"shape": shape}})
    manifest: list[dict[str, object]] = [
        {"name": k, "shape": v.shape, "dtype": str(v.dtype)}
        for k, v in constants.items()
    ]
    manifest[-1] |= {"dtype": "float32", "quantization": {"dtype": "float16"}}
    document = {
        "modelTopology": {"node": nodes},
        "weightsManifest": [{"weights": manifest}],
    }
    return json.dumps(document).encode(), b"".join(
        value.tobytes() for value in constants.values()
    )


def test_a_channels_first_graph_is_computed_in_either_precision() -> None:
    model = read_graph_model(*two_convolutions())
    assert model.constants["bias"].dtype == torch.float32
    network = GraphNetwork(model, ["z"])
    x = torch.randn(1, 3, 4, 5)
    k = torch.from_numpy(KERNEL[0, 0])
    hidden = torch.relu(torch.einsum("bchw,co->bohw", x, k))
    wanted = torch.einsum("bohw,co->bchw", hidden, k) + torch.tensor(
        [1.0, 2, 3]
    ).reshape(1, 3, 1, 1)
    torch.testing.assert_close(network(x)[0], wanted)
    assert network.double()(x.double())[0].dtype == torch.float64


def test_what_depends_on_constants_alone_is_worked_out_once() -> None:
    numbers = {
        "where": [[1]],
        "shape": [3],
        "values": [6],
        "rest": 1,
        "plus": [0, 0, -2],
    }
    constants = {name: torch.tensor(value) for name, value in numbers.items()}
    nodes = {
        **dict.fromkeys(constants, Node("Const")),
        "x": Node("Placeholder", settings={"shape": (6,)}),
        "sizes": Node("SparseToDense", ("where", "shape", "values", "rest")),
        "wanted": Node("AddV2", ("sizes", "plus")),
        "y": Node("Reshape", ("x", "wanted")),
        "unused": Node("NoSuchThing", ("y",)),
    }
    network = GraphNetwork(GraphModel(nodes, constants), ["y", "rest", "x"])
    assert len(network._calls) == 1
    y, rest, x = network(torch.arange(6.0))
    assert (tuple(y.shape), float(rest), x.tolist()) == (
        (1, 6, 1),
        1.0,
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
    )
