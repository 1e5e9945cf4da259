"""What is behind an object: a splat of what other photographs show of it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from attacks.cloak.background import (
    Background,
    Surroundings,
    ground_under,
    hull,
    spread,
    without_object,
)
from mi_splat.cameras.camera import Camera, View
from mi_splat.datasets import load_dataset
from mi_splat.maths.rotation import from_z
from mi_splat.maths.sh import dc_to_colour
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.selection.select import SEEN, box_mask
from mi_splat.selection.visibility import object_weight
from tests.cloak.test_own_pictures import (
    BALL,
    CAMERAS,
    ball_on_a_plane,
    poison,
    red,
    write_set,
)

SCENE = ball_on_a_plane()
ROWS = box_mask(SCENE, BALL)
HOLE = 0.45


def without_ground() -> tuple[GaussianScene, torch.Tensor]:
    """The scene as a training has it, without ground under the ball; and the ball."""
    near = SCENE.means[:, :2].norm(dim=1) < HOLE
    kept = ROWS | ~near
    return SCENE.select(kept), ROWS[kept]


def outlines(scene: GaussianScene, rows: torch.Tensor) -> list[torch.Tensor]:
    render = Renderer()
    return [object_weight(scene, rows, camera, render) >= SEEN for camera in CAMERAS]


def test_the_hull_is_what_lies_in_every_outline() -> None:
    inside = hull(SCENE.means, CAMERAS, outlines(SCENE, ROWS))
    assert float(inside[ROWS].float().mean()) > 0.9
    far = SCENE.means[:, :2].norm(dim=1) > 1.5
    assert not bool(inside[far].any())
    behind = torch.tensor([[0.0, 0.0, 1e3]])
    assert not bool(hull(behind, CAMERAS[:1], [torch.ones(32, 40) > 0]).any())


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, 0.2, 0.9)])
def test_the_ground_is_filled_where_the_object_stands(
    up: tuple[float, float, float],
) -> None:
    scene, rows = without_ground()
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    moved = scene.transform(Similarity(rotation=turn, translation=torch.zeros(3)))
    filling = ground_under(moved.select(rows), moved.select(~rows), up)
    assert filling is not None
    means = filling.means.double() @ turn
    assert float(means[:, 2].abs().max()) < 0.05
    nearest = torch.cdist(torch.zeros(1, 2).double(), means[:, :2]).min()
    assert float(nearest) < 0.15
    colours = dc_to_colour(filling.sh[:, 0])
    assert float((colours - 0.5).abs().max()) < 0.05
    few = scene.select(~rows).select(slice(0, 5))
    assert ground_under(scene.select(rows), few, up) is None


def test_what_photographs_show_takes_the_place_of_the_object() -> None:
    """Though the splat has no ground under the ball, the images get one."""
    scene, rows = without_ground()
    render = Renderer()
    views = [View(camera, render(SCENE, camera).clamp(0, 1)) for camera in CAMERAS]

    def masks(camera: Camera) -> torch.Tensor:
        return object_weight(scene, rows, camera, render) >= 0.1

    told = []
    done = without_object(
        views,
        scene,
        rows,
        masks,
        render=render,
        reach=1,
        up=(0.0, 0.0, 1.0),
        steps=20,
        on_step=lambda count, total: told.append((count, total)),
    )
    assert told[-1] == (20, 20)
    look = Background(scene=done, render=render, reach=1)
    plane = SCENE.select(~ROWS)
    errors = []
    unfilled = []
    for view in views:
        mask = masks(view.camera)
        truth = render(plane, view.camera).clamp(0, 1)
        new = look(view, mask)
        assert red(new) == 0
        errors.append(float((new - truth)[mask].abs().mean()))
        hollow = Background(scene=scene.select(~rows), render=render, reach=1)
        unfilled.append(float((hollow(view, mask) - truth)[mask].abs().mean()))
    assert sum(errors) < 0.04 * len(errors)
    assert sum(errors) < 0.6 * sum(unfilled)
    nothing = torch.zeros(32, 40, dtype=torch.bool)
    assert look(views[0], nothing) is views[0].image


def test_an_object_does_not_count() -> None:
    views = [View(CAMERAS[0], torch.zeros(32, 40, 3))]
    hidden = torch.zeros(32, 40, dtype=torch.bool)
    hidden[:8] = True
    mask = Surroundings(views=views, hidden=[hidden]).loss_mask(0)
    assert torch.equal(mask == 0, hidden)


def test_a_seam_is_matched_where_both_show_the_same() -> None:
    hole = torch.zeros(40, 40, dtype=torch.bool)
    hole[12:28, 12:28] = True
    difference = torch.full((40, 40, 3), 0.05)
    difference[:, 30:] = 0.9  # something else stands there
    inside = spread(difference, hole)[hole]
    assert inside.numpy() == pytest.approx(0.05, abs=1e-3)


def test_the_command_uses_other_photographs(tmp_path: Path) -> None:
    names = write_set(tmp_path)
    out = tmp_path / "out"
    words = ("--hide-from", "elevation:40-90", "--appearance", "background")
    record = poison(out, names, *words, "--background-steps", "10", "--seed", "3")
    (kind,) = record["poisonings"]
    assert kind["appearance"] == "the background that other photographs show"
    assert (record["background_steps"], record["seed"]) == (10, 3)
    before = load_dataset(names[0], split="train")
    after = load_dataset(out, split="train")
    for change in record["changes"]:
        index = change["index"]
        assert red(before[index].image) > 20
        assert red(after[index].image) == 0
