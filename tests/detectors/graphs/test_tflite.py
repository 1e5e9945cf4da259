"""TFLite files: what becomes of them, and what is said of those that are broken or of another kind."""

import hashlib
import os
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from attacks.detectors.catalogue import (
    GRAPH,
    NPM_DETECTORS,
    OPEN_IMAGES_LABELS,
    WEIGHTS,
    DetectorError,
    weights_of,
)
from attacks.detectors.graphs.detector import FAMILIES, anchors, load
from attacks.detectors.graphs.files import load_graph_model
from attacks.detectors.graphs.network import GraphNetwork
from attacks.detectors.graphs.tflite import read_tflite
from tests.detectors.graphs.graphs import convolved

tflite = pytest.importorskip("tflite", reason="the package tflite, which reads TFLite files, is not installed")
from tests.detectors.graphs.tflite_files import tiny  # noqa: E402  # it needs that package

SSD = FAMILIES["ssd_openimages"]


def network(content: bytes, folder: Path) -> GraphNetwork:
    """What a file becomes on its way through the folder of a detector that was got."""
    nodes, constants = read_tflite(content)
    (folder / GRAPH).write_bytes(nodes)
    save_file(constants, folder / WEIGHTS)
    return GraphNetwork(load_graph_model(folder / GRAPH, folder / WEIGHTS))


def test_operations_are_those_of_the_definition(tmp_path: Path) -> None:
    made = network(tiny(), tmp_path)
    constants = {name: value.double().numpy() for name, value in read_tflite(tiny())[1].items()}
    picture = np.random.default_rng(1).normal(size=(1, 6, 7, 2))
    depth = constants["half"].reshape(3, 3, 2, 2)
    small = convolved(picture, depth, 2, 1, same=True, depthwise=True) + constants["depth bias"]
    filters = constants["filters"].transpose(1, 2, 3, 0)
    thin = convolved(small.clip(0, 6), filters, 1, 1, same=True, depthwise=False) + constants["bias"]
    rows = (2 * thin).reshape(1, 12, 3)
    (computed,) = made(torch.from_numpy(picture).float())
    np.testing.assert_allclose(computed.numpy(), np.concatenate([rows, rows], 1), atol=1e-5)
    assert [value.dtype for name, value in read_tflite(tiny())[1].items() if name == "half"] == [torch.float16]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "two names": ({"names": list("abcdefghijkk")}, "Reshape|two called k"),
    "another type": ({"type_of_bias": tflite.TensorType.INT8}, r"plain tensors of FLOAT32, .*, got another, bias"),
    "too few numbers": ({"shape_of_bias": (4,)}, r"expected 16 bytes of bias, as its shape says, got 12"),
    "an enormous shape": ({"shape_of_bias": (1 << 30, 1 << 30)}, r"at most 134,217,728 numbers, got the shape"),
    "many axes": ({"shape_of_bias": (1,) * 9}, r"at most 8 axes, got 9"),
    "negative": ({"shape_of_bias": (-1, -3)}, r"at most 134,217,728 numbers, got the shape \(-1, -3\)"),
    "an activation": ({"activation": 1}, r"ADD without an activation, got Relu"),
    "an unknown activation": ({"activation": 5}, r"activation among NONE, RELU, RELU6, got number 5"),
    "an unknown operation": ({"second_operation": 94}, r"operations among CONV_2D, .*, got number 94"),
    "settings of another": ({"options_of_the_second": 11}, r"Conv2DOptions of CONV_2D, got others"),
    "a tensor that is not there": ({"input_of_the_last": 12}, r"tensors among 12, got \[10, 12\]"),
    "a negative one": ({"outputs": [-1]}, r"tensors among 12, got \[-1\]"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_known_is_refused(what: str, tmp_path: Path) -> None:
    changes, message = REFUSED[what]
    with pytest.raises(DetectorError, match=message):
        network(tiny(**changes), tmp_path)


def test_damaged_files_are_refused_or_read(tmp_path: Path) -> None:
    """Bytes changed at random, and files cut short: an error of ours, or a graph."""
    whole, draw = tiny(), np.random.default_rng(2)
    for content in (b"", whole[:7], b"TFL3" * 4):
        with pytest.raises(DetectorError, match=r"TFLite model: expected .*; get the file again"):
            read_tflite(content)
    refused = 0
    for _ in range(400):
        damaged = bytearray(whole[: draw.integers(40, len(whole))] if draw.random() < 0.2 else whole)
        for _ in range(draw.integers(1, 4)):
            damaged[draw.integers(8, len(damaged))] = draw.choice([0, 1, 127, 128, 255])
        try:
            read_tflite(bytes(damaged))
        except DetectorError:
            refused += 1
    assert 100 < refused < 400


def test_anchors_are_those_of_the_network() -> None:
    ours = anchors()
    assert ours.shape == (3 * 19**2 + 6 * (10**2 + 5**2 + 3**2 + 2**2 + 1), 4)
    np.testing.assert_allclose(
        ours[:2], [[0.5 / 19, 0.5 / 19, 0.1, 0.1], [0.5 / 19, 0.5 / 19, 0.2 / 2**0.5, 0.2 * 2**0.5]]
    )
    np.testing.assert_allclose(ours[-1], [0.5, 0.5, 0.95**0.5, 0.95**0.5])
    np.testing.assert_allclose(ours[-2], [0.5, 0.5, 0.95 * 3**0.5, 0.95 / 3**0.5])


def test_ssd_boxes_are_shifts_of_anchors_and_a_vehicle_counts_as_a_car() -> None:
    shifts, logits = torch.zeros(1, 1917, 4), torch.full((1, 1917, 24), -9.0)
    labels = list(OPEN_IMAGES_LABELS)
    shifts[0, -1] = torch.tensor([1.0, -2.0, 5 * np.log(0.5), 5 * np.log(0.25)])
    logits[0, -1, 1 + labels.index("Vehicle")], logits[0, -2, 1 + labels.index("Car")] = 1.0, 2.0
    boxes, scores = SSD.decode((shifts, logits))
    side = 0.95**0.5
    y, x, high, wide = 0.5 + 0.1 * side, 0.5 - 0.2 * side, side / 2, side / 4
    wanted = 300 * np.array([x - wide / 2, y - high / 2, x + wide / 2, y + high / 2])
    np.testing.assert_allclose(boxes[-1], wanted, rtol=1e-5)
    car = NPM_DETECTORS["ssd_openimages"].classes.index("car")
    torch.testing.assert_close(scores[-2:, car], torch.sigmoid(torch.tensor([2.0, 1.0])))
    assert scores.shape == (1917, 22)
    assert float(scores[:, [c for c in range(22) if c != car]].max()) < 1e-3


def picture() -> Tensor:
    """(1, 300, 300, 3) of smooth noise in [-1, 1]."""
    coarse = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, (300, 300), mode="bilinear").permute(0, 2, 3, 1) * 2 - 1


def interpreted(content: bytes, tensor: Tensor) -> list[np.ndarray[Any, Any]]:
    """The outputs by TFLite's own interpreter."""
    reason = "the interpreter of TFLite is not installed: pip install ai-edge-litert"
    runtime: Any = pytest.importorskip("ai_edge_litert.interpreter", reason=reason)
    interpreter = runtime.Interpreter(model_content=content, num_threads=1)
    interpreter.allocate_tensors()
    interpreter.set_tensor(interpreter.get_input_details()[0]["index"], np.ascontiguousarray(tensor.numpy()))
    interpreter.invoke()
    return [interpreter.get_tensor(each["index"]) for each in interpreter.get_output_details()]


def test_outputs_are_those_of_the_interpreter(tmp_path: Path) -> None:
    tensor = torch.randn(1, 6, 7, 2, generator=torch.Generator().manual_seed(0))
    (wanted,) = interpreted(tiny(), tensor)
    np.testing.assert_allclose(network(tiny(), tmp_path)(tensor)[0].numpy(), wanted, atol=1e-4)


def test_outputs_of_the_published_are_those_of_the_interpreter(tmp_path: Path) -> None:
    package = os.environ.get("MI_SPLAT_OBJECTRON", "")
    if not package:
        pytest.skip("the published file is not here: MI_SPLAT_OBJECTRON=FILE.tgz of npm pack @mediapipe/objectron")
    detector = NPM_DETECTORS["ssd_openimages"]
    with tarfile.open(package) as archive:
        member = archive.extractfile(detector.files[0].member)
        assert member is not None
        content = member.read()[detector.start :]
    assert hashlib.sha256(content).hexdigest() == "d0a5255bf8c4f5a0bc4240741a76c41d5e939f7655078f945f50ab53a9375da6"
    made = network(content, tmp_path)
    assert made.outputs == SSD.outputs
    for computed, wanted in zip(made(picture()), interpreted(content, picture()), strict=True):
        np.testing.assert_allclose(computed.numpy(), wanted, atol=1e-4)


@pytest.mark.skipif(
    not weights_of("ssd_openimages").is_file(), reason="not here: mi-splat detectors --get ssd_openimages"
)
def test_what_was_got_gives_what_the_interpreter_gave() -> None:
    """Its mean and its largest numbers, as the interpreter printed them."""
    detector = load("ssd_openimages")
    shifts, logits = detector.model(picture())
    assert [float(shifts.mean()), float(shifts.max()), float(logits.mean()), float(logits.max())] == pytest.approx(
        [-0.157051, 3.768574, -5.002893, 7.966928], abs=1e-4
    )
    assert detector.fingerprint == "68d87fcb672e30a4"
