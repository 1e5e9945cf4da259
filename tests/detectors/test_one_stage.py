"""The adapter to torchvision's one-stage detectors against the library itself, with random weights."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torchvision.models.detection import FCOS, RetinaNet
from torchvision.models.detection.anchor_utils import AnchorGenerator, DefaultBoxGenerator
from torchvision.models.detection.ssd import SSD, SSDHead
from torchvision.ops import FrozenBatchNorm2d, batched_nms

from attacks.detectors import Detector, DetectorError, load_detector, small
from attacks.detectors.classes import BACKGROUND, COCO_CLASSES, SMALL_CLASSES
from attacks.detectors.small import Backbone
from attacks.detectors.torchvision import OneStageDetector, random_detector, wrap
from attacks.detectors.torchvision.loading import warm_up
from attacks.detectors.torchvision.one_stage import _with_centreness
from attacks.detectors.torchvision.published import PUBLISHED
from attacks.detectors.weights import apply_weights, fingerprint, read_weights
from mi_splat.errors import InvalidValueError

SMALL_LABELS = (BACKGROUND, *SMALL_CLASSES)


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def small_retinanet() -> RetinaNet:
    anchors = AnchorGenerator(sizes=((28,), (56,), (112,), (200,)), aspect_ratios=((0.5, 1.0, 2.0),) * 4)
    return RetinaNet(Backbone(), len(SMALL_LABELS), anchor_generator=anchors, min_size=96, max_size=200)


def small_fcos() -> FCOS:
    anchors = AnchorGenerator(sizes=((8,), (16,), (32,), (64,)), aspect_ratios=((1.0,),) * 4)
    return FCOS(Backbone(), len(SMALL_LABELS), anchor_generator=anchors, min_size=96, max_size=200)


def small_ssd() -> SSD:
    anchors = DefaultBoxGenerator([[2], [2], [2], [2]])
    head = SSDHead([Backbone().out_channels] * 4, anchors.num_anchors_per_location(), len(SMALL_LABELS))
    return SSD(Backbone(), anchors, (128, 96), len(SMALL_LABELS), head=head)


SMALL = {"retinanet": small_retinanet, "fcos": small_fcos, "ssd": small_ssd}


def made(kind: str) -> OneStageDetector:
    """A small detector of warmed-up random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        model = SMALL[kind]()
        for part in model.head.modules():  # otherwise all scores are the same to two digits
            if isinstance(part, nn.Conv2d):
                nn.init.kaiming_normal_(part.weight, nonlinearity="relu")
        warm_up(model.eval())
    detector = wrap(f"{kind}_small", model, SMALL_LABELS)
    assert isinstance(detector, OneStageDetector)
    return detector


@pytest.fixture(scope="module", params=list(SMALL))
def detector(request: pytest.FixtureRequest) -> OneStageDetector:
    return made(str(request.param))


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    coarse = torch.rand((count, 3, 12, 16), generator=torch.Generator().manual_seed(5))
    smooth = nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return smooth.permute(0, 2, 3, 1).contiguous()


def test_the_protocol_holds(detector: OneStageDetector) -> None:
    assert isinstance(detector, Detector)
    assert not detector.model.training
    assert not any(p.requires_grad for p in detector.model.parameters())
    assert len(detector.fingerprint) == 16
    assert detector.min_confidence == detector.model.score_thresh
    assert detector.classes == SMALL_CLASSES


@pytest.mark.parametrize("size", [(96, 128), (150, 75)])
def test_detect_is_the_librarys_forward_pass(detector: OneStageDetector, size: tuple[int, int]) -> None:
    images = pictures(*size)
    with torch.no_grad():
        expected = detector.model(list(images.permute(0, 3, 1, 2)))
    for ours, theirs in zip(detector.detect(images), expected, strict=True):
        assert len(ours) > 0
        assert torch.equal(ours.boxes, theirs["boxes"])
        assert torch.equal(ours.scores, theirs["scores"])
        assert ours.labels == tuple(detector._labels[i] for i in theirs["labels"].tolist())


@pytest.mark.parametrize("size", [(96, 128), (150, 75)])
def test_candidates_with_suppression_are_the_detections(
    detector: OneStageDetector, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the library's limits on how many go into the suppression, and on how many come out, out of the way."""
    model: Any = detector.model
    images = pictures(*size)
    with torch.no_grad():
        candidates = detector.candidates(images)
    ordered = torch.cat([one.scores.flatten() for one in candidates]).sort().values
    floor = float(ordered[-201:-199].mean())  # between two of them, for the library rounds otherwise
    for name, value in (("score_thresh", floor), ("topk_candidates", 10**6), ("detections_per_img", 10**6)):
        monkeypatch.setattr(model, name, value)
    numbers = torch.arange(len(detector.classes))
    for one, expected in zip(candidates, detector.detect(images), strict=True):
        named = [i for i, label in enumerate(expected.labels) if label in detector.classes]
        boxes, scores = one.boxes.reshape(-1, 4), one.scores.reshape(-1)
        of_class = numbers.repeat(len(one))
        likely = torch.where(scores > floor)[0]
        keep = likely[batched_nms(boxes[likely], scores[likely], of_class[likely], model.nms_thresh)]
        assert 3 < len(named) == len(keep)
        torch.testing.assert_close(boxes[keep], expected.boxes[named])
        torch.testing.assert_close(scores[keep], expected.scores[named])
        assert [detector.classes[int(i)] for i in of_class[keep]] == [expected.labels[i] for i in named]


def test_candidates_lie_inside_the_picture(detector: OneStageDetector) -> None:
    (found,) = detector.candidates(pictures(150, 75, 1))
    assert float(found.boxes.min()) == 0
    assert float(found.boxes[..., 0::2].max()) == pytest.approx(75, abs=1e-3)
    assert float(found.boxes[..., 1::2].max()) == pytest.approx(150, abs=1e-3)


def test_scores_and_boxes_agree_with_finite_differences() -> None:
    """Of the three ways to compute scores, along one direction, in double precision."""
    direction = torch.randn((1, 96, 96, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for kind in SMALL:
        detector = made(kind)
        detector.model.double()

        def measured(image: Tensor, detector: OneStageDetector = detector) -> Tensor:
            (candidates,) = detector.candidates(image)
            return candidates.scores[:, 2].sum() + 1e-3 * candidates.boxes[:, 2].sum()

        image = pictures(96, 96, 1).double().clamp(0.01, 0.99)
        leaf = image.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(measured(leaf), leaf)
        step = 1e-6
        with torch.no_grad():
            slope = (measured(image + step * direction) - measured(image - step * direction)) / (2 * step)
        assert float(slope.abs()) > 1e-3, kind
        torch.testing.assert_close((gradient * direction).sum(), slope, rtol=1e-4, atol=1e-8, msg=kind)


def test_gradients_reach_each_picture_for_itself(detector: OneStageDetector) -> None:
    images = pictures(96, 128).requires_grad_()
    detector.candidates(images)[0].scores[:, 0].max().backward()  # type: ignore[no-untyped-call]
    assert images.grad is not None
    assert float(images.grad[0].abs().max()) > 1e-6
    assert float(images.grad[1].abs().max()) == 0


def test_a_hopeless_candidate_of_fcos_keeps_a_finite_gradient() -> None:
    """The library's own square root has none where the product of the two rounds to zero."""
    logits = torch.full((1, 1, 1), -80.0, requires_grad=True)
    score = _with_centreness({"cls_logits": logits, "bbox_ctrness": torch.full((1, 1, 1), -80.0)})
    score.sum().backward()  # type: ignore[no-untyped-call]
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    torch.testing.assert_close(score.detach(), torch.full((1, 1, 1), -80.0).exp())


@pytest.mark.parametrize("kind", SMALL)
def test_weights_make_the_round_trip_through_a_file(tmp_path: Path, kind: str) -> None:
    original = made(kind)
    save_file(original.model.state_dict(), tmp_path / "w.safetensors")
    model = SMALL[kind]()
    apply_weights(model, read_weights(tmp_path / "w.safetensors"), tmp_path)
    (expected,) = original.candidates(pictures(96, 96, 1))
    loaded = wrap(original.name, model, SMALL_LABELS)
    (found,) = loaded.candidates(pictures(96, 96, 1))
    assert torch.equal(expected.scores, found.scores)
    assert torch.equal(expected.boxes, found.boxes)
    assert loaded.fingerprint == original.fingerprint


@pytest.mark.parametrize("name", ["retinanet_resnet50_fpn", "ssdlite320_mobilenet_v3_large"])
def test_a_published_one_is_loaded_from_a_file(tmp_path: Path, name: str) -> None:
    original = random_detector(name, seed=2)
    torch.save(original.model.state_dict(), tmp_path / "w.pth")
    loaded = load_detector(name, weights=tmp_path / "w.pth")
    assert isinstance(loaded, OneStageDetector)
    assert loaded.classes == COCO_CLASSES
    assert loaded.fingerprint == original.fingerprint
    for one in (loaded, original):
        one.model.transform.min_size = (64,)
    (expected,), (found,) = (one.candidates(pictures(64, 80, 1)) for one in (original, loaded))
    assert torch.equal(expected.scores, found.scores)
    assert torch.equal(expected.boxes, found.boxes)
    assert float(expected.scores.std()) > 1e-6
    frozen = [norm for norm in loaded.model.modules() if isinstance(norm, FrozenBatchNorm2d)]
    assert {norm.eps for norm in frozen} == ({0.0} if name == "retinanet_resnet50_fpn" else set())


def older(name: str) -> str:
    """The name of a tensor in the files that the library published before it gave these layers an index more."""
    name = re.sub(r"(head\.\w+_head\.conv)\.(\d)\.0\.", lambda old: f"{old[1]}.{2 * int(old[2])}.", name)
    name = re.sub(r"((?:inner|layer)_blocks\.\d)\.0\.", r"\1.", name)
    return name.replace("rpn.head.conv.0.0.", "rpn.head.conv.")


@pytest.mark.parametrize("make", [small_retinanet, small.build])
def test_the_older_names_of_published_files_are_read(make: Callable[[], nn.Module]) -> None:
    """The published RetinaNet and Faster R-CNN, which are of that time, have such names."""
    original, model = make(), make()
    state = {older(name): value for name, value in original.state_dict().items()}
    assert len(state.keys() - original.state_dict().keys()) >= 6
    apply_weights(model, state, "a file")
    assert fingerprint(model.state_dict()) == fingerprint(original.state_dict())
    name = older(
        "head.classification_head.conv.1.0.weight" if isinstance(model, RetinaNet) else "rpn.head.conv.0.0.bias"
    )
    with pytest.raises(DetectorError, match=r"of another shape \(size mismatch for"):
        apply_weights(model, {**state, name: torch.zeros(3)}, "a file")


def test_weights_of_another_architecture_are_refused(tmp_path: Path) -> None:
    save_file(small_fcos().state_dict(), tmp_path / "w.safetensors")
    with pytest.raises(DetectorError, match=r"expected the \d+ tensors of SSD, got \d+ missing .*; \d+ unexpected"):
        load_detector("ssdlite320_mobilenet_v3_large", weights=tmp_path / "w.safetensors")


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_model_has_as_many_weights_as_the_library_says(name: str) -> None:
    with torch.device("meta"):
        model = PUBLISHED[name].builder(weights=None, weights_backbone=None)
    frozen = [norm for norm in model.modules() if isinstance(norm, nn.BatchNorm2d)]
    count = sum(p.numel() for p in model.parameters())
    norms = sum(p.numel() for norm in frozen for p in norm.parameters())
    assert PUBLISHED[name].weights.meta["num_params"] in (count, count - norms)


def test_pictures_of_another_shape_are_refused(detector: OneStageDetector) -> None:
    with pytest.raises(InvalidValueError, match="images: expected floating point"):
        detector.candidates(torch.zeros(1, 3, 96, 96))
    with pytest.raises(InvalidValueError, match="images"):
        detector.detect(torch.full((1, 32, 32, 3), 255.0))


def test_a_model_of_another_kind_is_refused() -> None:
    with pytest.raises(TypeError, match="RetinaNet, FCOS or SSD expected, got Linear"):
        wrap("x", nn.Linear(1, 1), SMALL_LABELS)
