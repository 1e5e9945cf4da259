"""Boxes around an object, drawn from two cameras; without a browser."""

import shlex
from pathlib import Path

import pytest
import torch

from attacks import cli
from mi_splat.selection.boxes import load_boxes
from mi_splat.viewer.boxes import Drag, document_of, dragged, file_of
from mi_splat.viewer.selecting import SharedSelection
from mi_splat.viewer.session import SIDE_BY_SIDE, lay_out
from tests.viewer.contents import ABOVE, START, balls, painter

BOX = (10.0, 4.0, 38.0, 28.0)
FIRST = Drag(splat="clean", box=BOX, orbit=START)
SECOND = Drag(splat="clean", box=BOX, orbit=ABOVE)


def test_a_box_on_the_page_is_one_in_pixels_of_a_picture() -> None:
    content = balls(2)
    both = lay_out((200, 100), 1.5, 2)
    left, top = both.corners[1]
    width, height = both.size

    def place(x: float, y: float) -> tuple[float, float]:
        return (left + x * width) / 200, (top + y * height) / 100

    ends = (place(0.25, 0.25), place(0.75, 0.75))
    drag = dragged(ends, both, SIDE_BY_SIDE, content, START)
    assert drag is not None
    assert drag.splat == "attacked"
    assert drag.box == pytest.approx((12, 8, 36, 24), abs=0.6)
    wide = dragged(
        (place(0.5, 0.25), place(1.2, 0.75)), both, SIDE_BY_SIDE, content, START
    )
    assert wide is not None
    assert wide.box[2] == 48
    narrow = (place(0.5, 0.5), place(0.51, 0.9))
    assert dragged(narrow, both, SIDE_BY_SIDE, content, START) is None
    nowhere = ((float("nan"), 0.0), (0.5, 0.5))
    assert dragged(nowhere, both, SIDE_BY_SIDE, content, START) is None
    beside = ((0.0, 0.0), (0.1, 0.02))
    assert dragged(beside, both, SIDE_BY_SIDE, content, START) is None


def test_two_boxes_select_an_object_and_clear_forgets_them() -> None:
    shared = SharedSelection(painter(1))
    shared.drag(FIRST)
    assert shared.picked is None
    assert shared.drags == [FIRST]
    shared.drag(SECOND)
    picked = shared.picked
    assert picked is not None
    assert float(picked.mask.float().mean()) > 0.5
    program, name, *words = shlex.split(picked.command)
    options = cli.parse(name, words)
    assert (program, name) == ("mi-splat", "select")
    assert options.selection.boxes == Path("boxes.json")
    shared.select(None)
    assert shared.drags == []


def test_boxes_around_nothing_are_told_and_dropped() -> None:
    shared = SharedSelection(painter(1))
    nothing = (0.0, 0.0, 4.0, 4.0)
    shared.drag(Drag(splat="clean", box=nothing, orbit=START))
    shared.later(lambda: shared.drag(Drag(splat="clean", box=nothing, orbit=ABOVE)))
    assert shared.turn()
    assert shared.error
    assert shared.picked is None


def test_boxes_of_another_splat_begin_anew() -> None:
    shared = SharedSelection(painter(2))
    shared.drag(FIRST)
    other = Drag(splat="attacked", box=BOX, orbit=START)
    shared.drag(other)
    assert shared.drags == [other]
    assert shared.picked is None


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_the_file_has_cameras_in_the_world_of_the_splat(
    up: tuple[float, float, float], tmp_path: Path
) -> None:
    content = balls(1)
    before = content.splats[0].scene.means
    content = content.turned(up)
    (tmp_path / "boxes.json").write_bytes(file_of([FIRST, SECOND], content))
    read = load_boxes(tmp_path / "boxes.json")
    assert read.boxes == document_of([FIRST, SECOND], content).boxes
    after = content.splats[0].scene.means
    for drag, camera in zip((FIRST, SECOND), read.cameras.values(), strict=True):
        local = camera.to_camera.float()
        shown = drag.orbit.camera((48, 32)).to_camera.float()
        torch.testing.assert_close(
            before @ local[:3, :3].T + local[:3, 3],
            after @ shown[:3, :3].T + shown[:3, 3],
            atol=1e-5,
            rtol=0,
        )
