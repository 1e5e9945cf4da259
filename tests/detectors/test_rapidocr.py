"""A reader as a detector: it reads the clean sign of the example scene, and nothing
else is a sign to it.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from attacks.detectors import DetectorError, load_detector
from attacks.objectives.base import overlap
from attacks.observe.views import object_boxes
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import open_scene
from scenes.recipes.attack_reader import HEIGHT, WIDTH, Recogniser
from scenes.recipes.objects.textures import write

pytest.importorskip("rapidocr_onnxruntime", reason="the extra ocr is not installed")


def test_the_sign_is_read_where_it_is() -> None:
    opened = open_scene(Path("scenes/stop_sign.xml"))
    render = Renderer(opened.settings)
    cameras = [opened.cameras["front"], opened.cameras["low"]]
    boxes = object_boxes(
        opened.scene, opened.objects["stop_sign"], cameras, render=render
    )
    reader = load_detector("rapidocr")
    pictures = torch.stack(
        [render(opened.scene, camera).clamp(0, 1) for camera in cameras]
    )
    for seen, box in zip(reader.detect(pictures), boxes, strict=True):
        assert seen.labels == ("stop sign",)
        assert float(seen.scores[0]) > 0.9
        assert box is not None
        assert float(overlap(seen.boxes, box)[0]) > 0.8
    (considered,) = reader.candidates(pictures[:1])
    assert considered.scores.shape == (len(considered), 1)


def test_another_word_is_no_sign_and_a_gradient_is_refused(tmp_path: Path) -> None:
    reader = load_detector("rapidocr")
    pictures = np.full((2, 128, 256, 3), (0.6, 0.1, 0.1), dtype=np.float32)
    for picture, word in zip(pictures, ("SLOW", "STOP"), strict=True):
        write(picture, word, (0.95, 0.95, 0.94), box=(0.4, 0.3, 1.6, 0.7), weight=0.3)
    images = torch.from_numpy(pictures)
    assert [seen.labels for seen in reader.detect(images)] == [(), ("stop sign",)]
    with pytest.raises(
        DetectorError,
        match="expected no gradient requested from it, got images with one",
    ):
        reader.candidates(images.requires_grad_())
    with pytest.raises(DetectorError, match="leave --weights out"):
        load_detector("rapidocr", weights=tmp_path / "other.onnx")


def test_the_recognition_network_in_torch_is_that_of_onnx_and_has_a_gradient() -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    recogniser = Recogniser(load_detector("rapidocr"))
    words = (
        2 * torch.rand(2, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
        - 1
    )
    session = onnxruntime.InferenceSession(
        str(recogniser.path), providers=["CPUExecutionProvider"]
    )
    (expected,) = session.run(None, {session.get_inputs()[0].name: words.numpy()})
    shown = words[:1].requires_grad_(True)
    seen = recogniser(shown)
    assert np.abs(seen.detach().numpy() - expected[:1]).max() < 1e-4
    (slope,) = torch.autograd.grad(seen[0, :, 1].log().mean(), shown)
    assert float(slope.abs().max()) > 0
