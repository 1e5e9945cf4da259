"""`mi-splat select` by detections, boxes and masks of images: photographs of a set, and
renderings.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks import cli
from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.points import to_bytes
from mi_splat.render.renderer import Renderer
from mi_splat.selection.visibility import object_weight
from tests.datasets.sets import write_transforms
from tests.fakes import ColourDetector
from tests.selection.bare import CAR, bare_scene, iou

CAMERAS = [
    Camera(
        to_world=look_at((7.0 * x, 7.0 * y, height), (0.0, 0.0, 0.5)),
        lens=Lens(focal=110.0, size=(96, 80)),
    )
    for x, y, height in ((1, 0.2, 3), (0.2, 1, 5), (-1, 0.3, 3), (-0.4, -1, 4))
]


class Captured:
    """A splat, photographs of it, and where the car is in them."""

    def __init__(self, folder: Path) -> None:
        scene, owner = bare_scene()
        self.is_car = owner == CAR
        self.splat = folder / "desk.ply"
        self.photographs = folder / "photographs"
        save_splat(scene, self.splat)
        render = Renderer()
        images = [render(scene, camera).clamp(0, 1) for camera in CAMERAS]
        write_transforms(
            self.photographs,
            [
                View(camera, image)
                for camera, image in zip(CAMERAS, images, strict=True)
            ],
        )
        self.shown = [
            object_weight(scene, self.is_car, camera, render) >= 0.5
            for camera in CAMERAS
        ]

    @property
    def names(self) -> list[str]:
        return sorted(path.name for path in (self.photographs / "images").iterdir())


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    return Captured(tmp_path_factory.mktemp("captured"))


def selected(captured: Captured, words: Sequence[str], out: Path) -> Tensor:
    mask = out / "mask.npy"
    assert cli.main(["select", str(captured.splat), *words, "--out", str(mask)]) == 0
    return torch.from_numpy(np.load(mask))


def boxes_of(captured: Captured) -> list[list[int]]:
    boxes = []
    for shown in captured.shown:
        rows, columns = torch.nonzero(shown, as_tuple=True)
        corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        boxes.append([int(value) for value in corners])
    return boxes


def test_masks_of_photographs(
    captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "masks").mkdir()
    for name, shown in zip(captured.names[:3], captured.shown, strict=False):
        save_png(shown.numpy().astype(np.uint8), tmp_path / "masks" / name)
    words = ["--masks", str(tmp_path / "masks"), "--cameras", str(captured.photographs)]
    mask = selected(captured, words, tmp_path)
    assert iou(mask, captured.is_car) > 0.9
    output = capsys.readouterr()
    assert "masks of 3 of 4 images" in output.out
    assert "agrees with the outlines of 3 images: intersection over" in output.out
    assert "intersection over union" not in output.err


def test_boxes_of_photographs_and_their_doubts(
    captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = [
        {"image": name, "box": [4 * value for value in box], "size": [4 * 96, 4 * 80]}
        for name, box in zip(captured.names, boxes_of(captured), strict=True)
    ]
    save_json({"boxes": entries}, tmp_path / "boxes.json")
    words = ["--boxes", str(tmp_path / "boxes.json")]
    words += ["--cameras", str(captured.photographs)]
    mask = selected(captured, words, tmp_path)
    assert iou(mask, captured.is_car) > 0.9
    capsys.readouterr()
    mask_of_part = ["--box", "-9", "-9", "-9", "0", "9", "9"]
    whole = tmp_path / "half"
    whole.mkdir()
    half = selected(captured, [*words, *mask_of_part], whole)
    assert torch.equal(half & mask, half)
    assert "the object's outlines in 4 images differ" in capsys.readouterr().err


def test_detections_in_renderings(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    class Boxes(ColourDetector):
        """Reports the car's box of each image in turn."""

        def detect(self, images: Tensor) -> list:  # type: ignore[type-arg]
            from attacks.detectors.base import Detections

            asked.append(tuple(images.shape))
            box = boxes_of(captured)[len(asked) - 1]
            boxes = torch.tensor([[0, 0, 2, 2], box], dtype=torch.float32)
            return [Detections(boxes, torch.tensor([0.9, 0.6]), ("person", "car"))]

    monkeypatch.setattr("attacks.cli.options.load_detectors", lambda *_: [Boxes()])
    document = {
        "cameras": [
            {
                "name": str(number),
                "to_world": camera.to_world.tolist(),
                "focal": [110.0, 110.0],
                "principal": [48.0, 40.0],
                "size": [96, 80],
            }
            for number, camera in enumerate(CAMERAS)
        ]
    }
    save_json(document, tmp_path / "cameras.json")
    words = ["--detect", "car", "--cameras", str(tmp_path / "cameras.json")]
    mask = selected(captured, words, tmp_path)
    assert asked == [(1, 80, 96, 3)] * 4
    assert iou(mask, captured.is_car) > 0.9


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--masks", "nowhere"], "nowhere: expected a folder of masks"),
        (["--boxes", "boxes.json"], "1 boxes|2 images or more, got 1"),
        (["--detect", "elephant"], "--detect: expected one of"),
        (["--detect", "person"], "detections of person in 4 images: expected"),
    ],
)
def test_what_images_do_not_show(
    captured: Captured,
    words: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import re

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
    )
    entry = {"image": captured.names[0], "box": [10, 10, 50, 40]}
    Path("boxes.json").write_text(json.dumps({"boxes": [entry]}))
    command = ["select", str(captured.splat), *words]
    assert cli.main([*command, "--cameras", str(captured.photographs)]) == 1
    assert re.search(says, capsys.readouterr().err)


def test_masks_follow_the_lens_of_their_photographs(
    captured: Captured, tmp_path: Path
) -> None:
    from mi_splat.datasets import load_dataset

    views = load_dataset(captured.photographs, split=None, downscale=2)
    drawn = np.zeros((160, 192), np.float32)
    drawn[40:80, 60:120] = 1
    region = views.region(1, drawn)
    assert tuple(region.shape) == (40, 48)
    wanted = torch.zeros(40, 48)
    wanted[10:20, 15:30] = 1
    assert torch.equal(region, wanted)
    assert to_bytes(region).max() == 255
