"""The adapter to DETR and RT-DETR against the library itself, with small networks of random weights."""

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from attacks.detectors import DetectorError, load_detector
from attacks.detectors.catalogue import COCO_CLASSES
from attacks.detectors.weights import keep_gradients_right
from tests.detectors.contract import check_detector, pictures, slope_is_the_gradient

try:
    from attacks.detectors import transformers as adapter
except DetectorError as error:
    pytest.skip(str(error), allow_module_level=True)

from transformers import (
    AutoConfig,
    DetrConfig,
    DetrForObjectDetection,
    DetrImageProcessor,
    ResNetConfig,
    RTDetrConfig,
    RTDetrForObjectDetection,
    RTDetrImageProcessor,
    RTDetrResNetConfig,
)

NAMES = {"detr": "detr_resnet50", "rt_detr": "rtdetr_r18vd"}
NARROW = {"embedding_size": 8, "hidden_sizes": [8, 16, 24, 32], "depths": [1, 1, 1, 1]}
TRANSFORMER = {
    **{"d_model": 16, "encoder_layers": 1, "decoder_layers": 2, "encoder_ffn_dim": 32, "decoder_ffn_dim": 32},
    **{"encoder_attention_heads": 2, "decoder_attention_heads": 2, "num_queries": 12},
}


def detr() -> tuple[Any, Any]:
    """Numbers with a gap, as in COCO: 0 and 2 mean nothing."""
    config = DetrConfig(
        use_timm_backbone=False,
        backbone_config=ResNetConfig(**NARROW, out_features=["stage4"]),
        id2label={0: "N/A", 1: "person", 2: "N/A", 3: "car", 4: "stop sign"},
        **TRANSFORMER,
    )
    return DetrForObjectDetection(config), DetrImageProcessor(size={"shortest_edge": 64, "longest_edge": 100})


def rt_detr() -> tuple[Any, Any]:
    """Every class of COCO, some by the names that the published configurations give them."""
    published = {coco: name for name, coco in adapter._COCO_NAMES.items()}
    config = RTDetrConfig(
        backbone_config=RTDetrResNetConfig(**NARROW, layer_type="basic", out_features=["stage2", "stage3", "stage4"]),
        **{"encoder_in_channels": [16, 24, 32], "decoder_in_channels": [16, 16, 16], "encoder_hidden_dim": 16},
        id2label={i: published.get(name, name) for i, name in enumerate(COCO_CLASSES)},
        **TRANSFORMER,
    )
    return RTDetrForObjectDetection(config), RTDetrImageProcessor(size={"height": 64, "width": 64})


MAKE: dict[str, Callable[[], tuple[Any, Any]]] = {"detr": detr, "rt_detr": rt_detr}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder in the library's own form for each, with weights that see something."""
    paths = {}
    for kind, make in MAKE.items():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            model, processor = make()
            for part in model.modules():
                if isinstance(part, nn.Linear):
                    nn.init.xavier_normal_(part.weight, gain=2.0)
                elif isinstance(part, nn.Conv2d):
                    nn.init.kaiming_normal_(part.weight)
            norms = [part for part in model.modules() if isinstance(part, nn.BatchNorm2d)]
            for norm in norms:
                norm.reset_running_stats()
                norm.momentum = None
                norm.train()
            with torch.no_grad():
                for _ in range(4):
                    model(pixel_values=torch.randn(2, 3, 64, 64))
        paths[kind] = tmp_path_factory.mktemp(kind)
        with adapter.loading("a test"):
            model.eval().save_pretrained(paths[kind])
        processor.save_pretrained(paths[kind])
    return paths


@pytest.fixture(scope="module", params=list(MAKE))
def detector(request: pytest.FixtureRequest, folders: dict[str, Path]) -> adapter.TransformersDetector:
    kind = str(request.param)
    loaded = load_detector(NAMES[kind], weights=folders[kind])
    assert isinstance(loaded, adapter.TransformersDetector)
    return loaded


def test_the_contract_is_kept(detector: adapter.TransformersDetector) -> None:
    sure = adapter.TransformersDetector(detector.name, detector.model, detector.processor, min_confidence=0.99)
    check_detector(sure)  # it reports numbers without a meaning otherwise, as its weights are random
    assert detector.min_confidence == 0.5
    assert detector.classes == (("person", "car", "stop sign") if "_resnet" in detector.name else COCO_CLASSES)


@pytest.mark.parametrize("size", [(64, 64), (50, 90), (200, 120)])
def test_detections_are_those_of_the_library(detector: adapter.TransformersDetector, size: tuple[int, int]) -> None:
    """The steps of the library's own example, from pictures of NumPy and 8 bits."""
    images = pictures(*size)
    arrays = [(image.numpy() * 255).round().astype("uint8") for image in images]
    inputs = detector.processor(images=arrays, return_tensors="pt")
    with torch.no_grad():
        outputs = detector.model(**inputs)
    low = adapter.TransformersDetector("x", detector.model, detector.processor, min_confidence=0.2)
    wanted = detector.processor.post_process_object_detection(outputs, 0.2, torch.tensor([size] * 2))
    for detections, other in zip(low.detect(images), wanted, strict=True):
        order = other["scores"].argsort(descending=True, stable=True)
        assert len(detections) == len(order) > 0
        assert torch.equal(detections.boxes, other["boxes"][order])
        assert torch.equal(detections.scores, other["scores"][order])
        assert detections.labels == tuple(detector._labels[number] for number in other["labels"][order].tolist())
        assert all(float(score) > 0.2 for score in detections.scores)


@pytest.mark.parametrize("size", [(64, 64), (50, 90), (200, 120)])
def test_the_network_s_input_is_the_image_processor_s(
    detector: adapter.TransformersDetector, size: tuple[int, int]
) -> None:
    """But for the rounding of the scaled picture to 8 bits, which is at most one step of 255."""
    images = pictures(*size)
    expected = detector.processor(
        images=list((images.permute(0, 3, 1, 2) * 255).round().to(torch.uint8)), return_tensors="pt"
    )
    prepared = detector._network_input(images)
    assert prepared.keys() == expected.keys()
    step = 1 / 255 / (min(detector.processor.image_std) if detector.processor.do_normalize else 1.0)
    away = (prepared["pixel_values"] - expected["pixel_values"]).abs()
    assert float(away.max()) <= 1.01 * step
    assert float(away.mean()) < 0.4 * step
    if size == (64, 64):  # nothing to scale
        assert float(away.max()) < 1e-5


def test_candidates_are_what_detections_come_from(detector: adapter.TransformersDetector) -> None:
    """For a picture that is not scaled, so that nothing is rounded."""
    images = pictures(64, 64)
    low = adapter.TransformersDetector("x", detector.model, detector.processor, min_confidence=0.2)
    for candidates, reported in zip(low.candidates(images), low.detect(images), strict=True):
        for box, score, label in zip(reported.boxes, reported.scores, reported.labels, strict=True):
            if label in low.classes:
                column = low.classes.index(label)
                away = (candidates.boxes[:, column] - box).abs().amax(1) + (candidates.scores[:, column] - score).abs()
                assert float(away.min()) < 1e-3
        assert len(candidates) == 12
        assert candidates.scores.shape == (12, len(low.classes))


def test_the_gradient_agrees_with_finite_differences(detector: adapter.TransformersDetector) -> None:
    """Of scores and boxes, along one direction, in double precision; what RT-DETR holds constant in training too."""
    double = adapter.TransformersDetector("x", copy.deepcopy(detector.model).double(), detector.processor)
    image = pictures(50, 90, 1).double().clamp(0.01, 0.99)
    for part in ("scores", "boxes"):

        def measured(at: Tensor, part: str = part) -> Tensor:
            (candidates,) = double.candidates(at)
            return (candidates.scores[:, 1] if part == "scores" else candidates.boxes[:, 1]).sum()

        slope_is_the_gradient(measured, image, step=1e-7, rtol=1e-3, least=1e-5)


def test_weights_of_another_architecture_are_refused(folders: dict[str, Path]) -> None:
    with pytest.raises(DetectorError, match=r"expected a rt_detr, got a detr; pass a folder of rtdetr_r18vd"):
        load_detector("rtdetr_r18vd", weights=folders["detr"])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ("no processor", "got no preprocessor_config.json in .*; save model and image processor"),
        ("no weights", "expected a folder of config.json, .*, got .*model.safetensors"),
        ("broken weights", "expected a folder of config.json, .*, got "),
        ("broken configuration", "expected a folder of config.json, .*, got "),
        ("a tensor less", r"expected the model's tensors, got 1 missing \(bbox_predictor"),
        ("timm", "got one whose backbone needs the package timm; pip install timm"),
    ],
)
def test_folders_that_do_not_fit_are_refused(
    folders: dict[str, Path], tmp_path: Path, damage: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(folders["detr"], tmp_path / "copy")
    if damage == "no processor":
        (folder / "preprocessor_config.json").unlink()
    elif damage == "no weights":
        (folder / "model.safetensors").unlink()
    elif damage == "broken weights":
        (folder / "model.safetensors").write_bytes(b"garbage")
    elif damage == "broken configuration":
        (folder / "config.json").write_text('{"model_type": "detr", ')
    elif damage == "a tensor less":
        state = load_file(folder / "model.safetensors")
        del state["bbox_predictor.layers.0.bias"]
        save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    else:
        config = json.loads((folder / "config.json").read_text())
        config["backbone_config"] = {"model_type": "timm_backbone", "backbone": "resnet50"}
        (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(DetectorError, match=words):
        load_detector("detr_resnet50", weights=folder)


def test_without_network_the_hub_gives_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(**_: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setattr(AutoConfig, "from_pretrained", unreachable)
    with pytest.raises(DetectorError, match="or a network that reaches the library's hub, got no route to host"):
        load_detector("rtdetr_r50vd")


# The gradient of BatchNorm for a gradient in the order of tokens, as attention gives it


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("layout", ["rows", "tokens", "channels last"])
def test_the_gradient_is_the_scale_of_each_channel(batch: int, layout: str) -> None:
    generator = torch.Generator().manual_seed(0)
    norm = nn.BatchNorm2d(5).eval()
    variance = torch.rand(5, generator=generator) + 0.5
    norm.running_var = variance
    nn.init.uniform_(norm.weight, 0.5, 2, generator=generator)
    keep_gradients_right(nn.Sequential(norm))
    picture = torch.randn(batch, 5, 3, 4, generator=generator).requires_grad_()
    gradient = torch.randn(batch, 5, 3, 4, generator=generator)
    expected = gradient * (norm.weight / torch.sqrt(variance + norm.eps)).view(5, 1, 1)
    if layout == "tokens":
        gradient = gradient.flatten(2).transpose(1, 2).contiguous().transpose(1, 2).view(batch, 5, 3, 4)
    elif layout == "channels last":
        gradient = gradient.contiguous(memory_format=torch.channels_last)
    (computed,) = torch.autograd.grad(norm(picture), picture, gradient)
    torch.testing.assert_close(computed, expected)
