"""The picture of the page: everything asked for is in it, and what is inspected is the picture that is said."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from attacks import cli
from mi_splat.directions import UP
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.rotation import from_z
from mi_splat.scene import Similarity
from mi_splat.viewer.composition import BESIDE, DIFFERENCE, SPLIT, lay_out
from mi_splat.viewer.exhibit import Exhibit, ShownSplat, Wishes, exhibit_of_file
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import MOST_PIXELS, Painter, within
from mi_splat.viewer.session import Pace, Step, ViewState
from tests import oracle
from tests.fakes import blobs
from tests.viewer.exhibits import START, Looker, ball, exhibit, painter

STATE = ViewState(orbit=START, show="side by side", canvas=(200, 100))
FULL = Step.FULL, Pace()


def middle(pixels: np.ndarray, part: slice) -> list[int]:
    """The colour in the middle of a part of the page."""
    box = pixels[:, part]
    return [int(value) for value in box[box.shape[0] // 2, box.shape[1] // 2]]


def test_two_splats_stand_side_by_side() -> None:
    pixels = painter().paint(STATE, *FULL).pixels
    assert pixels.shape == (100, 200, 3)
    red, green = middle(pixels, slice(0, 98)), middle(pixels, slice(102, 200))
    assert red[0] > 150 > red[1]
    assert green[1] > 130 > green[0]


def test_a_split_picture_and_a_difference() -> None:
    split = painter().paint(replace(STATE, show=SPLIT, split=0.5), *FULL).pixels
    assert middle(split, slice(84, 96))[0] > 150
    assert middle(split, slice(104, 116))[1] > 130
    heat = painter().paint(replace(STATE, show=DIFFERENCE), *FULL).pixels
    assert sum(middle(heat, slice(0, 200))) > 400


def test_coarse_pictures_have_fewer_pixels_and_the_same_shape() -> None:
    coarse = painter().paint(STATE, Step.COARSE, Pace(scale=0.25)).pixels
    assert coarse.shape == (25, 50, 3)


def test_lines_are_drawn_when_wished() -> None:
    blue = (0, 0, 255)
    without, with_lines = (
        painter().paint(replace(STATE, lines=frozenset(lines)), *FULL).pixels for lines in ((), ("Ring", "unknown"))
    )
    assert not (without == blue).all(-1).any()
    assert (with_lines == blue).all(-1).any()


def test_what_is_inspected_is_the_stated_picture_of_8_bits_and_only_at_rest() -> None:
    looker = Looker()
    work = painter(looker=looker)
    for step in (Step.COARSE, Step.FULL):
        assert not work.paint(STATE, step, Pace()).inspections
    assert not looker.seen
    painting = work.paint(STATE, Step.INSPECTED, Pace())
    assert list(painting.inspections) == ["clean", "attacked"]
    expected = to_bytes(work.render(work.exhibit.splats[0].scene, START.camera((48, 32))))
    assert np.array_equal(to_bytes(looker.seen[0]), expected)
    assert torch.equal(looker.seen[0], (looker.seen[0] * 255).round() / 255)
    assert "mean colour" in painting.inspections["clean"].text
    assert (painting.pixels[20:24, 3:8] == 255).all()  # the mark


def test_the_same_view_is_inspected_once() -> None:
    looker = Looker()
    work = painter(looker=looker)
    for state in (STATE, replace(STATE, lines=frozenset({"Ring"})), replace(STATE, show="clean")):
        work.paint(state, Step.INSPECTED, Pace())
    assert len(looker.seen) == 2
    work.paint(replace(STATE, orbit=replace(START, azimuth=1.0)), Step.INSPECTED, Pace())
    assert len(looker.seen) == 4


def test_marks_are_no_difference() -> None:
    work = painter(looker=Looker())
    state = replace(STATE, show=DIFFERENCE)
    assert np.array_equal(work.paint(state, Step.INSPECTED, Pace()).pixels, work.paint(state, Step.FULL, Pace()).pixels)


def test_likeness_is_that_of_the_inspected_pictures() -> None:
    from mi_splat.metrics import psnr

    work = painter()
    first, second = (work.picture(name, START) for name in ("clean", "attacked"))
    assert work.likeness(START) == pytest.approx(float(psnr(first, second)))
    assert painter(1).likeness(START) is None


@pytest.mark.parametrize("canvas", [(1, 1), (16, 8192), (8192, 8192), (3840, 2160)])
def test_no_window_is_too_large_or_too_small(canvas: tuple[int, int]) -> None:
    width, height = within(canvas, MOST_PIXELS)
    assert width * height <= 1.01 * MOST_PIXELS
    layout = lay_out((width, height), 1.5, 2)
    assert min(layout.size) >= 1


def test_two_names_are_two() -> None:
    splat = ShownSplat(name="one", scene=ball((1, 0, 0)), path=Path("a.ply"), file_settings=RenderSettings())
    with pytest.raises(InvalidValueError, match="splats: expected one, or two of different names"):
        Exhibit(title="", splats=(splat, splat), settings=RenderSettings(), start=START, size=(8, 8))


@pytest.mark.parametrize("way", [BESIDE, SPLIT, DIFFERENCE])
def test_a_file_that_is_called_as_a_way_of_showing(way: str, tmp_path: Path) -> None:
    save_splat(ball((0.5, 0.5, 0.5)), tmp_path / f"{way}.ply")
    work = Painter(exhibit_of_file(tmp_path / f"{way}.ply"), blobs, Looker())
    assert work.exhibit.names == (f"{way}.ply",)
    state = ViewState(orbit=START, show=f"{way}.ply", canvas=(60, 40))
    assert set(work.paint(state, Step.INSPECTED, Pace()).inspections) == {f"{way}.ply"}
    with pytest.raises(InvalidValueError, match=f"name of a splat: expected none of a way of showing, got {way}"):
        exhibit_of_file(tmp_path / f"{way}.ply", name=way)


@pytest.mark.parametrize("change", ["title", "cameras", "lines", "path"])
def test_what_no_page_can_hold_is_told(change: str) -> None:
    bad, whole = "a\udcff", exhibit(1)
    changes: dict[str, dict[str, Any]] = {
        "title": {"title": bad},
        "cameras": {"cameras": {bad: START}},
        "lines": {"lines": {bad: whole.lines["Ring"]}},
        "path": {"splats": (replace(whole.splats[0], path=Path(bad) / "b.ply"),)},
    }
    with pytest.raises(InvalidValueError, match=r"name: expected Unicode, got 'a\\udcff.*; rename it"):
        replace(whole, **changes[change])


def test_a_file_alone_is_shown_whole(tmp_path: Path) -> None:
    save_splat(ball((0.5, 0.5, 0.5)), tmp_path / "ball.ply")
    exhibit = exhibit_of_file(tmp_path / "ball.ply")
    assert exhibit.names == ("ball",)
    assert (exhibit.start.azimuth, exhibit.start.elevation, exhibit.start.fov) == (30.0, 20.0, 45.0)
    assert list(exhibit.cameras) == ["whole scene"]


def test_wishes_stand_above_what_files_say() -> None:
    wished = Wishes(background=(1, 1, 1), near=0.5, size=(10, 20)).applied(exhibit())
    assert wished.settings == RenderSettings(background=(1, 1, 1), near=0.5)
    assert wished.size == (10, 20)
    same = exhibit()
    assert Wishes().applied(same).settings == same.settings


def test_a_splat_with_another_up_stands_upright(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As foreign splats have it, with y down; the command that the page shows makes the same picture."""
    monkeypatch.chdir(tmp_path)
    scene, down = oracle.random_scene(60, degree=1, seed=4), (0.0, -1.0, 0.0)
    turn = from_z(torch.tensor(down))
    save_splat(scene, "z.ply")
    save_splat(scene.transform(Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0)), "y.ply")
    wishes, orbit = Wishes(size=(48, 40)), Orbit(target=(0.1, 0.2, 0.0), azimuth=70, elevation=30, distance=4, fov=45)
    files = {"z.ply": UP, "y.ply": down}
    works = [Painter(wishes.applied(exhibit_of_file(Path(file)).turned(up)), Renderer()) for file, up in files.items()]
    upright, turned = (work.picture(work.exhibit.names[0], orbit) for work in works)
    torch.testing.assert_close(turned, upright, rtol=0, atol=1.1 / 255)
    command = shlex.split(works[1].commands(orbit)["y"])
    assert "--up" in command
    assert cli.main([*command[1:], "--out", "again.png"]) == 0
    with Image.open("again.png") as picture:
        again = np.asarray(picture, np.float32) / 255
    assert np.abs(again - upright.numpy()).max() <= 1.1 / 255


@pytest.mark.parametrize("wishes", [Wishes(), Wishes(background=(0.25, 0.5, 1.0), near=4.8, size=(40, 64))])
@pytest.mark.parametrize("moved", [False, True])
def test_the_command_makes_the_picture_to_the_bit(
    wishes: Wishes, moved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, colour in (("a b.ply", (0.9, 0.2, 0.1)), ("clean.ply", (0.2, 0.2, 0.9))):
        save_splat(ball(colour), tmp_path / name)
    exhibit = wishes.applied(exhibit_of_file(Path("a b.ply"), clean=Path("clean.ply")))
    orbit = exhibit.start
    if moved:
        orbit = orbit.moved((1.2345678, -3.0, 2.0), (0.2, 0.123456, -0.1))
    work = Painter(exhibit, Renderer(exhibit.settings))
    command = shlex.split(work.commands(orbit)["attacked"])
    assert command[:3] == ["mi-splat", "render", "a b.ply"]
    assert cli.main([*command[1:], "--out", "again.png"]) == 0
    with Image.open("again.png") as picture:
        again = np.asarray(picture)
    assert again.std() > 10
    assert np.array_equal(again, to_bytes(work.picture("attacked", orbit)))
    assert len(load_splat("a b.ply")) == len(exhibit.splat("attacked").scene)
