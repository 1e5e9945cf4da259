"""Objects are selected where one clicks; without a browser."""

import io
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat.cameras.camera import project_points
from mi_splat.viewer.picking import Click, border, clicked, colours, one_gaussian
from mi_splat.viewer.selecting import SharedSelection
from mi_splat.viewer.session import (
    DIFFERENCE,
    SIDE_BY_SIDE,
    Pace,
    Step,
    ViewState,
    lay_out,
)
from tests.viewer.contents import START, balls, painter

MIDDLE = Click(splat="clean", pixel=(24, 16), orbit=START)


def test_a_click_means_the_pixel_that_it_is_on() -> None:
    content = balls(2)
    both = lay_out((200, 100), 1.5, 2)
    one = lay_out((150, 100), 1.5, 1)
    left, top = both.corners[1]
    point = (left + 0.26 * both.size[0]) / 200, (top + 0.5 * both.size[1]) / 100
    assert clicked(point, both, SIDE_BY_SIDE, content, START) == ("attacked", (12, 16))
    assert clicked((0.5, 0.0), both, SIDE_BY_SIDE, content, START) is None
    assert clicked((0.8, 0.9), one, DIFFERENCE, content, START) == ("clean", (38, 28))
    assert clicked((float("nan"), 0.5), one, "clean", content, START) is None


def test_a_selected_object_is_highlighted_until_it_is_cleared() -> None:
    shared = SharedSelection(painter(1))
    state = ViewState(orbit=START, mode="clean", canvas=(48, 32))
    plain = shared.painter.paint(state, Step.FULL, Pace()).pixels
    shared.pick(MIDDLE)
    picked = shared.picked
    assert picked is not None
    assert picked.mask.any()
    assert np.array_equal(np.load(io.BytesIO(picked.file)), picked.mask.numpy())
    coloured = shared.painter.paint(state, Step.FULL, Pace()).pixels
    assert (coloured[..., 2].astype(int) - plain[..., 2]).max() > 20
    # for detectors
    assert torch.equal(
        shared.painter.picture("clean", START), painter(1).picture("clean", START)
    )
    shared.select(None)
    assert shared.picked is None
    assert np.array_equal(shared.painter.paint(state, Step.FULL, Pace()).pixels, plain)


def test_the_gaussian_in_front_has_a_border_and_its_colours() -> None:
    shared = SharedSelection(painter(1))
    camera = START.camera((480, 320))
    shared.pick(MIDDLE)
    assert shared.picked is not None
    assert shared.picked.row is not None
    scene = shared.painter.content.splats[0].scene
    row = shared.picked.row
    assert shared.picked.mask[row]
    (centre,), depth = project_points(scene.means[row : row + 1], camera)
    round_one = scene.replace(scales=torch.full_like(scene.scales, 0.01))
    radii = (border(round_one, row, camera) - centre).norm(dim=1)
    assert radii.tolist() == pytest.approx(
        [2 * camera.fx * 0.01 / float(depth)] * len(radii), rel=0.05
    )
    behind = scene.replace(means=scene.means + 3 * camera.position.to(scene.means))
    assert len(border(behind, row, camera)) == 0
    red, green, blue = (
        (255 * colours(scene, row, [START.changed(elevation=0.0).camera((1, 1))])[0])
        .int()
        .tolist()
    )
    assert f"to right, rgb({red}, {green}, {blue})" in one_gaussian(scene, row, START)


def test_the_command_selects_by_the_same_click() -> None:
    shared = SharedSelection(painter(1))
    shared.pick(MIDDLE)
    assert shared.picked is not None
    program, name, *words = shlex.split(shared.picked.command)
    options = cli.parse(name, words)
    assert (program, name, options.out) == ("mi-splat", "select", (Path("mask.npy"),))
    assert options.selection.pixels == ((24, 16),)
    assert (options.view.azimuth, options.view.size, options.view.near) == (
        30.0,
        (48, 32),
        0.2,
    )
    shared.pick(replace(MIDDLE, adds=True))
    assert not shared.picked.command  # several clicks, perhaps from several cameras


def test_a_click_on_nothing_says_so_and_keeps_the_selection() -> None:
    shared = SharedSelection(painter(1))
    shared.pick(MIDDLE)
    shared.later(lambda: shared.pick(replace(MIDDLE, pixel=(0, 0))))
    assert shared.turn()
    assert "click on the object" in shared.error
    assert shared.picked is not None
    assert not shared.turn()
