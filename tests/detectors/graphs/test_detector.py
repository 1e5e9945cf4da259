"""The adapters of the detectors that others trained on photographs; those that need the
weights run where these are.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks.detectors import load_detector
from attacks.detectors.catalogue import COCO_CLASSES, DetectorError, weights_of
from attacks.detectors.graphs.detector import (
    DEVIATION,
    FAMILIES,
    MEAN,
    GraphDetector,
    GraphNetwork,
    load,
)
from attacks.detectors.graphs.graph import GraphModel, Node
from attacks.testing import check_detector
from mi_splat.datasets.frames import read_picture
from mi_splat.io.images import quantise
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import read_scene
from tests.detectors.contract import slope_is_the_gradient

pytestmark = pytest.mark.shipped

SCENES = Path(__file__).resolve().parents[3] / "scenes"
CENTERNET = FAMILIES["centernet_coco"]
NANODET = FAMILIES["nanodet_coco"]
there = {
    name: pytest.mark.skipif(
        not weights_of(name).is_file(), reason=f"mi-splat detectors --get {name}"
    )
    for name in FAMILIES
}
FINGERPRINTS = {
    "centernet_coco": "095e4df75766ddc7",
    "nanodet_coco": "646ac96e7c3021ab",
    "ssd_openimages": "68d87fcb672e30a4",
    "ssdlite_pedestrian": "6bdc4b12d97daa5f",
}
each = [pytest.param(name, marks=mark) for name, mark in there.items()]


def test_centernet_boxes_lie_about_their_cells() -> None:
    scores = torch.zeros(1, 128, 128, 80)
    distances = torch.zeros(1, 128, 128, 4)
    scores[0, 10, 20, 2] = 0.7
    distances[0, 10, 20] = torch.tensor([5.0, 6.0, 7.0, 8.0])
    boxes, confidences = CENTERNET.decode((scores, distances))
    assert boxes[10 * 128 + 20].tolist() == [80 - 5, 40 - 6, 80 + 7, 40 + 8]
    assert confidences[10 * 128 + 20, 2] == pytest.approx(0.7)


def test_centernet_reports_peaks_of_each_class() -> None:
    scores = torch.zeros(128 * 128, 80)
    scores[10 * 128 + 20, 2], scores[10 * 128 + 21, 2], scores[11 * 128 + 21, 5] = (
        0.7,
        0.6,
        0.8,
    )
    scores[40 * 128, 2] = 0.04
    rows, columns = CENTERNET.keep(torch.zeros(len(scores), 4), scores, 0.05)
    assert rows.tolist() == [11 * 128 + 21, 10 * 128 + 20]
    assert columns.tolist() == [5, 2]


def test_nanodet_distance_is_the_mean_of_its_bins() -> None:
    outputs = []
    for stride in (8, 16, 32):
        cells = (NANODET.side // stride) ** 2
        outputs += [torch.zeros(1, cells, 80), torch.full((1, cells, 44), -40.0)]
    cell = 3 * 26 + 4  # row 3, column 4 of the level of stride 16
    for side, distance in enumerate((1, 2, 3, 4)):
        outputs[3][0, cell, side * 11 + distance] = 40.0
    outputs[3][0, cell, 3 * 11 + 6] = 40.0  # half 4, half 6 below
    outputs[2][0, cell, 7] = 0.9
    boxes, scores = NANODET.decode(tuple(outputs))
    row = 52 * 52 + cell
    x = 16 * 4.5
    y = 16 * 3.5
    torch.testing.assert_close(
        boxes[row], torch.tensor([x - 16, y - 32, x + 48, y + 80])
    )
    assert scores[row, 7] == pytest.approx(0.9)
    assert boxes.shape == (52 * 52 + 26 * 26 + 13 * 13, 4)


def test_nanodet_drops_weaker_boxes_of_the_same_class_only() -> None:
    boxes = torch.tensor(
        [[0.0, 0, 10, 10], [0, 0, 10, 9], [0, 0, 10, 10], [50, 50, 60, 60]]
    )
    scores = torch.zeros(4, 3)
    scores[0, 0], scores[1, 0], scores[2, 1], scores[3, 0] = 0.5, 0.6, 0.4, 0.04
    rows, columns = NANODET.keep(boxes, scores, 0.05)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(1, 0), (2, 1)]


def test_pictures_are_prepared_as_the_networks_want_them() -> None:
    colour = torch.tensor([0.2, 0.4, 0.6]).reshape(1, 3, 1, 1).expand(1, 3, 2, 2)
    torch.testing.assert_close(
        CENTERNET.prepare(colour)[0, 0, 0], torch.tensor([51.0, 102, 153])
    )
    blue_green_red = (
        torch.tensor([153.0, 102, 51]) - torch.tensor(MEAN)
    ) / torch.tensor(DEVIATION)
    torch.testing.assert_close(NANODET.prepare(colour)[0, :, 0, 0], blue_green_red)


def _tiny() -> GraphDetector:
    """Scores are the sigmoid of the mean colour over quarters of the image; the box
    of each is the quarter's.
    """
    numbers = {"split": [2, 4, 2, 4, 3], "axes": [1, 3], "shape": [1, 4, 3]}
    constants = {name: torch.tensor(values) for name, values in numbers.items()}
    nodes = {
        **dict.fromkeys(constants, Node("Const")),
        "x": Node("Placeholder", settings={"shape": (1, 8, 8, 3)}),
        "scores": Node("Sigmoid", ("mean",)),
        "mean": Node("Reshape", ("pooled", "shape")),
        "pooled": Node("Mean", ("parts", "axes")),
        "parts": Node("Reshape", ("x", "split")),
    }

    def decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        boxes = torch.tensor([[0.0, 0, 4, 4], [4, 0, 8, 4], [0, 4, 4, 8], [4, 4, 9, 9]])
        return boxes, outputs[0][0]

    family = replace(
        NANODET,
        side=8,
        prepare=lambda picture: picture.permute(0, 2, 3, 1) * 4 - 2,
        decode=decode,
        min_confidence=0.5,
    )
    return GraphDetector(
        "tiny",
        GraphNetwork(GraphModel(nodes, constants), ["scores"]),
        family,
        COCO_CLASSES[:3],
    )


def test_boxes_are_in_pixels_of_the_picture_whatever_its_size() -> None:
    detector = _tiny()
    image = torch.zeros(1, 16, 32, 3)
    image[0, 8:, 16:, 1] = 1.0
    (detections,) = detector.detect(image)
    assert detections.labels == (COCO_CLASSES[1],)
    assert detections.boxes.tolist() == [[16.0, 8.0, 32.0, 16.0]]
    (all_of_them,) = detector.candidates(image)
    assert all_of_them.scores.shape == (4, 3)
    assert all_of_them.boxes[3, 2].tolist() == [16.0, 8.0, 32.0, 16.0]


def test_the_contract_is_kept() -> None:
    check_detector(_tiny())


@pytest.mark.parametrize(
    ("name", "known"),
    [
        pytest.param(name, known, marks=there[name])
        for name, known in FINGERPRINTS.items()
    ],
)
def test_the_fingerprint_of_the_published_is_that_of_results(
    name: str, known: str
) -> None:
    assert load(name).fingerprint == known


def test_weights_that_are_not_there_or_are_others_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(
        DetectorError,
        match=r"weights of nanodet_coco: .* get it: mi-splat detectors --get",
    ):
        load_detector("nanodet_coco")
    for file in ("nanodet.json", "nanodet.bin", "other.bin"):
        (tmp_path / file).write_bytes(b"{}")
    with pytest.raises(
        DetectorError, match=r"nanodet\.json: expected sha256 4495eb.*get it"
    ):
        load_detector("nanodet_coco", weights=tmp_path / "nanodet.bin")
    with pytest.raises(
        DetectorError, match=r"expected a file nanodet\.bin, got other\.bin"
    ):
        load_detector("nanodet_coco", weights=tmp_path / "other.bin")


@there["ssdlite_pedestrian"]
def test_people_are_found_in_a_photograph() -> None:
    spec = importlib.util.find_spec("ultralytics")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("the photograph is one of the package ultralytics")
    path = Path(spec.submodule_search_locations[0]) / "assets" / "bus.jpg"
    picture, _ = read_picture(path, downscale=1, background=(0.0, 0.0, 0.0))
    (detections,) = load_detector("ssdlite_pedestrian").detect(picture[None])
    assert detections.labels[:2] == ("person",) * 2
    assert float(detections.scores[1]) > 0.99
    torch.testing.assert_close(
        detections.boxes[0], torch.tensor([44.0, 410.0, 219.0, 916.0]), rtol=0, atol=2
    )


@pytest.mark.parametrize(
    "name", [case for case in each if "ssdlite_pedestrian" not in case.values]
)
def test_it_finds_what_is_to_be_seen(name: str, variant: str) -> None:
    detector = load_detector(name)
    what, scene, number = (
        ("car", "car_street", 0)
        if name == "ssd_openimages"
        else ("stop sign", "stop_sign", 4)
    )
    loaded = read_scene(SCENES / f"{scene}.xml")
    camera = list(loaded.cameras.values())[number]
    picture = quantise(Renderer(loaded.settings)(loaded.scene, camera).clamp(0, 1))
    (detections,) = detector.detect(picture[None])
    assert detections.labels[0] == what
    assert detections.scores[0] > 0.5
    assert (detections.scores[:-1] >= detections.scores[1:]).all()


@pytest.mark.parametrize("name", each)
def test_gradient_of_the_whole_chain_is_that_of_differences(name: str) -> None:
    """Image to the largest score: along a random direction, in float64."""
    detector = load(name)
    detector.model.double()
    generator = torch.Generator().manual_seed(0)
    image = (
        torch.rand(1, 64, 80, 3, generator=generator, dtype=torch.float64) * 0.6 + 0.2
    )

    def value(picture: Tensor) -> Tensor:
        (candidates,) = detector.candidates(picture)
        return candidates.scores.logsumexp((0, 1)) + candidates.boxes.mean() / 100

    # The step is shorter than from kink to kink of a million activations.
    slope_is_the_gradient(value, image, step=1e-7, rtol=3e-3)
