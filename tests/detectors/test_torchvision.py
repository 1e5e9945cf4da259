"""The adapters to torchvision's detectors against the library itself, and what holds
for every detector.
"""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torchvision.models.detection import FCOS, RetinaNet
from torchvision.models.detection.anchor_utils import (
    AnchorGenerator,
    DefaultBoxGenerator,
)
from torchvision.models.detection.ssd import SSD, SSDHead
from torchvision.ops import FrozenBatchNorm2d, batched_nms, box_iou
from torchvision.ops.boxes import remove_small_boxes

from attacks.detectors import (
    DETECTORS,
    Candidates,
    Detections,
    DetectorError,
    fasterrcnn_small,
    load_detector,
)
from attacks.detectors.base import check_images
from attacks.detectors.catalogue import (
    BACKGROUND,
    COCO_CLASSES,
    SMALL_CLASSES,
    TORCHVISION_FILES,
)
from attacks.detectors.fasterrcnn_small import Backbone
from attacks.detectors.torchvision import (
    OneStageDetector,
    TorchvisionDetector,
    _build,
    _with_centreness,
    published_weights,
    wrap,
)
from attacks.detectors.weights import apply_weights, fingerprint
from attacks.testing import check_detector
from mi_splat.cameras.camera import Camera, orbit_pose, project_box
from mi_splat.cameras.lens import Lens
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.errors import InvalidValueError
from scenes.recipes.detector_surroundings import daylight, plain
from scenes.recipes.mesh_views import capture
from scenes.recipes.objects import build
from tests.detectors.contract import random_detector, slope_is_the_gradient, warm_up

LIGHT = ("fasterrcnn_small", "fasterrcnn_mobilenet_v3_large_320_fpn")


@pytest.fixture(scope="module", params=LIGHT)
def detector(request: pytest.FixtureRequest) -> TorchvisionDetector:
    small = random_detector(str(request.param), seed=1)
    small.model.transform.min_size = (128,)
    # the scores of a random network are small and alike
    small.model.roi_heads.score_thresh = 0.02
    small.model.eval()
    return small


def pictures(height: int = 96, width: int = 128, count: int = 2) -> Tensor:
    coarse = torch.rand((count, 3, 12, 16), generator=torch.Generator().manual_seed(5))
    smooth = nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return smooth.permute(0, 2, 3, 1).contiguous()


class CarPicture(NamedTuple):
    image: Tensor
    box: Tensor


@cache
def car_picture() -> CarPicture:
    """A path-traced car that no training used."""
    asset = build("car", 512_345)
    camera = Camera(
        to_world=orbit_pose((0.0, 0.0, 0.7), azimuth=40, elevation=20, distance=7.0),
        lens=Lens(focal=300, size=(256, 256)),
    )
    scene = scene_dict([asset], light=daylight(512_345), backdrop=plain(512_345))
    box = project_box(torch.from_numpy(asset.vertices), camera)
    assert box is not None
    return CarPicture(capture(scene, [camera], samples=8)[0].image, box[None])


def test_detect_is_the_librarys_forward_pass(detector: TorchvisionDetector) -> None:
    images = pictures()
    with torch.no_grad():
        expected = detector.model(list(images.permute(0, 3, 1, 2)))
    for ours, theirs in zip(detector.detect(images), expected, strict=True):
        assert len(ours) > 0
        assert torch.equal(ours.boxes, theirs["boxes"])
        assert torch.equal(ours.scores, theirs["scores"])
        assert len(ours.labels) == len(theirs["labels"])


def test_candidates_with_threshold_and_suppression_are_the_detections() -> None:
    detector = random_detector("fasterrcnn_small", seed=3)
    heads = detector.model.roi_heads
    heads.score_thresh = 0.05
    images = pictures(80, 112)
    with torch.no_grad():
        candidates = detector.candidates(images)
    for one, expected in zip(candidates, detector.detect(images), strict=True):
        boxes = one.boxes.reshape(-1, 4)
        scores = one.scores.reshape(-1)
        numbers = torch.arange(len(detector.classes)).repeat(len(one))
        likely = torch.where(scores > heads.score_thresh)[0]
        keep = likely[remove_small_boxes(boxes[likely], 1e-2)]
        keep = keep[
            batched_nms(boxes[keep], scores[keep], numbers[keep], heads.nms_thresh)
        ][: heads.detections_per_img]
        assert len(expected) > 0
        torch.testing.assert_close(boxes[keep], expected.boxes)
        torch.testing.assert_close(scores[keep], expected.scores)
        assert tuple(detector.classes[int(i)] for i in numbers[keep]) == expected.labels


def test_a_picture_of_another_size_gets_boxes_in_its_own_pixels() -> None:
    detector = load_detector("fasterrcnn_small")
    image = car_picture().image
    (small,) = detector.candidates(image[None])
    double = image.repeat_interleave(2, 0).repeat_interleave(2, 1)
    (large,) = detector.candidates(double[None])
    car = detector.classes.index("car")
    ours, theirs = (
        candidates.boxes[int(candidates.scores[:, car].argmax()), car]
        for candidates in (small, large)
    )
    assert float(ours.max()) <= 256
    assert float((2 * ours - theirs).abs().max()) < 6


class FixedProposals(nn.Module):
    """Always the same box, where the library's network proposes boxes that move with
    the image.
    """

    def forward(
        self, batch: Any, features: Any
    ) -> tuple[list[Tensor], dict[str, Tensor]]:
        return [torch.tensor([[50.0, 50.0, 240.0, 210.0]], dtype=torch.float64)], {}


def test_the_gradient_agrees_with_finite_differences() -> None:
    """Proposals are constant for the gradient, so they are held fixed for the
    differences.
    """
    detector = random_detector("fasterrcnn_small", seed=2)
    detector.model.double()
    detector.model.rpn = FixedProposals()

    def confidence(image: Tensor) -> Tensor:
        (candidates,) = detector.candidates(image)
        return candidates.scores[-1, 2] + 1e-3 * candidates.boxes[-1, 2].sum()

    slope_is_the_gradient(confidence, pictures(96, 96, 1).double().clamp(0.01, 0.99))


def test_rounding_is_no_reason_to_refuse_a_picture() -> None:
    check_images(torch.tensor([-5e-4, 1.0005, 0.5]).expand(1, 4, 4, 3))
    check_images(torch.zeros(1, 1, 1, 3))


def test_shapes_of_candidates_and_detections_are_checked() -> None:
    with pytest.raises(InvalidValueError, match="Candidates"):
        Candidates(torch.zeros(3, 2, 4), torch.zeros(2, 3))
    with pytest.raises(InvalidValueError, match="Detections"):
        Detections(torch.zeros(2, 4), torch.zeros(1), ("car",))
    with pytest.raises(InvalidValueError, match="Detections"):
        Detections(torch.zeros(1, 4), torch.zeros(2), ("car",))


# its package has the weights
@pytest.mark.parametrize("name", [name for name in DETECTORS if name != "rapidocr"])
def test_missing_weights_are_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(
        DetectorError,
        match=r"none\.pth: expected a (file.*|folder of .*), got nothing there",
    ):
        load_detector(name, weights=tmp_path / "none.pth")


class Strange:
    """An object that no library lets through a pickle; ultralytics lets paths, in the
    whole process.
    """


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (
            "w.bin",
            b"garbage",
            r"expected \.safetensors or \.pth or \.pt, got suffix '\.bin'",
        ),
        *(
            (f"w{suffix}", content, rf"expected a readable \{suffix} file")
            for suffix in (".pth", ".safetensors")
            for content in (b"garbage" * 9, b"")
        ),
        ("w.pth", {"model": Strange()}, r"expected a readable \.pth file"),
        ("w.pth", [torch.zeros(1)], "expected a dict of tensors by name, got list"),
    ],
)
def test_unusable_files_are_refused(
    tmp_path: Path, name: str, content: object, words: str
) -> None:
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    else:
        torch.save(content, tmp_path / name)
    with pytest.raises(DetectorError, match=words):
        load_detector("fasterrcnn_small", weights=tmp_path / name)


def test_a_wrong_state_dict_is_told_apart_by_its_keys(tmp_path: Path) -> None:
    state = random_detector("fasterrcnn_small").model.state_dict()
    state["backbone.stem.0.weight"] = torch.zeros(1)
    del state["rpn.head.cls_logits.bias"]
    state["other"] = torch.zeros(1)
    save_file(state, tmp_path / "w.safetensors")
    with pytest.raises(
        DetectorError,
        match=r"1 missing \(rpn\.head\.cls_logits\.bias\); 1 unexpected \(other\)",
    ) as caught:
        load_detector("fasterrcnn_small", weights=tmp_path / "w.safetensors")
    assert "1 missing (rpn.head.cls_logits.bias); 1 unexpected (other); " in str(
        caught.value
    )
    assert (
        "1 of another shape (backbone.stem.0.weight (1,) instead of (24, 3, 3, 3))"
        in str(caught.value)
    )


@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
def test_weights_make_the_round_trip_through_a_file(
    tmp_path: Path, suffix: str
) -> None:
    original = random_detector("fasterrcnn_small", seed=4)
    path = tmp_path / f"w.{suffix}"
    state = original.model.state_dict()
    if suffix == "pth":
        torch.save({"model": state, "epoch": 3}, path)
    else:
        save_file(state, path)
    loaded = load_detector("fasterrcnn_small", weights=path)
    (expected,), (candidates,) = (
        one.candidates(pictures(count=1)) for one in (original, loaded)
    )
    assert loaded.fingerprint == original.fingerprint
    # another memory format
    torch.testing.assert_close(candidates.scores, expected.scores, rtol=0, atol=1e-5)
    torch.testing.assert_close(candidates.boxes, expected.boxes, rtol=0, atol=1e-2)


def test_without_network_the_hub_gives_one_clear_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def unreachable(*_: object, **__: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", unreachable)
    with pytest.raises(
        DetectorError,
        match=r"no route to host; download the file .*: mi-splat detectors --get",
    ):
        load_detector("fasterrcnn_mobilenet_v3_large_320_fpn")


def test_the_shipped_detector_finds_a_car_that_it_was_not_trained_on() -> None:
    (detections,) = load_detector("fasterrcnn_small").detect(car_picture().image[None])
    assert detections.labels[0] == "car"
    assert float(detections.scores[0]) > 0.5
    assert float(box_iou(detections.boxes[:1], car_picture().box)) > 0.6


SMALL_LABELS = (BACKGROUND, *SMALL_CLASSES)


def small_retinanet() -> RetinaNet:
    anchors = AnchorGenerator(
        sizes=((28,), (56,), (112,), (200,)), aspect_ratios=((0.5, 1.0, 2.0),) * 4
    )
    return RetinaNet(
        Backbone(),
        len(SMALL_LABELS),
        anchor_generator=anchors,
        min_size=96,
        max_size=200,
    )


def small_fcos() -> FCOS:
    anchors = AnchorGenerator(
        sizes=((8,), (16,), (32,), (64,)), aspect_ratios=((1.0,),) * 4
    )
    return FCOS(
        Backbone(),
        len(SMALL_LABELS),
        anchor_generator=anchors,
        min_size=96,
        max_size=200,
    )


def small_ssd() -> SSD:
    anchors = DefaultBoxGenerator([[2], [2], [2], [2]])
    head = SSDHead(
        [Backbone().out_channels] * 4,
        anchors.num_anchors_per_location(),
        len(SMALL_LABELS),
    )
    return SSD(Backbone(), anchors, (128, 96), len(SMALL_LABELS), head=head)


SMALL = {"retinanet": small_retinanet, "fcos": small_fcos, "ssd": small_ssd}


def made(kind: str) -> OneStageDetector:
    """A small detector of warmed-up random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        model = SMALL[kind]()
        # otherwise all scores are the same to two digits
        for part in model.head.modules():
            if isinstance(part, nn.Conv2d):
                nn.init.kaiming_normal_(part.weight, nonlinearity="relu")
        warm_up(model.eval())
    detector = wrap(f"{kind}_small", model, SMALL_LABELS)
    assert isinstance(detector, OneStageDetector)
    return detector


@pytest.fixture(scope="module", params=list(SMALL))
def one_stage(request: pytest.FixtureRequest) -> OneStageDetector:
    return made(str(request.param))


def test_the_contract_is_kept(one_stage: OneStageDetector) -> None:
    """Random RetinaNet and FCOS may report the background, which then is a class as
    others are.
    """
    background = BACKGROUND if isinstance(one_stage.model, SSD) else "nothing"
    check_detector(wrap(one_stage.name, one_stage.model, (background, *SMALL_CLASSES)))
    assert one_stage.min_confidence == one_stage.model.score_thresh
    assert one_stage.classes == SMALL_CLASSES


@pytest.mark.parametrize("size", [(96, 128), (150, 75)])
def test_one_stage_detections_are_the_librarys(
    one_stage: OneStageDetector, size: tuple[int, int]
) -> None:
    images = pictures(*size)
    with torch.no_grad():
        expected = one_stage.model(list(images.permute(0, 3, 1, 2)))
    for ours, theirs in zip(one_stage.detect(images), expected, strict=True):
        assert len(ours) > 0
        assert torch.equal(ours.boxes, theirs["boxes"])
        assert torch.equal(ours.scores, theirs["scores"])
        assert ours.labels == tuple(
            one_stage._labels[i] for i in theirs["labels"].tolist()
        )


@pytest.mark.parametrize("size", [(96, 128), (150, 75)])
def test_one_stage_candidates_with_suppression_are_the_detections(
    one_stage: OneStageDetector, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the library's limits on how many go into the suppression, and on how many
    come out, out of the way.
    """
    model: Any = one_stage.model
    images = pictures(*size)
    with torch.no_grad():
        candidates = one_stage.candidates(images)
    ordered = torch.cat([one.scores.flatten() for one in candidates]).sort().values
    # between two of them, for the library rounds otherwise
    floor = float(ordered[-201:-199].mean())
    for name, value in (
        ("score_thresh", floor),
        ("topk_candidates", 10**6),
        ("detections_per_img", 10**6),
    ):
        monkeypatch.setattr(model, name, value)
    numbers = torch.arange(len(one_stage.classes))
    for one, expected in zip(candidates, one_stage.detect(images), strict=True):
        named = [
            i for i, label in enumerate(expected.labels) if label in one_stage.classes
        ]
        boxes = one.boxes.reshape(-1, 4)
        scores = one.scores.reshape(-1)
        of_class = numbers.repeat(len(one))
        likely = torch.where(scores > floor)[0]
        keep = likely[
            batched_nms(
                boxes[likely], scores[likely], of_class[likely], model.nms_thresh
            )
        ]
        assert 3 < len(named) == len(keep)
        torch.testing.assert_close(boxes[keep], expected.boxes[named])
        torch.testing.assert_close(scores[keep], expected.scores[named])
        assert [one_stage.classes[int(i)] for i in of_class[keep]] == [
            expected.labels[i] for i in named
        ]


def test_scores_and_boxes_agree_with_finite_differences() -> None:
    """Of the three ways to compute scores, along one direction, in double precision."""
    for kind in SMALL:
        detector = made(kind)
        detector.model.double()

        def measured(image: Tensor, detector: OneStageDetector = detector) -> Tensor:
            (candidates,) = detector.candidates(image)
            return candidates.scores[:, 2].sum() + 1e-3 * candidates.boxes[:, 2].sum()

        slope_is_the_gradient(
            measured, pictures(96, 96, 1).double().clamp(0.01, 0.99), least=1e-3
        )


def test_a_hopeless_candidate_of_fcos_keeps_a_finite_gradient() -> None:
    """The library's own square root has none where the product of the two rounds to
    zero.
    """
    logits = torch.full((1, 1, 1), -80.0, requires_grad=True)
    score = _with_centreness(
        {"cls_logits": logits, "bbox_ctrness": torch.full((1, 1, 1), -80.0)}
    )
    score.sum().backward()  # type: ignore[no-untyped-call]
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    torch.testing.assert_close(score.detach(), torch.full((1, 1, 1), -80.0).exp())


@pytest.mark.parametrize(
    "name",
    [
        "ssdlite320_mobilenet_v3_large",
        pytest.param("retinanet_resnet50_fpn", marks=pytest.mark.nightly),
    ],
)
def test_a_published_one_is_loaded_from_a_file(tmp_path: Path, name: str) -> None:
    original = random_detector(name, seed=2)
    torch.save(original.model.state_dict(), tmp_path / "w.pth")
    loaded = load_detector(name, weights=tmp_path / "w.pth")
    assert isinstance(loaded, OneStageDetector)
    assert loaded.classes == COCO_CLASSES
    assert loaded.fingerprint == original.fingerprint
    for one in (loaded, original):
        one.model.transform.min_size = (64,)
    (expected,), (candidates,) = (
        one.candidates(pictures(64, 80, 1)) for one in (original, loaded)
    )
    assert torch.equal(expected.scores, candidates.scores)
    assert torch.equal(expected.boxes, candidates.boxes)
    assert float(expected.scores.std()) > 1e-6
    frozen = [
        norm for norm in loaded.model.modules() if isinstance(norm, FrozenBatchNorm2d)
    ]
    assert {norm.eps for norm in frozen} == (
        {0.0} if name == "retinanet_resnet50_fpn" else set()
    )


def older(name: str) -> str:
    """The name of a tensor in the files that the library published before it gave these
    layers an index more.
    """
    name = re.sub(
        r"(head\.\w+_head\.conv)\.(\d)\.0\.",
        lambda old: f"{old[1]}.{2 * int(old[2])}.",
        name,
    )
    name = re.sub(r"((?:inner|layer)_blocks\.\d)\.0\.", r"\1.", name)
    return name.replace("rpn.head.conv.0.0.", "rpn.head.conv.")


@pytest.mark.parametrize("make", [small_retinanet, fasterrcnn_small.build])
def test_the_older_names_of_published_files_are_read(
    make: Callable[[], nn.Module],
) -> None:
    """The published RetinaNet and Faster R-CNN, which are of that time, have such
    names.
    """
    original = make()
    model = make()
    state = {older(name): value for name, value in original.state_dict().items()}
    assert len(state.keys() - original.state_dict().keys()) >= 6
    apply_weights(model, state, "a file")
    assert fingerprint(model.state_dict()) == fingerprint(original.state_dict())
    name = older(
        "head.classification_head.conv.1.0.weight"
        if isinstance(model, RetinaNet)
        else "rpn.head.conv.0.0.bias"
    )
    with pytest.raises(DetectorError, match=r"of another shape \(size mismatch for"):
        apply_weights(model, {**state, name: torch.zeros(3)}, "a file")


@pytest.mark.parametrize("name", TORCHVISION_FILES)
def test_a_published_model_has_as_many_weights_as_the_library_says(name: str) -> None:
    with torch.device("meta"):
        model = _build(name)
    frozen = [norm for norm in model.modules() if isinstance(norm, nn.BatchNorm2d)]
    count = sum(p.numel() for p in model.parameters())
    norms = sum(p.numel() for norm in frozen for p in norm.parameters())
    assert published_weights(name).meta["num_params"] in (count, count - norms)
