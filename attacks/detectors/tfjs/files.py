"""The file form of a TensorFlow.js graph model: a JSON of nodes, and one block of bytes with the constants.

Also the form in which this project keeps such a model: the nodes as JSON, the constants as safetensors.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.detectors.errors import DetectorError
from attacks.detectors.weights import read_weights
from mi_splat.errors import message

_DTYPES = {"float32": np.float32, "int32": np.int32, "bool": np.bool_, "float16": np.float16}
_EXPORT_AGAIN = "convert the model again, or report the file"


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One operation of a graph.

    Attributes:
        name: Unique in the graph.
        op: Name of the operation in TensorFlow.
        inputs: Names of the tensors that it takes: `node`, or `node:1` for the second output of a node.
        attributes: Its settings, as the JSON has them.
    """

    name: str
    op: str
    inputs: tuple[str, ...]
    attributes: Mapping[str, Any]

    def ints(self, name: str) -> tuple[int, ...]:
        """A list of numbers."""
        return tuple(int(value) for value in self.attributes[name]["list"].get("i", ()))

    def flag(self, name: str) -> bool:
        """A truth value; False where the file says nothing."""
        return bool(self.attributes.get(name, {}).get("b", False))

    def number(self, name: str, default: float) -> float:
        """A number."""
        return float(self.attributes.get(name, {}).get("f", default))

    def integer(self, name: str) -> int:
        """A whole number; 0 where the file says nothing."""
        return int(self.attributes.get(name, {}).get("i", 0))

    def word(self, name: str, default: str) -> str:
        """A string, which the JSON has in base 64."""
        found = self.attributes.get(name, {}).get("s")
        return default if found is None else base64.b64decode(found).decode()

    def words(self, name: str) -> tuple[str, ...]:
        """A list of strings."""
        return tuple(base64.b64decode(value).decode() for value in self.attributes[name]["list"].get("s", ()))


@dataclass(frozen=True, slots=True, eq=False)
class GraphModel:
    """A graph and its constants.

    Attributes:
        nodes: In an order in which every node comes after its inputs is not promised.
        constants: Name of a `Const` node to its value.
        inputs: Names of the tensors that the graph takes, with their shapes; -1 is any size.
        outputs: Names of the tensors that it gives.
    """

    nodes: Mapping[str, Node]
    constants: Mapping[str, Tensor]
    inputs: Mapping[str, tuple[int, ...]]
    outputs: tuple[str, ...]


def read_graph_model(model_json: bytes, weights: bytes) -> GraphModel:
    """A graph model from the two files of TensorFlow.js' converter.

    Args:
        model_json: What the `.json` file holds: topology, signature and manifest of the weights.
        weights: What the `.bin` file holds, or all of them one after the other.

    Raises:
        DetectorError: It is no graph model, or the weights are not those of the manifest.
    """
    document = _document(model_json)
    return _graph(document, _constants(document, weights))


def topology(model_json: bytes) -> bytes:
    """What is kept of the `.json` file: nodes and signature, without the manifest of the weights."""
    document = _document(model_json)
    kept = {name: document[name] for name in ("modelTopology", "signature") if name in document}
    return json.dumps(kept, separators=(",", ":")).encode()


def load_graph_model(graph: Path, weights: Path) -> GraphModel:
    """A graph model from the two files that this project keeps: `topology` and the constants as safetensors.

    Raises:
        DetectorError: A file is missing, or not what it should be.
    """
    constants = read_weights(weights)
    try:
        document = _document(graph.read_bytes())
    except OSError as error:
        do = "get the detector again"
        raise DetectorError(message(f"graph {graph}", "a readable file", error.strerror, do)) from error
    return _graph(document, constants)


def _document(model_json: bytes) -> dict[str, Any]:
    try:
        document = json.loads(model_json)
    except ValueError as error:
        raise _wrong("JSON", str(error)) from error
    nodes = document.get("modelTopology", {}).get("node") if isinstance(document, dict) else None
    if not isinstance(nodes, list):
        raise _wrong("a TensorFlow.js graph model, with modelTopology.node", "another document")
    result: dict[str, Any] = document
    return result


def _constants(document: dict[str, Any], weights: bytes) -> dict[str, Tensor]:
    """The constants in the order of the manifest; quantised ones as what they stand for."""
    found, at = {}, 0
    for group in document.get("weightsManifest", ()):
        for entry in group["weights"]:
            quantised = entry.get("quantization", {})
            kind = quantised.get("dtype", entry["dtype"])
            if kind not in _DTYPES or (quantised and kind != "float16"):
                raise _wrong(f"weights of {', '.join(_DTYPES)}", f"{entry['name']} of {kind}")
            dtype = np.dtype(_DTYPES[kind])
            count = int(np.prod(entry["shape"], dtype=np.int64))
            if count < 0 or at + count * dtype.itemsize > len(weights):
                raise _wrong("a weights file with all tensors of the manifest", f"{len(weights)} bytes")
            values = np.frombuffer(weights, dtype, count, at).reshape(entry["shape"])
            if dtype == np.float16:
                values = values.astype(np.float32)
            found[entry["name"]] = torch.from_numpy(values.copy())
            at += count * dtype.itemsize
    if at != len(weights):
        raise _wrong(f"a weights file of {at} bytes, as the manifest says", f"{len(weights)} bytes")
    return found


def _graph(document: dict[str, Any], constants: Mapping[str, Tensor]) -> GraphModel:
    nodes = {}
    for one in document["modelTopology"]["node"]:
        inputs = tuple(name for name in one.get("input", ()) if not name.startswith("^"))
        nodes[one["name"]] = Node(one["name"], one["op"], inputs, one.get("attr", {}))
    for node in nodes.values():
        if node.op == "Const" and node.name not in constants:
            raise _wrong(f"a value of the constant {node.name}", "none")
        for name in node.inputs:
            if name.partition(":")[0] not in nodes:
                raise _wrong(f"a graph whose nodes are all there, {name} among them", f"none, which {node.name} takes")
    signature = document.get("signature", {})
    shapes = {
        node.name: tuple(int(size.get("size", -1)) for size in node.attributes["shape"]["shape"].get("dim", ()))
        for node in nodes.values()
        if node.op == "Placeholder"
    }
    outputs = tuple(entry.get("name", name) for name, entry in signature.get("outputs", {}).items())
    return GraphModel(nodes, constants, shapes, outputs)


def _wrong(expected: str, got: str) -> DetectorError:
    return DetectorError(message("graph model", expected, got, _EXPORT_AGAIN))
