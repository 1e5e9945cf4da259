"""Objects are picked where one clicks, and work is one job at a time, whose result is shown; without a browser."""

import io
import shlex
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene
from mi_splat.sh import dc_to_colour
from mi_splat.viewer.bench import MOST_SHOWN, Bench
from mi_splat.viewer.composition import BESIDE, DIFFERENCE, SPLIT, lay_out
from mi_splat.viewer.dome import SIDE, draw_domes
from mi_splat.viewer.jobs import Job
from mi_splat.viewer.picking import TINT, Click, clicked, tinted
from mi_splat.viewer.session import Pace, Step, ViewState
from tests.viewer.exhibits import START, ball, exhibit, painter
from tests.viewer.works import Thread, bench, perform

MIDDLE = Click(splat="clean", pixel=(24, 16), orbit=START)


def until(true: Callable[[], bool], work: Bench) -> None:
    """Go on until something is the case."""
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end, work.lines
        work.turn()
        time.sleep(0.005)


def test_a_click_means_the_pixel_that_it_is_on() -> None:
    shown = exhibit(2)
    beside = lay_out((200, 100), 1.5, 2)
    left, top = beside.corners[1]
    point = (left + 0.26 * beside.size[0]) / 200, (top + 0.5 * beside.size[1]) / 100
    assert clicked(point, beside, BESIDE, shown, START) == ("attacked", (12, 16))
    assert clicked((0.5, 0.0), beside, BESIDE, shown, START) is None
    one = lay_out((150, 100), 1.5, 1)
    assert clicked((0.2, 0.9), one, SPLIT, shown, START, split=0.5) == ("clean", (9, 28))
    assert clicked((0.8, 0.9), one, SPLIT, shown, START, split=0.5) == ("attacked", (38, 28))
    assert clicked((0.8, 0.9), one, DIFFERENCE, shown, START) == ("clean", (38, 28))
    assert clicked((float("nan"), 0.5), one, "clean", shown, START) is None


def test_what_is_picked_has_another_colour_and_can_be_undone() -> None:
    work = bench()
    state = ViewState(orbit=START, show="clean", canvas=(48, 32))
    plain = work.painter.paint(state, Step.FULL, Pace()).pixels
    work.pick(MIDDLE)
    picked = work.picked
    assert picked is not None
    assert picked.mask.any()
    assert np.array_equal(np.load(io.BytesIO(picked.file)), picked.mask.numpy())
    coloured = work.painter.paint(state, Step.FULL, Pace()).pixels
    assert (coloured[..., 2].astype(int) - plain[..., 2]).max() > 20
    assert torch.equal(work.painter.picture("clean", START), painter(1).picture("clean", START))
    work.undo()
    assert work.picked is None
    again = work.painter.paint(state, Step.FULL, Pace()).pixels
    assert np.array_equal(again, plain)


def test_a_box_keeps_a_part_of_what_was_picked() -> None:
    work = bench()
    work.trim(0, (0.0, 0.5))  # of nothing
    work.pick(MIDDLE)
    whole = work.picked
    assert whole is not None
    for nonsense in ("all", (0.5, 0.2), (float("nan"), 1.0), (0.0, 2.0), (0.1, 0.2, 0.3)):
        work.trim(2, nonsense)
    assert work.picked is whole
    work.trim(2, (0.0, 0.5))
    part = work.picked
    assert part is not None
    heights = work.exhibit.splats[0].scene.means[:, 2]
    assert torch.equal(part.mask, whole.mask & (heights <= part.box[5]))
    assert 0 < part.mask.sum() < whole.mask.sum()
    options = cli.parse("select", shlex.split(part.command)[2:])
    assert options.selection.box == part.box
    assert not replace(part, level=False).command  # the page's coordinates are not the file's
    work.trim(2, (0.0, 1.0))
    assert work.picked is not None
    assert work.picked.command == whole.command


def test_what_is_asked_for_meanwhile_waits_for_a_picture() -> None:
    """A slider that is moved all the time must not keep pictures from being made."""
    work, done = bench(), list[int]()

    def again() -> None:
        done.append(len(done))
        work.later(again)

    work.later(again)
    assert [work.turn(), work.turn()] == [True, True]
    assert done == [0, 1]


def test_tinted_gaussians_are_half_of_another_colour_from_everywhere() -> None:
    scene = ball((0.2, 0.4, 0.6)).with_degree(1)
    scene = GaussianScene(*scene.tensors()[:4], scene.sh + 0.01)
    mask = torch.arange(len(scene)) < 3
    changed = tinted(scene, mask)
    before = dc_to_colour(scene.sh[:, 0])
    assert torch.allclose(dc_to_colour(changed.sh[mask, 0]), 0.5 * before[mask] + 0.5 * torch.tensor(TINT), atol=1e-6)
    assert torch.equal(changed.sh[mask, 1:], 0.5 * scene.sh[mask, 1:])
    assert torch.equal(changed.sh[~mask], scene.sh[~mask])


def test_the_command_picks_by_the_same_click() -> None:
    work = bench()
    work.pick(MIDDLE)
    assert work.picked is not None
    program, name, *words = shlex.split(work.picked.command)
    options = cli.parse(name, words)
    assert (program, name, options.out) == ("mi-splat", "select", (Path("mask.npy"),))
    assert options.selection.pixels == ((24, 16),)
    assert (options.view.azimuth, options.view.size, options.view.near) == (30.0, (48, 32), 0.2)
    work.pick(replace(MIDDLE, adds=True))
    assert not work.picked.command  # several clicks, perhaps from several cameras


def test_work_is_told_of_and_its_result_is_shown() -> None:
    work = bench()
    assert work.command("Work", START) == "# Work: expected an object, got none; click on one"
    work.later(lambda: work.start("Work", START))
    work.turn()
    assert work.lines == ("Work: expected an object, got none; click on one",)
    work.pick(MIDDLE)
    assert work.picked is not None
    assert work.command("Work", START) == "mi-splat do --eps=5.0 mask.npy out/work"
    work.start("Work", START)
    until(lambda: not work.running, work)
    assert work.lines == (f"done to {int(work.picked.mask.sum())}",)
    assert work.exhibit.names == ("clean", "attacked")
    assert work.outcome is not None
    assert not work.tinted
    assert work.command("Work", START).endswith("out/work-2")
    work.back()
    assert len(work.exhibit.splats) == 1
    work.close()


def test_old_results_are_not_kept_for_ever() -> None:
    work = bench()
    first = work.painter
    work.pick(MIDDLE)
    for _ in range(MOST_SHOWN + 2):
        work.start("Work", START)
        until(lambda: not work.running, work)
    last = work.painter
    assert len(work.painters) == MOST_SHOWN + 1
    assert (work.painters[0], work.painters[-1]) == (first, last)
    work.close()


def test_one_work_at_a_time_which_can_be_stopped_and_may_fail() -> None:
    Thread.ended.clear()
    work = bench()
    work.pick(MIDDLE)
    work.choose("Work", "verb", "wait")
    work.start("Work", START)
    until(lambda: work.news is not None and work.news.share == 0.5, work)
    with pytest.raises(InvalidValueError, match="one work at a time"):
        work.start("Work", START)
    work.stop()
    assert (work.running, work.ending) == ("Work", True)  # it is asked to end with what it has
    until(lambda: not work.running, work)
    assert len(work.painters) == 2
    work.back()
    work.pick(MIDDLE)
    work.start("Work", START)
    work.ending = True
    work.stop()
    assert not work.running
    assert "nothing of it is kept" in work.lines[0]
    work.choose("Work", "verb", "fail")
    work.start("Work", START)
    until(lambda: not work.running, work)
    assert work.lines == ("Work failed: work: expected to be done, got this; look elsewhere",)
    assert work.exhibit.names == ("clean",)
    work.close()


@pytest.mark.parametrize(
    ("name", "value"), [("verb", "rm -rf"), ("verb", 3), ("eps", float("nan")), ("eps", 1e9), ("eps", "5"), ("no", 1)]
)
def test_nonsense_from_a_browser_is_not_chosen(name: str, value: object) -> None:
    work = bench()
    before = work.values("Work")
    work.choose("Work", name, value)
    assert work.values("Work") == before


def test_a_process_that_is_killed_is_told_of() -> None:
    job = Job(perform, ["wait"])
    job._process.kill()
    heard: object = None
    while not isinstance(heard, str):
        heard = job.heard()
        time.sleep(0.01)
    assert "ended with status -9" in heard
    job.stop()


def test_a_dome_has_a_disc_where_there_was_a_success() -> None:
    seen = [(0.0, 60.0, True), (90.0, 30.0, False), (180.0, 90.0, None)]
    pixels = draw_domes({"one": seen, "two": []})
    assert pixels.shape == (2 * SIDE, SIDE, 3)
    red = np.argwhere((pixels == (0xD0, 0x30, 0x20)).all(-1)).mean(0)
    blue = np.argwhere((pixels == (0x20, 0x60, 0xC0)).all(-1)).mean(0)
    middle, radius = np.array([0.53 * SIDE, SIDE / 2]), 0.41 * SIDE
    assert np.allclose(red, middle + np.array([0, radius / 3]), atol=1.5)  # azimuth 0 is on the right
    assert np.allclose(blue, middle - np.array([2 * radius / 3, 0]), atol=1.5)  # and 90 at the top
