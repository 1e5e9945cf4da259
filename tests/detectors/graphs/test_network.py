"""Graph models: their files, how they are made ready, and what is said of those that cannot be."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from attacks.detectors.catalogue import DetectorError
from attacks.detectors.graphs.files import load_graph_model, read_graph_model, topology
from attacks.detectors.graphs.network import GraphNetwork
from mi_splat.errors import InvalidValueError
from tests.detectors.graphs.graphs import files, ints, model, node, placeholder, string

KERNEL = np.arange(12, dtype=np.float32).reshape(1, 1, 3, 4)
CONVOLUTION = {"strides": ints(1, 1, 1, 1), "padding": string("VALID"), "dilations": ints(1, 1, 1, 1)}


def two_convolutions() -> tuple[bytes, bytes]:
    """A graph as converters from PyTorch make it: channels first, with transpositions about each convolution."""
    constants = {
        "k": KERNEL,
        "l": KERNEL.transpose(0, 1, 3, 2).copy(),
        "out": np.array([0, 2, 3, 1], np.int32),
        "in": np.array([0, 3, 1, 2], np.int32),
        "bias": np.array([1, 2, 3], np.float32).reshape(1, 3, 1, 1),
    }
    nodes = [
        node("z", "Add", ["b2", "bias"]),
        placeholder("x", (1, 3, 4, 5)),
        node("a", "Transpose", ["x", "out"]),
        node("b", "Conv2D", ["a", "k"], **CONVOLUTION),
        node("b1", "Transpose", ["b", "in"]),
        node("r", "Relu", ["b1"]),
        node("a2", "Transpose", ["r", "out"]),
        node("c", "Conv2D", ["a2", "l"], **CONVOLUTION),
        node("b2", "Transpose", ["c", "in"]),
    ]
    return files(nodes, constants, ["z"])


def test_channels_first_graph_needs_no_transposition_when_it_runs() -> None:
    network = GraphNetwork(read_graph_model(*two_convolutions()))
    names = [getattr(function, "__name__", "convolution") for function, _, _ in network._calls]
    assert names == ["convolution", "relu", "convolution", "add"]
    x = torch.randn(1, 3, 4, 5)
    k = torch.from_numpy(KERNEL[0, 0])
    hidden = torch.relu(torch.einsum("bchw,co->bohw", x, k))
    wanted = torch.einsum("bohw,co->bchw", hidden, k) + torch.tensor([1.0, 2, 3]).reshape(1, 3, 1, 1)
    torch.testing.assert_close(network(x)[0], wanted)


def test_what_depends_on_constants_alone_is_worked_out_once() -> None:
    constants = {
        "where": np.array([[1]], np.int32),
        "shape": np.array([3], np.int32),
        "values": np.array([6], np.int32),
        "rest": np.array(1, np.int32),
        "plus": np.array([0, 0, -2], np.int32),
    }
    nodes = [
        placeholder("x", (6,)),
        node("sizes", "SparseToDense", ["where", "shape", "values", "rest"]),
        node("wanted", "AddV2", ["sizes", "plus"]),
        node("y", "Reshape", ["x", "wanted"]),
    ]
    network = GraphNetwork(model(nodes, constants, ["y"]))
    assert len(network._calls) == 1
    assert tuple(network(torch.arange(6.0))[0].shape) == (1, 6, 1)


def test_only_what_an_output_needs_is_made_ready() -> None:
    nodes = [placeholder("x", (2,)), node("y", "Relu", ["x"]), node("z", "NoSuchThing", ["y"])]
    made = model(nodes, {}, ["z"])
    assert GraphNetwork(made, ["y"])(torch.tensor([-1.0, 2.0]))[0].tolist() == [0.0, 2.0]
    with pytest.raises(DetectorError, match=r"operation of node z: expected one of .*, got NoSuchThing; add it"):
        GraphNetwork(made)


def test_a_graph_may_give_a_constant_and_its_input() -> None:
    network = GraphNetwork(model([placeholder("x", (2,))], {"c": np.array([3.0], np.float32)}, ["c", "x"]))
    assert [one.tolist() for one in network(torch.tensor([1.0, 2.0]))] == [[3.0], [1.0, 2.0]]


def test_network_moves_with_its_constants() -> None:
    network = GraphNetwork(read_graph_model(*two_convolutions())).double()
    assert network(torch.randn(1, 3, 4, 5, dtype=torch.float64))[0].dtype == torch.float64


@pytest.mark.parametrize(
    ("name", "attributes", "says"),
    [
        ("Conv2D", {**CONVOLUTION, "data_format": string("NCHW")}, "data_format of Conv2D y: expected NHWC, got NCHW"),
        ("Conv2D", {**CONVOLUTION, "padding": string("EXPLICIT")}, "padding of Conv2D y: expected SAME or VALID"),
        ("_FusedConv2D", {**CONVOLUTION, "fused_ops": {"list": {"s": ["U3dpc2g="]}}}, "got Swish"),
    ],
)
def test_an_unknown_setting_is_named(name: str, attributes: dict[str, object], says: str) -> None:
    nodes = [placeholder("x", (1, 4, 4, 3)), node("y", name, ["x", "k"], **attributes)]
    with pytest.raises(DetectorError, match=says):
        GraphNetwork(model(nodes, {"k": KERNEL}, ["y"]))


def test_computed_sizes_are_refused() -> None:
    nodes = [placeholder("x", (2, 2)), placeholder("s", (1,)), node("y", "Reshape", ["x", "s"])]
    with pytest.raises(DetectorError, match=r"axes or sizes of Reshape y: expected constants, got computed ones"):
        GraphNetwork(model(nodes, {}, ["y"]))


def test_wrong_graphs_are_refused() -> None:
    circle = [placeholder("x", (2,)), node("y", "Add", ["x", "z"]), node("z", "Relu", ["y"])]
    with pytest.raises(DetectorError, match="no circle"):
        GraphNetwork(model(circle, {}, ["z"]))
    with pytest.raises(DetectorError, match="a node of the graph, got nothing_here"):
        GraphNetwork(model([placeholder("x", (2,))], {}, ["x"]), ["nothing_here"])
    with pytest.raises(DetectorError, match="a shape that is known"):
        GraphNetwork(model([placeholder("x", (-1, 2))], {}, ["x"]))
    with pytest.raises(InvalidValueError, match=r"input x: expected \(2,\), got \(3,\)"):
        GraphNetwork(model([placeholder("x", (2,))], {}, ["x"]))(torch.zeros(3))


def test_files_are_checked() -> None:
    graph, weights = two_convolutions()
    with pytest.raises(DetectorError, match="all tensors of the manifest"):
        read_graph_model(graph, weights[:-1])
    with pytest.raises(DetectorError, match="bytes, as the manifest says"):
        read_graph_model(graph, weights + b"\0")
    with pytest.raises(DetectorError, match=r"expected a TensorFlow\.js graph model, got Expecting"):
        read_graph_model(b"{", weights)
    with pytest.raises(DetectorError, match=r"modelTopology\.node"):
        read_graph_model(b'{"format": "layers-model"}', weights)
    document = json.loads(graph)
    document["weightsManifest"][0]["weights"][0]["quantization"] = {"dtype": "uint8", "min": 0, "scale": 1}
    with pytest.raises(DetectorError, match="k of uint8"):
        read_graph_model(json.dumps(document).encode(), weights)
    document["weightsManifest"] = []
    with pytest.raises(DetectorError, match="a value of the constant"):
        read_graph_model(json.dumps(document).encode(), b"")
    with pytest.raises(DetectorError, match="which y takes"):
        model([node("y", "Relu", ["x"])], {}, ["y"])


def test_half_precision_comes_back_as_what_it_stands_for() -> None:
    graph, _ = files([placeholder("x", (2,))], {"c": np.zeros(3, np.float16)}, ["c"])
    document = json.loads(graph)
    entry = document["weightsManifest"][0]["weights"][0]
    entry |= {"dtype": "float32", "quantization": {"dtype": "float16", "original_dtype": "float32"}}
    loaded = read_graph_model(json.dumps(document).encode(), np.array([0.5, 1, -2], np.float16).tobytes())
    assert loaded.constants["c"].dtype == torch.float32
    assert loaded.constants["c"].tolist() == [0.5, 1.0, -2.0]


def test_a_kept_model_is_the_one_that_was_read(tmp_path: Path) -> None:
    graph, weights = two_convolutions()
    read = read_graph_model(graph, weights)
    save_file({k: v.contiguous() for k, v in read.constants.items()}, tmp_path / "weights.safetensors")
    (tmp_path / "graph.json").write_bytes(topology(graph))
    kept = load_graph_model(tmp_path / "graph.json", tmp_path / "weights.safetensors")
    x = torch.randn(1, 3, 4, 5)
    assert torch.equal(GraphNetwork(kept)(x)[0], GraphNetwork(read)(x)[0])
    with pytest.raises(DetectorError, match="got No such file or directory"):
        load_graph_model(tmp_path / "none.json", tmp_path / "weights.safetensors")


def relu(**changes: object) -> dict[str, object]:
    return {**node("y", "Relu", ["x"]), **changes}


@pytest.mark.parametrize(
    ("nodes", "says"),
    [
        ([placeholder("x", (2,)), relu(input="x")], r"node\[2\]: input: expected strings"),
        ([placeholder("x", (2,)), relu(input=[7])], r"node\[2\]: input: expected strings"),
        ([placeholder("x", (2,)), relu(input=[])], "Relu y: expected inputs and settings that fit together"),
        ([placeholder("x", (2,)), relu(input=["x:1"])], "output of node x: expected one of 1, got 1"),
        ([placeholder("x", (2,)), relu(input=["x:one"])], "output of node x: expected one of 1, got one"),
        ([placeholder("x", (2,)), relu(input=["y"])], "no circle"),
        ([placeholder("x", (2,)), relu(op=None)], r"node\[2\]: op: expected a string"),
        ([placeholder("x", (2,)), relu(attr=[])], r"node\[2\]: attr: expected an object"),
        ([placeholder("x", (2,)), relu(), relu()], "nodes of different names, got two called y"),
        ([placeholder("x", (2,)), 7], "node: expected a list of objects"),
        ([placeholder("x", (1 << 20, 1 << 20)), relu()], "an input of at most"),
        ([node("x", "Placeholder"), relu()], "attr: shape: expected an object"),
        (
            [placeholder("x", (1 << 20, 1)), placeholder("z", (1, 1 << 20)), relu(op="Mul", input=["x", "z"])],
            "a result",
        ),
        (
            [placeholder("x", (2, 3)), placeholder("z", (4, 5)), relu(op="Mul", input=["x", "z"])],
            "Mul y: expected inputs",
        ),
        ([placeholder("x", (1, 4, 4, 3)), node("y", "Conv2D", ["x", "k"], strides=7)], "strides of node y, an object"),
        (
            [placeholder("x", (1, 4, 4, 3)), node("y", "Conv2D", ["x", "k"], strides={"list": {"i": ["x"] * 4}})],
            "32 bits",
        ),
        (
            [placeholder("x", (1, 4, 4, 3)), node("y", "Conv2D", ["x", "k"], strides=ints(0, 0, 0, 0))],
            "Conv2D y: expected",
        ),
        ([placeholder("x", (1, 4, 4, 3)), node("y", "Conv2D", ["x", "k"], padding={"s": "?"})], "a string in base 64"),
    ],
)
def test_graphs_whose_parts_do_not_fit_are_refused(nodes: list[dict[str, object]], says: str) -> None:
    with pytest.raises(DetectorError, match=says):
        GraphNetwork(model(nodes, {"k": KERNEL}, ["y"]))


def test_constants_that_are_not_finite_are_refused() -> None:
    with pytest.raises(DetectorError, match="finite numbers in k"):
        model([placeholder("x", (2,))], {"k": np.array([1, np.nan], np.float32)}, ["x"])
    with pytest.raises(DetectorError, match="finite numbers in k"):
        model([placeholder("x", (2,))], {"k": np.array([-np.inf], np.float32)}, ["x"])
    padding = model([placeholder("x", (2,))], {"k": np.array(-np.inf, np.float32)}, ["x"])
    assert float(padding.constants["k"]) == -np.inf


def test_the_digest_is_that_of_nodes_and_outputs() -> None:
    nodes = [placeholder("x", (2,)), node("y", "LeakyRelu", ["x"], alpha={"f": 0.1}), relu(name="z")]
    other = [placeholder("x", (2,)), node("y", "LeakyRelu", ["x"], alpha={"f": 0.2}), relu(name="z")]
    digests = [GraphNetwork(model(part, {}, outputs)).digest for part in (nodes, other) for outputs in ("y", "z")]
    assert len(set(digests)) == 4
    assert digests[0] == GraphNetwork(model(nodes, {}, ["y"])).digest
