"""Objects are selected where one clicks, and jobs run one at a time in processes; without a browser."""

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
from mi_splat.cameras import project_points
from mi_splat.errors import InvalidValueError
from mi_splat.viewer.picking import Click, border, clicked, colours, one_gaussian
from mi_splat.viewer.runner import Choice, JobRunner, Number, Value
from mi_splat.viewer.session import DIFFERENCE, SIDE_BY_SIDE, Pace, Step, ViewState, lay_out
from tests.viewer.contents import START, WORK, balls, painter, runner

MIDDLE = Click(splat="clean", pixel=(24, 16), orbit=START)


def chosen(verb: str = "do") -> dict[str, Value]:
    return {"verb": verb, "eps": 5.0}


def until(true: Callable[[], bool], jobs: JobRunner) -> None:
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end, jobs.lines
        jobs.turn()
        time.sleep(0.005)


def test_a_click_means_the_pixel_that_it_is_on() -> None:
    content = balls(2)
    both, one = lay_out((200, 100), 1.5, 2), lay_out((150, 100), 1.5, 1)
    left, top = both.corners[1]
    point = (left + 0.26 * both.size[0]) / 200, (top + 0.5 * both.size[1]) / 100
    assert clicked(point, both, SIDE_BY_SIDE, content, START) == ("attacked", (12, 16))
    assert clicked((0.5, 0.0), both, SIDE_BY_SIDE, content, START) is None
    assert clicked((0.8, 0.9), one, DIFFERENCE, content, START) == ("clean", (38, 28))
    assert clicked((float("nan"), 0.5), one, "clean", content, START) is None


def test_a_selected_object_is_highlighted_until_it_is_cleared() -> None:
    jobs, state = runner(), ViewState(orbit=START, mode="clean", canvas=(48, 32))
    plain = jobs.painter.paint(state, Step.FULL, Pace()).pixels
    jobs.pick(MIDDLE)
    picked = jobs.picked
    assert picked is not None
    assert picked.mask.any()
    assert np.array_equal(np.load(io.BytesIO(picked.file)), picked.mask.numpy())
    coloured = jobs.painter.paint(state, Step.FULL, Pace()).pixels
    assert (coloured[..., 2].astype(int) - plain[..., 2]).max() > 20
    assert torch.equal(jobs.painter.picture("clean", START), painter(1).picture("clean", START))  # for detectors
    jobs.select(None)
    assert jobs.picked is None
    assert np.array_equal(jobs.painter.paint(state, Step.FULL, Pace()).pixels, plain)


def test_the_gaussian_in_front_has_a_border_and_its_colours() -> None:
    jobs, camera = runner(), START.camera((480, 320))
    jobs.pick(MIDDLE)
    assert jobs.picked is not None
    assert jobs.picked.row is not None
    scene, row = jobs.content.splats[0].scene, jobs.picked.row
    assert jobs.picked.mask[row]
    (centre,), depth = project_points(scene.means[row : row + 1], camera)
    round_one = scene.replace(scales=torch.full_like(scene.scales, 0.01))
    radii = (border(round_one, row, camera) - centre).norm(dim=1)
    assert radii.tolist() == pytest.approx([2 * camera.fx * 0.01 / float(depth)] * len(radii), rel=0.05)
    behind = scene.replace(means=scene.means + 3 * camera.position.to(scene.means))
    assert len(border(behind, row, camera)) == 0
    red, green, blue = (255 * colours(scene, row, [START.changed(elevation=0.0).camera((1, 1))])[0]).int().tolist()
    assert f"to right, rgb({red}, {green}, {blue})" in one_gaussian(scene, row, START)


def test_the_command_selects_by_the_same_click() -> None:
    jobs = runner()
    jobs.pick(MIDDLE)
    assert jobs.picked is not None
    program, name, *words = shlex.split(jobs.picked.command)
    options = cli.parse(name, words)
    assert (program, name, options.out) == ("mi-splat", "select", (Path("mask.npy"),))
    assert options.selection.pixels == ((24, 16),)
    assert (options.view.azimuth, options.view.size, options.view.near) == (30.0, (48, 32), 0.2)
    jobs.pick(replace(MIDDLE, adds=True))
    assert not jobs.picked.command  # several clicks, perhaps from several cameras


def test_a_job_runs_and_its_result_is_shown() -> None:
    jobs = runner()
    assert jobs.command(WORK, START, chosen()) == "# Work: expected an object, got none; click on one"
    jobs.later(lambda: jobs.start(WORK, START, chosen()))
    jobs.turn()
    assert jobs.lines == ("Work: expected an object, got none; click on one",)
    jobs.pick(MIDDLE)
    assert jobs.command(WORK, START, chosen()) == "mi-splat do --eps=5.0 mask.npy out/work"
    jobs.start(WORK, START, chosen())
    with pytest.raises(InvalidValueError, match="one job at a time"):
        jobs.start(WORK, START, chosen())
    until(lambda: not jobs.running, jobs)
    assert jobs.lines == ("done with --eps=5.0",)
    assert (jobs.content.names, jobs.has_result) == (("clean", "attacked"), True)
    assert jobs.picked is not None  # in what is shown now
    jobs.back()
    assert (jobs.content.names, jobs.has_result) == (("clean",), False)
    jobs.close()


def test_a_job_fails_is_interrupted_with_what_it_has_or_killed() -> None:
    jobs = runner()
    jobs.pick(MIDDLE)
    jobs.start(WORK, START, chosen("fail"))
    until(lambda: not jobs.running, jobs)
    assert jobs.lines == ("Work failed: expected to be done, got this",)
    jobs.start(WORK, START, chosen("wait"))
    until(lambda: jobs.lines == ("Work: working",), jobs)
    jobs.stop()
    until(lambda: not jobs.running, jobs)
    assert jobs.lines == ("done with --eps=5.0",)  # it ended early
    jobs.back()
    jobs.start(WORK, START, chosen("wait"))
    for _ in range(2):
        jobs.stop()
    until(lambda: not jobs.running, jobs)
    assert "Work was stopped" in jobs.lines[0]
    assert not jobs.has_result
    jobs.close()


@pytest.mark.parametrize("value", ["rm -rf", 3, float("nan"), 1e9, "5", None, {}])
def test_an_invalid_value_of_a_browser_is_the_default(value: object) -> None:
    words, numbers = WORK.fields
    assert isinstance(words, Choice)
    assert isinstance(numbers, Number)
    assert words.valid(value) == "do"
    assert numbers.valid(value) == (3 if value == 3 else 5.0)
