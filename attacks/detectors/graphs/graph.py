"""Graphs of operations, and how they are read from TensorFlow.js: a JSON of nodes, and a block of bytes with constants.

The files that are read here are known by their content (`NPM_DETECTORS`), so what they say is not checked again.
"""

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

_DTYPES = {"float32": np.float32, "int32": np.int32, "bool": np.bool_, "float16": np.float16}


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One operation of a graph.

    Attributes:
        op: Name of the operation in TensorFlow.
        inputs: Names of the tensors that it takes: `node`, or `node:1` for the second output of a node.
        settings: Its attributes: numbers, strings, truth values, and tuples of them.
    """

    op: str
    inputs: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class GraphModel:
    """A graph and its constants.

    Attributes:
        nodes: By name, in any order; a placeholder has its `shape`.
        constants: Name of a `Const` node to its value.
    """

    nodes: Mapping[str, Node]
    constants: Mapping[str, Tensor]


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
    """The value of an attribute, whose numbers the JSON has as strings, and whose strings in base 64."""
    kind, value = next(iter(attribute.items()), ("", ""))
    if kind == "list":
        return tuple(_plain({of: item}) for of, items in value.items() for item in items)
    if kind == "shape":
        return tuple(int(part["size"]) for part in value.get("dim", ()))
    if kind == "s":
        return base64.b64decode(value).decode()
    return int(value) if kind == "i" else value


def _constants(manifest: list[Any], weights: bytes) -> dict[str, Tensor]:
    """The constants in the order of the manifest; those in half precision as what they stand for."""
    constants, at = dict[str, Tensor](), 0
    for entry in (entry for group in manifest for entry in group["weights"]):
        dtype = np.dtype(_DTYPES[entry.get("quantization", entry)["dtype"]])
        count = math.prod(entry["shape"])
        values = np.frombuffer(weights, dtype, count, at).reshape(entry["shape"])
        if dtype == np.float16:
            values = values.astype(np.float32)
        constants[entry["name"]] = torch.from_numpy(values.copy())
        at += count * dtype.itemsize
    return constants
