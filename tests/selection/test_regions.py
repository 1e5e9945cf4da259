"""Gaussians that regions of images select: votes by weight, outlines in boxes, and the
boxes of one object among others.
"""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.selection.agreement import agreement, box_fit, disagreements
from mi_splat.selection.association import associated
from mi_splat.selection.boxes import DrawnBox, DrawnBoxes, load_boxes, of_image
from mi_splat.selection.config import Selection
from mi_splat.selection.outlines import BoxedImage, outlines_in_boxes
from mi_splat.selection.regions import ImageRegion, shares, vote
from mi_splat.selection.select import select
from mi_splat.selection.visibility import object_weight
from tests.selection.bare import CAR, GROUND, SIGN, bare_scene, iou

CAMERAS = [
    Camera(
        to_world=look_at((7.0 * x, 7.0 * y, height), (0.0, 0.8, 0.4)),
        lens=Lens(focal=100.0, size=(96, 80)),
    )
    for x, y, height in (
        (1.0, 0.2, 3.0),
        (0.2, 1.0, 5.0),
        (-1.0, 0.3, 3.0),
        (-0.4, -1.0, 4.0),
        (0.6, -0.8, 2.0),
    )
]


class Bare:
    """The scene, the owner of each Gaussian, and what each object shows."""

    def __init__(self) -> None:
        self.scene, self.owner = bare_scene()
        self.render = Renderer()

    def shown(self, owner: int) -> list[Tensor]:
        return [
            (object_weight(self.scene, self.owner == owner, camera, self.render) >= 0.5)
            for camera in CAMERAS
        ]

    def regions(self, owner: int) -> list[ImageRegion]:
        return [
            ImageRegion(camera=camera, inside=shown.float())
            for camera, shown in zip(CAMERAS, self.shown(owner), strict=True)
        ]

    def boxes(self, owner: int) -> list[Tensor]:
        return [around(shown) for shown in self.shown(owner)]


def around(shown: Tensor) -> Tensor:
    """(4,) the box around the pixels of an object."""
    rows, columns = torch.nonzero(shown, as_tuple=True)
    corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return torch.stack(corners).float()


@pytest.fixture(scope="module")
def bare() -> Bare:
    return Bare()


@pytest.mark.parametrize("owner", [CAR, SIGN])
def test_masks_select_the_object_without_the_ground_behind_it(
    bare: Bare, owner: int
) -> None:
    mask = vote(bare.scene, bare.regions(owner), render=bare.render)
    assert iou(mask, bare.owner == owner) > 0.93


def test_an_image_without_the_object_is_outvoted(bare: Bare) -> None:
    regions = bare.regions(CAR)
    wrong = ImageRegion(camera=CAMERAS[2], inside=0 * regions[2].inside)
    mask = vote(bare.scene, [*regions[:2], wrong, *regions[3:]], render=bare.render)
    assert iou(mask, bare.owner == CAR) > 0.9
    strict = vote(
        bare.scene,
        [*regions[:2], wrong, *regions[3:]],
        render=bare.render,
        least=0.95,
    )
    assert iou(strict, bare.owner == CAR) < 0.6


def test_shares_count_only_images_that_show_a_gaussian(bare: Bare) -> None:
    regions = bare.regions(CAR)
    share = shares(bare.scene, regions, render=bare.render)
    away = Camera(
        to_world=look_at((20.0, 0.0, 2.0), (40.0, 0.0, 2.0)), lens=CAMERAS[0].lens
    )
    empty = ImageRegion(camera=away, inside=torch.zeros(80, 96))
    torch.testing.assert_close(
        shares(bare.scene, [*regions, empty], render=bare.render), share
    )
    assert float(share.min()) >= 0
    assert float(share.max()) <= 1 + 1e-5


def test_boxes_are_cut_along_the_object(bare: Bare) -> None:
    boxed = boxed_images(bare, [box[None] for box in bare.boxes(CAR)])
    mask, outlines = outlines_in_boxes(bare.scene, boxed, render=bare.render)
    assert iou(mask, bare.owner == CAR) > 0.9
    hull = [ImageRegion.of_box(item.camera, item.boxes[0].tolist()) for item in boxed]
    loose = vote(bare.scene, hull, render=bare.render, least=0.9)
    ground = bare.owner == GROUND
    assert int((mask & ground).sum()) < int((loose & ground).sum())
    for outline, shown in zip(outlines, bare.shown(CAR), strict=True):
        assert outline is not None
        assert iou(outline.inside >= 0.5, shown) > 0.7


def boxed_images(bare: Bare, boxes: list[Tensor]) -> list[BoxedImage]:
    return [
        BoxedImage(
            camera=camera,
            image=bare.render(bare.scene, camera).clamp(0, 1),
            boxes=found,
        )
        for camera, found in zip(CAMERAS, boxes, strict=True)
    ]


def test_boxes_of_another_object_are_left_out(bare: Bare) -> None:
    cars = bare.boxes(CAR)
    signs = bare.boxes(SIGN)
    boxes = [
        torch.stack([cars[0], signs[0]]),
        torch.stack([signs[1], cars[1]]),
        cars[2][None],
        torch.stack([cars[3], signs[3]]),
        torch.tensor([[0.0, 0.0, 5.0, 5.0]]),
    ]
    chosen = associated(bare.scene.means, CAMERAS, boxes)
    assert chosen == [0, 1, 0, 0, None]


def test_a_region_fits_its_camera_and_one_is_too_few(bare: Bare) -> None:
    with pytest.raises(InvalidValueError, match=r"inside: expected shape \(80, 96\)"):
        ImageRegion(camera=CAMERAS[0], inside=torch.zeros(96, 80))
    with pytest.raises(InvalidValueError, match="2 images or more, got 1"):
        vote(bare.scene, bare.regions(CAR)[:1], render=bare.render)
    box = ImageRegion.of_box(CAMERAS[0], (10, 20, 30, 24)).inside
    assert int(box.sum()) == 20 * 4
    assert bool(box[20, 10])
    assert not bool(box[24, 10])


def test_a_click_chooses_among_what_images_select(bare: Bare) -> None:
    found = (bare.owner == CAR) | (bare.owner == SIGN)
    camera = CAMERAS[0]
    row, column = torch.nonzero(bare.shown(SIGN)[0])[40].tolist()
    clicked = Selection(detect=("car",), click=(f"{column},{row}",), planes=0)
    mask = select(bare.scene, clicked, camera=camera, render=bare.render, found=found)
    assert iou(mask, bare.owner == SIGN) > 0.9
    with pytest.raises(InvalidValueError, match="a pixel of what the images select"):
        select(
            bare.scene,
            clicked,
            camera=camera,
            render=bare.render,
            found=bare.owner == CAR,
        )
    with pytest.raises(InvalidValueError, match="what the images say"):
        select(bare.scene, Selection(detect=("car",)))


def test_doubts_count_pixels_beside_the_outline(bare: Bare) -> None:
    regions = {str(number): item for number, item in enumerate(bare.regions(CAR))}
    right = agreement(bare.scene, bare.owner == CAR, regions, render=bare.render)
    assert all(item.iou == 1 and item.outside == 0 for item in right.values())
    assert disagreements(right) == []
    all_of_it = torch.ones(len(bare.scene), dtype=torch.bool)
    wrong = agreement(bare.scene, all_of_it, regions, render=bare.render)
    texts = disagreements(wrong)
    assert len(texts) == 2
    assert "intersection over union" in texts[0]
    assert "outside" in texts[1]
    assert disagreements({}) == []


def test_an_outline_fills_its_box() -> None:
    inside = torch.zeros(20, 30)
    assert box_fit(inside, torch.tensor([[0.0, 0.0, 9.0, 9.0]])) == 0
    inside[4:14, 5:25] = 1
    boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [5.0, 4.0, 25.0, 24.0]])
    assert box_fit(inside, boxes) == pytest.approx(0.5)
    assert box_fit(inside, torch.tensor([[5.0, 4.0, 25.0, 14.0]])) == 1


def test_files_of_boxes_come_back(tmp_path: Path) -> None:
    drawn = DrawnBoxes(
        boxes=(
            DrawnBox(image="a.jpg", box=(1, 2, 30.5, 40), size=(60, 50)),
            DrawnBox(image="b", box=(0, 0, 3, 4)),
        ),
        cameras={"b": CAMERAS[0]},
    )
    save_json(drawn.document(), tmp_path / "boxes.json")
    read = load_boxes(tmp_path / "boxes.json")
    assert read.boxes == drawn.boxes
    assert torch.equal(read.cameras["b"].to_world, CAMERAS[0].to_world)
    assert of_image(read.boxes, "a") == [drawn.boxes[0]]
    assert of_image(read.boxes, "a.jpg") == [drawn.boxes[0]]
    assert of_image(read.boxes, "c") == []


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ({}, "1 to 10,000 boxes, got 0"),
        ({"boxes": [{"image": "a", "box": [1, 2, 3]}]}, "4 to 4 finite numbers"),
        ({"boxes": [{"image": "a", "box": [3, 2, 1, 4]}]}, "x0 < x1"),
        ({"boxes": [{"image": 3, "box": [0, 0, 1, 1]}]}, "a string"),
        ({"boxes": [{"image": "a", "box": [0, 0, 1, 1], "size": [0, 5]}]}, "whole"),
        ({"boxes": "none"}, "a list of objects"),
    ],
)
def test_files_that_hold_no_boxes(
    document: dict[str, object], says: str, tmp_path: Path
) -> None:
    save_json(document, tmp_path / "boxes.json")
    with pytest.raises(InvalidValueError, match=says):
        load_boxes(tmp_path / "boxes.json")


def test_the_scene_is_not_changed(bare: Bare) -> None:
    scene: GaussianScene = bare.scene
    before = [value.clone() for value in scene.tensors()]
    vote(scene, bare.regions(CAR)[:2], render=bare.render)
    assert all(
        torch.equal(value, kept)
        for value, kept in zip(scene.tensors(), before, strict=True)
    )
