"""The image of the page: its layout and content, and what is inspected is what
`mi-splat render` makes.
"""

import shlex
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from attacks import cli
from mi_splat.cameras.directions import UP
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.images import to_bytes
from mi_splat.maths.metrics import psnr
from mi_splat.maths.rotation import from_z
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import read_scene
from mi_splat.render.tile.frozen import PictureInterruptedError, interrupted_by
from mi_splat.scene import Similarity
from mi_splat.viewer.content import content_of_file
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import MOST_PIXELS, Painter, Thinned, within
from mi_splat.viewer.session import (
    DIFFERENCE,
    MARGIN,
    SIDE_BY_SIDE,
    Pace,
    Pixels,
    Step,
    ViewState,
    compose,
    difference,
    lay_out,
)
from tests.fakes import blobs
from tests.gaussians import varied_scene
from tests.project.layers import ROOT
from tests.viewer.contents import START, MeanInspector, ball, balls, painter
from tests.viewer.wire import PATIENCE

STATE = ViewState(orbit=START, mode=SIDE_BY_SIDE, canvas=(200, 100))
FULL = Step.FULL, Pace()


def flat(value: int, height: int = 4, width: int = 6) -> Pixels:
    return np.full((height, width, 3), value, np.uint8)


def middle(pixels: NDArray[np.uint8], part: slice) -> list[int]:
    """The colour in the middle of a part of the page."""
    box = pixels[:, part]
    return [int(value) for value in box[box.shape[0] // 2, box.shape[1] // 2]]


@given(
    st.integers(1, 600),
    st.integers(1, 600),
    st.floats(0.3, 3),
    st.integers(1, 2),
    st.integers(0, 4),
)
def test_pictures_lie_inside_and_apart(
    width: int, height: int, aspect: float, count: int, gap: int
) -> None:
    layout = lay_out((width, height), aspect, count, gap=gap)
    w, h = layout.size
    page = compose([flat(200, h, w)] * count, layout)
    assert page.shape == (layout.canvas[1], layout.canvas[0], 3)
    if min(width, height) > 60:  # else a pixel is a lot
        assert min(map(min, layout.corners)) >= 0
        assert w / h == pytest.approx(aspect, rel=0.1)
        assert int((page == 200).all(-1).sum()) == count * w * h  # none covers another
        assert (page == 200).all(-1).sum() + (page == MARGIN).all(
            -1
        ).sum() == page.size / 3


@pytest.mark.parametrize(
    ("change", "grey"), [(0, 0), (10, 20), (100, 200), (128, 255), (255, 255)]
)
def test_the_difference_is_the_change_in_either_direction(
    change: int, grey: int
) -> None:
    assert (difference(flat(0), flat(change)) == grey).all()
    assert (difference(flat(change), flat(0)) == grey).all()


def test_two_splats_stand_side_by_side() -> None:
    pixels = painter().paint(STATE, *FULL).pixels
    assert pixels.shape == (100, 200, 3)
    red = middle(pixels, slice(0, 98))
    green = middle(pixels, slice(102, 200))
    assert red[0] > 150 > red[1]
    assert green[1] > 130 > green[0]
    changes = painter().paint(replace(STATE, mode=DIFFERENCE), *FULL).pixels
    assert sum(middle(changes, slice(0, 200))) > 400
    assert painter().paint(STATE, Step.COARSE, Pace(scale=0.25)).pixels.shape == (
        25,
        50,
        3,
    )


def test_what_is_inspected_has_8_bits_and_is_inspected_once_at_rest() -> None:
    inspector = MeanInspector()
    work = painter(inspector=inspector)
    for step in (Step.COARSE, Step.FULL):
        assert not work.paint(STATE, step, Pace()).inspections
    assert not inspector.seen
    painting = work.paint(STATE, Step.INSPECTED, Pace())
    assert list(painting.inspections) == ["clean", "attacked"]
    expected = to_bytes(
        work.render(work.content.splats[0].scene, START.camera((48, 32)))
    )
    assert np.array_equal(to_bytes(inspector.seen[0]), expected)
    assert torch.equal(inspector.seen[0], (inspector.seen[0] * 255).round() / 255)
    assert (painting.pixels[20:24, 3:8] == 255).all()  # the mark
    work.paint(replace(STATE, mode="clean"), Step.INSPECTED, Pace())
    assert len(inspector.seen) == 2
    work.paint(
        replace(STATE, orbit=replace(START, azimuth=1.0)), Step.INSPECTED, Pace()
    )
    assert len(inspector.seen) == 4
    state = replace(STATE, mode=DIFFERENCE)  # without marks
    assert np.array_equal(
        work.paint(state, Step.INSPECTED, Pace()).pixels,
        work.paint(state, *FULL).pixels,
    )


@pytest.mark.parametrize("canvas", [(1, 1), (16, 8192), (8192, 8192), (4000, 4000)])
def test_no_window_is_too_large_or_too_small(canvas: tuple[int, int]) -> None:
    width, height = within(canvas, MOST_PIXELS)
    assert width * height <= 1.01 * MOST_PIXELS
    assert min(lay_out((width, height), 1.5, 2).size) >= 1


def test_a_quarter_of_the_gaussians_looks_like_all() -> None:
    loaded = read_scene(ROOT / "scenes" / "car_street.xml")
    lens = Lens(focal=125.0, size=(128, 128))
    camera = replace(loaded.cameras["rear"], lens=lens)
    render = Renderer(loaded.settings)
    quarter = Thinned(loaded.scene)(4)
    # without what makes up for the others
    small = quarter.replace(scales=quarter.scales / 2)
    full = render(loaded.scene, camera)
    assert len(quarter) == len(loaded.scene) // 4
    similarity = psnr(render(quarter, camera), full)
    assert similarity > 22
    assert psnr(render(small, camera), full) < similarity - 4


@pytest.mark.parametrize("mode", ["clean", SIDE_BY_SIDE, DIFFERENCE])
def test_only_coarse_pictures_have_fewer_gaussians_and_say_so(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles = list[str]()
    monkeypatch.setattr(
        "mi_splat.viewer.painter.write_label",
        lambda draw, corner, text, *_, **__: titles.append(text),
    )
    work = Painter(balls(count=1000), blobs, MeanInspector())
    state = ViewState(orbit=START, mode=mode, canvas=(30, 20))
    coarse, full = (
        work.paint(state, step, Pace(scale=1.0)) for step in (Step.COARSE, Step.FULL)
    )
    # which would show the differences of other Gaussians
    assert (coarse.every > 1) == (mode != DIFFERENCE)
    assert full.every == 1
    assert ("preview" in titles[0], "preview" in titles[-1]) == (
        coarse.every > 1,
        False,
    )
    work.paint(state, Step.COARSE, Pace(scale=0.9))
    assert "preview" in titles[-1]


def test_an_interrupted_picture_ends_between_two_stages_and_leaves_nothing(
    variant: str,
) -> None:
    render = Renderer()
    camera = START.camera((48, 32))
    scene = ball((0.9, 0.1, 0.1))
    before = render(scene, camera)
    answers = iter((False, False, True))
    with pytest.raises(PictureInterruptedError), interrupted_by(lambda: next(answers)):
        render(scene, camera)
    assert torch.equal(render(scene, camera), before)


def test_a_detector_that_looks_for_long_holds_nothing_up() -> None:
    held = threading.Event()
    inspector = MeanInspector()
    work = Painter(
        balls(1), blobs, lambda picture: inspector(picture * held.wait(PATIENCE))
    )
    with pytest.raises(PictureInterruptedError), interrupted_by(lambda: True):
        work.inspect("clean", START)
    held.set()
    assert (
        work.inspect("clean", START).text
        == painter(inspector=inspector).inspect("clean", START).text
    )


def test_files_have_names_that_a_page_can_show(tmp_path: Path) -> None:
    save_splat(ball((0.5, 0.5, 0.5)), tmp_path / f"{DIFFERENCE}.ply")
    content = content_of_file(tmp_path / f"{DIFFERENCE}.ply")
    assert content.names == (f"{DIFFERENCE}.ply",)
    assert (content.start.azimuth, content.start.elevation, content.start.fov) == (
        30.0,
        20.0,
        45.0,
    )
    assert list(content.cameras) == ["whole scene"]
    with pytest.raises(
        InvalidValueError,
        match="name of a splat: expected no display mode, got difference",
    ):
        content_of_file(tmp_path / f"{DIFFERENCE}.ply", name=DIFFERENCE)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"splats": 2 * balls(1).splats},
            "splats: expected one, or two of different names",
        ),
        ({"title": "a\udcff"}, r"name: expected Unicode, got 'a\\udcff"),
        ({"cameras": {"a\udcff": START}}, r"name: expected Unicode, got 'a\\udcff"),
        (
            {"splats": (replace(balls(1).splats[0], path=Path("a\udcff")),)},
            r"name: expected Unicode, got 'a\\udcff",
        ),
    ],
)
def test_names_that_a_page_cannot_show(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidValueError, match=reason):
        replace(balls(1), **changes)


def test_a_splat_with_another_up_stands_upright(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As foreign splats have it, with y down; the command that the page shows makes the
    same image.
    """
    monkeypatch.chdir(tmp_path)
    scene = varied_scene(60, degree=1, seed=4)
    down = (0.0, -1.0, 0.0)
    turn = from_z(torch.tensor(down))
    save_splat(scene, "z.ply")
    save_splat(
        scene.transform(
            Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0)
        ),
        "y.ply",
    )
    orbit = Orbit(target=(0.1, 0.2, 0.0), azimuth=70, elevation=30, distance=4, fov=45)
    works = [
        Painter(
            content_of_file(Path(file)).turned(up).with_settings(size=(48, 40)),
            Renderer(),
        )
        for file, up in {"z.ply": UP, "y.ply": down}.items()
    ]
    upright, turned = (work.picture(work.content.names[0], orbit) for work in works)
    torch.testing.assert_close(turned, upright, rtol=0, atol=1.1 / 255)
    command = shlex.split(works[1].commands(orbit)["y"])
    assert "--up" in command
    assert cli.main([*command[1:], "--out", "again.png"]) == 0
    with Image.open("again.png") as picture:
        again = np.asarray(picture, np.float32) / 255
    assert np.abs(again - upright.numpy()).max() <= 1.1 / 255


@pytest.mark.parametrize(
    ("settings", "moved"),
    [
        ({}, True),
        ({"background": (0.25, 0.5, 1.0), "near": 4.8, "size": (40, 64)}, False),
    ],
)
def test_the_command_makes_the_picture_to_the_bit(
    settings: dict[str, Any],
    moved: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variant: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, colour in (("a b.ply", (0.9, 0.2, 0.1)), ("clean.ply", (0.2, 0.2, 0.9))):
        save_splat(ball(colour), tmp_path / name)
    content = content_of_file(Path("a b.ply"), clean=Path("clean.ply")).with_settings(
        **settings
    )
    if settings:
        assert content.settings == RenderSettings(
            background=settings["background"], near=settings["near"]
        )
    orbit = content.start
    if moved:
        orbit = orbit.moved((1.2345678, -3.0, 2.0), (0.2, 0.123456, -0.1))
    work = Painter(content, Renderer(content.settings))
    command = shlex.split(work.commands(orbit)["attacked"])
    assert command[:3] == ["mi-splat", "render", "a b.ply"]
    assert cli.main([*command[1:], "--out", "again.png"]) == 0
    with Image.open("again.png") as picture:
        again = np.asarray(picture)
    assert again.std() > 10
    assert np.array_equal(again, to_bytes(work.picture("attacked", orbit)))
