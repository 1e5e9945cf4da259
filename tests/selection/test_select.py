"""From selectors to Gaussians: on a toy, and on a splat of shipped objects without
parts.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import save_splat
from mi_splat.io.points import PointCloud, save_points
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, merge
from mi_splat.selection.clusters import clusters
from mi_splat.selection.config import Selection
from mi_splat.selection.select import (
    doubts,
    load_mask,
    require_visible,
    save_mask,
    select,
)
from mi_splat.selection.visibility import contributions, object_weight, pixel_weights
from tests.fakes import blobs, camera, toy_scene
from tests.gaussians import random_scene
from tests.selection.bare import CAR, GROUND, SIGN, bare_scene, ground, iou
from tests.selection.test_clusters import gaussians, shell


@pytest.fixture(scope="module")
def bare() -> tuple[GaussianScene, Tensor]:
    return bare_scene()


def above(size: int = 96) -> Camera:
    """Looks down at the car and the sign."""
    return Camera(
        to_world=look_at((7.0, 4.0, 5.0), (0.0, 0.8, 0.4)),
        lens=Lens(focal=float(size), size=(size, size)),
    )


def pixel_of(point: tuple[float, float, float], view: Camera) -> str:
    """The pixel that shows a point, as `Selection.click` has it."""
    local = view.to_camera @ torch.tensor([*point, 1.0], dtype=torch.float64)
    column = int(view.fx * local[0] / local[2] + view.cx)
    row = int(view.fy * local[1] / local[2] + view.cy)
    return f"{column},{row}"


@pytest.mark.parametrize("renderer", ["fake", "tile"])
def test_a_pixel_is_made_of_weights(renderer: str, variant: str) -> None:
    scene, mask = toy_scene()
    render = blobs if renderer == "fake" else Renderer()
    weight = object_weight(scene, mask, camera(), render)
    for x, y in ((16, 16), (20, 14), (13, 19)):
        weights = pixel_weights(scene, camera(), (x, y), render)
        assert float(weights.min()) >= -1e-6
        assert float(weights[mask].sum()) == pytest.approx(
            float(weight[y, x]), abs=1e-5
        )


@pytest.mark.parametrize(
    ("selection", "owner"),
    [
        (Selection(box=(-2.6, -1.2, 0.03, 2.6, 1.2, 2.0)), CAR),
        (Selection(box=(0.2, 2.1, 0.02, 0.5, 3.2, 2.0)), SIGN),
        (Selection(cluster=1), CAR),
        (Selection(cluster=2), GROUND),
        (Selection(cluster=3), SIGN),
        (Selection(click=(pixel_of((2.2, 0.0, 0.7), above()),)), CAR),
        (Selection(click=(pixel_of((0.0, 0.4, 1.3), above()),)), CAR),
        (Selection(click=(pixel_of((0.35, 2.6, 0.45), above()),)), SIGN),
    ],
    ids=lambda value: (
        str(value.as_dict()) if isinstance(value, Selection) else str(value)
    ),
)
def test_the_right_object_is_found(
    selection: Selection, owner: int, bare: tuple[GaussianScene, Tensor], variant: str
) -> None:
    scene, owners = bare
    mask = select(scene, selection, camera=above(), render=Renderer())
    assert iou(mask, owners == owner) > 0.95


def test_two_clicks_select_both_and_two_selectors_what_is_in_both(
    bare: tuple[GaussianScene, Tensor], variant: str
) -> None:
    scene, owners = bare
    clicks = tuple(
        pixel_of(point, above()) for point in ((2.2, 0.0, 0.7), (0.35, 2.6, 0.45))
    )
    both = select(scene, Selection(click=clicks), camera=above(), render=Renderer())
    assert iou(both, owners != GROUND) > 0.95
    half = (0.0, -9.0, -9.0, 9.0, 9.0, 9.0)
    front = select(scene, Selection(cluster=1, box=half))
    assert torch.equal(
        front, select(scene, Selection(cluster=1)) & (scene.means[:, 0] >= 0)
    )


def test_parts_are_selected_by_name() -> None:
    scene, mask = toy_scene()
    parts = {"rest": slice(0, 10), "thing": slice(10, 40)}
    assert torch.equal(select(scene, Selection(object="thing"), objects=parts), mask)
    with pytest.raises(InvalidValueError, match="one of rest, thing, got bicycle"):
        select(scene, Selection(object="bicycle"), objects=parts)
    with pytest.raises(InvalidValueError, match="no parts"):
        select(scene, Selection(object="thing"))
    with pytest.raises(InvalidValueError, match="parts: rest, thing"):
        select(scene, Selection(), objects=parts)


def test_doubts_come_with_numbers() -> None:
    shown = torch.full((4, 4), 0.8)
    hidden = torch.full((4, 4), 0.2)
    mask = torch.arange(100) < 50
    assert doubts(mask, {"a": shown}) == []
    assert "5 of 100 Gaussians, which is hardly" in doubts(torch.arange(100) < 5, {})[0]
    assert (
        "96 of 100 Gaussians: nearly the whole"
        in doubts(torch.arange(100) < 96, {"a": shown})[0]
    )
    (told,) = doubts(mask, {"a": hidden, "b": shown, "c": hidden})
    assert (
        "does not show from a, c (2 of 3 cameras; at most 20% of any pixel is its)"
        in told
    )
    require_visible({"b": shown})
    with pytest.raises(InvalidValueError, match="none from a, b, c, d, "):
        require_visible(dict.fromkeys("abcdef", hidden))


def test_a_selection_says_what_was_used() -> None:
    assert Selection().is_empty
    assert Selection().as_dict() == {}
    assert Selection(object="car").as_dict() == {"object": "car"}
    assert set(Selection(click=("1,2",)).as_dict()) == {
        "click",
        "link_distance",
        "link_colour",
        "planes",
    }
    assert Selection(click=("1,2", "3, 4")).pixels == ((1, 2), (3, 4))


def test_a_click_looks_around_itself_only(variant: str) -> None:
    """On a table in a room the largest plane is the floor, but the one near the click
    is the table.
    """
    table = ground(1500, half=0.4, seed=1)
    table = table.replace(means=table.means + torch.tensor([0.0, 0.0, 0.75]))
    ball = gaussians(shell(500, centre=(0.0, 0.0, 0.85), radius=0.1), (0.8, 0.2, 0.2))
    scene = merge(ground(6000, half=3.0), table, ball)
    truth = torch.arange(len(scene)) >= 7500
    labels = clusters(scene)
    # all that is not the floor is one component
    assert int(labels[-1]) == int(labels[6000])
    view = Camera(
        to_world=look_at((0.8, 0.0, 1.3), (0.0, 0.0, 0.8)),
        lens=Lens(focal=96, size=(64, 64)),
    )
    click = Selection(click=(pixel_of((0.07, 0.0, 0.92), view),))
    assert iou(select(scene, click, camera=view, render=Renderer()), truth) > 0.85


# Boxes and mask files


@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int64])
def test_a_mask_comes_back(kind: type, tmp_path: Path) -> None:
    scene = random_scene(20)
    mask = torch.arange(20) % 3 == 0
    save_mask(mask, tmp_path / "a.npy")
    assert np.load(tmp_path / "a.npy").dtype == np.bool_
    np.save(tmp_path / "b.npy", mask.numpy().astype(kind))
    for name in ("a.npy", "b.npy"):
        assert torch.equal(load_mask(tmp_path / name, scene), mask)


@pytest.mark.parametrize("kind", ["splat", "points"])
def test_a_part_is_found_by_its_positions(kind: str, tmp_path: Path) -> None:
    scene = random_scene(50)
    rows = torch.tensor([40, 3, 17])
    part = scene.select(rows)
    if kind == "splat":
        save_splat(part, tmp_path / "part.ply")
    else:
        save_points(PointCloud(part.means, torch.zeros(3, 3)), tmp_path / "part.ply")
    assert load_mask(tmp_path / "part.ply", scene).nonzero()[:, 0].tolist() == [
        3,
        17,
        40,
    ]


# Refusals

TOY = toy_scene()[0]


def saved_mask(values: object, folder: Path) -> Selection:
    np.save(folder / "a.npy", np.asarray(values))
    return Selection(mask=folder / "a.npy")


def saved_part(folder: Path) -> Path:
    """Some Gaussians, moved a little."""
    part = TOY.select(slice(0, 5))
    save_splat(
        part.replace(means=part.means + torch.tensor([0.0, 0.0, 1e-3])),
        folder / "part.ply",
    )
    return folder / "part.ply"


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (
            lambda _: select(TOY, Selection(box=(5, 5, 5, 6, 6, 6))),
            "at least one Gaussian, got none of 40",
        ),
        (
            lambda _: Selection(box=(0, 0, 0, -1, 1, 1)),
            "box: expected no first number above its second",
        ),
        (lambda _: Selection(box=(0, 0, 0, float("nan"), 1, 1)), "box"),
        (
            lambda _: Selection(cluster=0),
            "cluster: expected a number >= 1, got 0; 1 is the largest",
        ),
        (
            lambda _: Selection(click=("12;4",)),
            "click: expected a pixel x,y, got '12;4'",
        ),
        (lambda _: Selection(click=("-1,4",)), "click"),
        (lambda _: select(TOY, Selection(cluster=41)), "cluster: expected 1 to"),
        (lambda _: select(TOY, Selection(click=("1,1",))), "camera and a renderer"),
        (
            lambda _: pixel_weights(TOY, camera(), (0, 31), blobs),
            "click 0,31: expected a pixel that shows something",
        ),
        (
            lambda _: pixel_weights(TOY, camera(), (32, 0), blobs),
            "a pixel of 32 x 32, got 32,0",
        ),
        (
            lambda _: contributions(TOY, camera(), render=blobs, boxes=[(0, 0, 33, 3)]),
            "box: expected x0 < x1",
        ),
        (
            lambda _: contributions(TOY, camera(), render=blobs, boxes=[]),
            "boxes: expected 1, one a camera, got 0",
        ),
        (lambda folder: select(TOY, saved_mask([False] * 40, folder)), "none of 40"),
        (
            lambda folder: select(TOY, saved_mask([True] * 39, folder)),
            "40 bools, one a Gaussian, got 39",
        ),
        (
            lambda folder: select(TOY, saved_mask([0, 40], folder)),
            r"row numbers in 0\.\.39, got 0 to 40",
        ),
        (lambda folder: select(TOY, saved_mask([-1], folder)), "row numbers"),
        (lambda folder: select(TOY, saved_mask([1.0] * 40, folder)), "float64"),
        (lambda folder: load_mask(folder / "gone.npy", TOY), "gone.npy"),
        (lambda folder: load_mask(saved_part(folder), TOY), "5 of 5 that are not"),
        (lambda folder: load_mask(folder / "mask.txt", TOY), r"npy or \.ply"),
    ],
)
def test_what_is_refused(
    call: Callable[[Path], object], says: str, tmp_path: Path
) -> None:
    with pytest.raises(MiSplatError, match=says):
        call(tmp_path)
