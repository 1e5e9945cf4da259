"""TFLite files become graphs that compute what their definition and their interpreter
say.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks.detectors.catalogue import OPEN_IMAGES_LABELS, PACKAGED, weights_of
from attacks.detectors.graphs.detector import FAMILIES, GraphNetwork, anchors, load
from attacks.detectors.graphs.graph import read_tflite
from tests.detectors.graphs.test_operations import convolved

tflite = pytest.importorskip(
    "tflite", reason="the package tflite, which reads TFLite files, is not installed"
)
# it needs that package
from tests.detectors.graphs.tflite_files import tiny  # noqa: E402

SSD = FAMILIES["ssd_openimages"]


def test_operations_are_those_of_the_definition() -> None:
    model = read_tflite(tiny())
    constants = {
        name: value.double().numpy() for name, value in model.constants.items()
    }
    picture = np.random.default_rng(1).normal(size=(1, 6, 7, 2))
    depth = constants["half"].reshape(3, 3, 2, 2)
    small = (
        convolved(picture, depth, 2, same=True, depthwise=True)
        + constants["depth bias"]
    )
    filters = constants["filters"].transpose(1, 2, 3, 0)
    thin = (
        convolved(small.clip(0, 6), filters, 1, same=True, depthwise=False)
        + constants["bias"]
    )
    rows = (2 * thin).reshape(1, 12, 3)
    (computed,) = GraphNetwork(model, ["all"])(torch.from_numpy(picture).float())
    np.testing.assert_allclose(
        computed.numpy(), np.concatenate([rows, rows], 1), atol=1e-5
    )
    assert model.constants["half"].dtype == torch.float16


def test_anchors_are_those_of_the_network() -> None:
    ours = anchors()
    assert ours.shape == (3 * 19**2 + 6 * (10**2 + 5**2 + 3**2 + 2**2 + 1), 4)
    np.testing.assert_allclose(
        ours[:2],
        [
            [0.5 / 19, 0.5 / 19, 0.1, 0.1],
            [0.5 / 19, 0.5 / 19, 0.2 / 2**0.5, 0.2 * 2**0.5],
        ],
    )
    np.testing.assert_allclose(ours[-1], [0.5, 0.5, 0.95**0.5, 0.95**0.5])
    np.testing.assert_allclose(ours[-2], [0.5, 0.5, 0.95 * 3**0.5, 0.95 / 3**0.5])


def test_ssd_boxes_are_shifts_of_anchors_and_a_vehicle_counts_as_a_car() -> None:
    shifts = torch.zeros(1, 1917, 4)
    logits = torch.full((1, 1917, 24), -9.0)
    labels = list(OPEN_IMAGES_LABELS)
    shifts[0, -1] = torch.tensor([1.0, -2.0, 5 * np.log(0.5), 5 * np.log(0.25)])
    (
        logits[0, -1, 1 + labels.index("Vehicle")],
        logits[0, -2, 1 + labels.index("Car")],
    ) = (
        1.0,
        2.0,
    )
    boxes, scores = SSD.decode((shifts, logits))
    side = 0.95**0.5
    y = 0.5 + 0.1 * side
    x = 0.5 - 0.2 * side
    high = side / 2
    wide = side / 4
    wanted = 300 * np.array([x - wide / 2, y - high / 2, x + wide / 2, y + high / 2])
    np.testing.assert_allclose(boxes[-1], wanted, rtol=1e-5)
    car = PACKAGED["ssd_openimages"].classes.index("car")
    torch.testing.assert_close(
        scores[-2:, car], torch.sigmoid(torch.tensor([2.0, 1.0]))
    )
    assert scores.shape == (1917, 22)
    assert float(scores[:, [c for c in range(22) if c != car]].max()) < 1e-3


def picture() -> Tensor:
    """(1, 300, 300, 3) of smooth noise in [-1, 1]."""
    coarse = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    return (
        torch.nn.functional.interpolate(coarse, (300, 300), mode="bilinear").permute(
            0, 2, 3, 1
        )
        * 2
        - 1
    )


def interpreted(content: bytes, tensor: Tensor) -> list[np.ndarray[Any, Any]]:
    """The outputs by TFLite's own interpreter."""
    reason = "the interpreter of TFLite is not installed: pip install ai-edge-litert"
    runtime: Any = pytest.importorskip("ai_edge_litert.interpreter", reason=reason)
    interpreter = runtime.Interpreter(model_content=content, num_threads=1)
    interpreter.allocate_tensors()
    interpreter.set_tensor(
        interpreter.get_input_details()[0]["index"],
        np.ascontiguousarray(tensor.numpy()),
    )
    interpreter.invoke()
    return [
        interpreter.get_tensor(each["index"])
        for each in interpreter.get_output_details()
    ]


def test_outputs_are_those_of_the_interpreter() -> None:
    tensor = torch.randn(1, 6, 7, 2, generator=torch.Generator().manual_seed(0))
    (wanted,) = interpreted(tiny(), tensor)
    np.testing.assert_allclose(
        GraphNetwork(read_tflite(tiny()), ["all"])(tensor)[0].numpy(), wanted, atol=1e-4
    )


@pytest.mark.skipif(
    not weights_of("ssd_openimages").is_file(),
    reason="not here: mi-splat detectors --get ssd_openimages",
)
def test_what_was_got_gives_what_the_interpreter_gave() -> None:
    """Its mean and its largest numbers, as the interpreter printed them."""
    detector = load("ssd_openimages")
    shifts, logits = detector.model(picture())
    assert [
        float(shifts.mean()),
        float(shifts.max()),
        float(logits.mean()),
        float(logits.max()),
    ] == pytest.approx([-0.157051, 3.768574, -5.002893, 7.966928], abs=1e-4)
