"""The file form of a TensorFlow.js graph model: a JSON of nodes, and one block of bytes with the constants.

Also the form in which this project keeps any graph: the nodes as JSON, the constants as safetensors.
"""

import base64
import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.detectors.catalogue import DetectorError
from attacks.detectors.weights import check_finite, read_weights
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

_DTYPES = {"float32": np.float32, "int32": np.int32, "bool": np.bool_, "float16": np.float16}
_EXPORT_AGAIN = "convert the model again, or report the file"
_READER = DocumentReader(expected="a TensorFlow.js graph model", do=_EXPORT_AGAIN, error=DetectorError)
_WHOLE = re.compile(r"-?[0-9]{1,10}")
MOST_AXES = 8
"""Most axes that a tensor of a graph may have."""
MOST_ELEMENTS = 1 << 27
"""Most numbers that a tensor of a graph may have."""


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
        return tuple(_whole(value, f"{name} of node {self.name}") for value in self._listed(name, "i"))

    def flag(self, name: str) -> bool:
        """A truth value; False where the file says nothing."""
        return bool(self._plain(name, "b", bool, False))

    def number(self, name: str, default: float) -> float:
        """A number."""
        return float(self._plain(name, "f", (int, float), default))

    def integer(self, name: str) -> int:
        """A whole number; 0 where the file says nothing."""
        return _whole(self._plain(name, "i", (int, str), 0), f"{name} of node {self.name}")

    def kind(self, name: str) -> str:
        """Name of a kind of numbers, such as DT_FLOAT; empty where the file says nothing."""
        return str(self._plain(name, "type", str, ""))

    def word(self, name: str, default: str) -> str:
        """A string, which the JSON has in base 64."""
        text = self._plain(name, "s", str, None)
        return default if text is None else _decoded(text, f"{name} of node {self.name}")

    def words(self, name: str) -> tuple[str, ...]:
        """A list of strings."""
        return tuple(_decoded(value, f"{name} of node {self.name}") for value in self._listed(name, "s"))

    def _plain(self, name: str, key: str, kind: type | tuple[type, ...], default: Any) -> Any:
        value = self._attribute(name).get(key, default)
        if value is not default and not isinstance(value, kind):
            raise _wrong(f"{name} of node {self.name} as TensorFlow.js writes it", repr(value)[:60])
        return value

    def _listed(self, name: str, key: str) -> list[Any]:
        listed = self._attribute(name).get("list")
        values = listed.get(key, []) if isinstance(listed, dict) else None
        if not isinstance(values, list):
            raise _wrong(f"{name} of node {self.name}, a list", repr(listed)[:60])
        return values

    def _attribute(self, name: str) -> Mapping[str, Any]:
        attribute = self.attributes.get(name, {})
        if not isinstance(attribute, dict):
            raise _wrong(f"{name} of node {self.name}, an object", repr(attribute)[:60])
        return attribute


@dataclass(frozen=True, slots=True, eq=False)
class GraphModel:
    """A graph and its constants.

    Attributes:
        nodes: In an order in which every node comes after its inputs is not promised.
        constants: Name of a `Const` node to its value.
        inputs: Names of the tensors that the graph takes, with their shapes; -1 is any size.
        outputs: Names of the tensors that it gives.
        digest: SHA-256 of the nodes and the signature.
    """

    nodes: Mapping[str, Node]
    constants: Mapping[str, Tensor]
    inputs: Mapping[str, tuple[int, ...]]
    outputs: tuple[str, ...]
    digest: str


def read_graph_model(model_json: bytes, weights: bytes) -> GraphModel:
    """A graph model from the two files of TensorFlow.js' converter."""
    document = _with_nodes(_READER.json_object(model_json, "graph model"))
    return _graph(document, _constants(document, weights))


def topology(model_json: bytes) -> bytes:
    """What is kept of the `.json` file: nodes and signature, without the manifest of the weights."""
    return _topology(_with_nodes(_READER.json_object(model_json, "graph model")))


def _topology(document: Mapping[str, Any]) -> bytes:
    kept = {name: document[name] for name in ("modelTopology", "signature") if name in document}
    return json.dumps(kept, separators=(",", ":")).encode()


def load_graph_model(graph: Path, weights: Path) -> GraphModel:
    """A graph model from the two files that this project keeps: `topology` and the constants as safetensors."""
    constants = read_weights(weights)
    return _graph(_with_nodes(_READER.read_json(graph)), constants)


def _with_nodes(document: dict[str, Any]) -> dict[str, Any]:
    nodes = document.get("modelTopology")
    if not isinstance(nodes, dict) or not isinstance(nodes.get("node"), list):
        raise _wrong("a TensorFlow.js graph model, with modelTopology.node", "another document")
    return document


def _constants(document: dict[str, Any], weights: bytes) -> dict[str, Tensor]:
    """The constants in the order of the manifest; quantised ones as what they stand for."""
    constants, at = dict[str, Tensor](), 0
    for group in _fields(document).objects("weightsManifest"):
        for entry in group.objects("weights"):
            name, shape = entry.text("name"), entry.wholes("shape", 0, MOST_ELEMENTS)
            quantised = entry.object("quantization", {})
            kind = quantised.text("dtype", entry.text("dtype"))
            if kind not in _DTYPES or (quantised.values and kind != "float16"):
                raise _wrong(f"weights of {', '.join(_DTYPES)}", f"{name} of {kind}")
            dtype, count = np.dtype(_DTYPES[kind]), math.prod(shape)
            if len(shape) > MOST_AXES or at + count * dtype.itemsize > len(weights):
                raise _wrong("a weights file with all tensors of the manifest", f"{len(weights)} bytes")
            values = np.frombuffer(weights, dtype, count, at).reshape(shape)
            if dtype == np.float16:
                values = values.astype(np.float32)
            constants[name] = torch.from_numpy(values.copy())
            at += count * dtype.itemsize
    if at != len(weights):
        raise _wrong(f"a weights file of {at} bytes, as the manifest says", f"{len(weights)} bytes")
    check_finite(constants, "graph model")
    return constants


def _fields(document: dict[str, Any]) -> Fields:
    return Fields(document, "graph model", DetectorError, _EXPORT_AGAIN)


def _graph(document: dict[str, Any], constants: Mapping[str, Tensor]) -> GraphModel:
    root, nodes, shapes = _fields(document), dict[str, Node](), dict[str, tuple[int, ...]]()
    for entry in root.object("modelTopology").objects("node"):
        name = entry.text("name")
        if name in nodes:
            raise _wrong("nodes of different names", f"two called {name[:60]}")
        inputs = tuple(taken for taken in entry.texts("input") if not taken.startswith("^"))
        nodes[name] = Node(name, entry.text("op"), inputs, entry.object("attr", {}).values)
        if nodes[name].op == "Placeholder":
            dimensions = entry.object("attr").object("shape").object("shape").objects("dim")
            sizes = tuple(_whole(part.values.get("size", -1), f"shape of node {name}") for part in dimensions)
            if len(sizes) > MOST_AXES or math.prod(sizes) > MOST_ELEMENTS:
                raise _wrong(f"an input of at most {MOST_ELEMENTS:,} numbers", sizes)
            shapes[name] = sizes
    for node in nodes.values():
        if node.op == "Const" and node.name not in constants:
            raise _wrong(f"a value of the constant {node.name}", "none")
        for taken in node.inputs:
            if taken.partition(":")[0] not in nodes:
                raise _wrong(f"a graph whose nodes are all there, {taken} among them", f"none, which {node.name} takes")
    signature = root.object("signature", {}).object("outputs", {})
    outputs = tuple(signature.object(name).text("name", name) for name in signature.values)
    return GraphModel(nodes, constants, shapes, outputs, hashlib.sha256(_topology(document)).hexdigest())


def _whole(value: object, what: str) -> int:
    """A whole number of 32 bits, which the JSON may have as a string."""
    text = str(value) if isinstance(value, int | str) and not isinstance(value, bool) else ""
    if not _WHOLE.fullmatch(text) or not -(1 << 31) <= int(text) < 1 << 31:
        raise _wrong(f"{what}, a whole number of 32 bits", repr(value)[:60])
    return int(text)


def _decoded(value: object, what: str) -> str:
    """A string that the JSON has in base 64."""
    try:
        return base64.b64decode(str(value), validate=True).decode()
    except ValueError as error:
        raise _wrong(f"{what}, a string in base 64", repr(value)[:60]) from error


def _wrong(expected: str, got: object) -> DetectorError:
    return DetectorError.of("graph model", expected, got, _EXPORT_AGAIN)
