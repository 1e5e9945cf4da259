"""Fewer and larger Gaussians: they look like all, only pictures of a moving camera have them, and these say so."""

from dataclasses import replace
from pathlib import Path

import pytest

from mi_splat.metrics import psnr
from mi_splat.rendering import Renderer
from mi_splat.scene_files import read_scene
from mi_splat.viewer.composition import BESIDE, DIFFERENCE
from mi_splat.viewer.exhibit import Exhibit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.session import Pace, Step, ViewState
from mi_splat.viewer.thinning import DENSITY, MOST, Thinned, thinning
from tests.fakes import blobs
from tests.viewer.exhibits import START, Looker, ball, exhibit

ROOT = Path(__file__).resolve().parents[2]


def dense(count: int) -> Exhibit:
    """Two splats of so many Gaussians."""
    balls = exhibit()
    return replace(balls, splats=tuple(replace(splat, scene=ball((0.9, 0.1, 0.1), count)) for splat in balls.splats))


def test_a_quarter_of_the_gaussians_looks_like_all() -> None:
    loaded = read_scene(ROOT / "scenes" / "car_street.xml")
    camera, render = replace(loaded.cameras["rear"], width=128, height=128, focal=125.0), Renderer(loaded.settings)
    quarter = Thinned(loaded.scene)(4)
    small = quarter.replace(scales=quarter.scales / 2)  # without what makes up for the others
    full = render(loaded.scene, camera)
    assert len(quarter) == len(loaded.scene) // 4
    likeness = psnr(render(quarter, camera), full)
    assert likeness > 22
    assert psnr(render(small, camera), full) < likeness - 4


@pytest.mark.parametrize(
    ("count", "pixels", "every"),
    [(0, 1, 1), (900, 900, 1), (901, 900, 2), (3600, 900, 4), (1_000_000, 150_000, 8), (10**9, 1, MOST)],
)
def test_pictures_of_few_pixels_have_few_gaussians(count: int, pixels: int, every: int) -> None:
    assert thinning(count, pixels) == every
    assert every == MOST or count / every <= DENSITY * pixels


@pytest.mark.parametrize("show", ["clean", BESIDE, DIFFERENCE])
def test_only_coarse_pictures_have_fewer_gaussians(show: str) -> None:
    work = Painter(dense(1000), blobs, Looker())
    state = ViewState(orbit=START, show=show, canvas=(30, 20))
    coarse, full, inspected = (work.paint(state, step, Pace(scale=1.0)) for step in Step)
    assert (coarse.every > 1) == (show != DIFFERENCE)  # of two splats the heat map would show other Gaussians
    assert full.every == inspected.every == 1


def test_pictures_that_are_not_whole_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    state, lines = ViewState(orbit=START, show="clean", canvas=(60, 40)), list[str]()
    monkeypatch.setattr("mi_splat.viewer.painter.write_label", lambda draw, corner, text, *_, **__: lines.append(text))
    few, many = (Painter(dense(count), blobs) for count in (20, 5000))
    few.paint(state, Step.COARSE, Pace(scale=1.0))
    few.paint(state, Step.COARSE, Pace(scale=0.9))
    many.paint(state, Step.COARSE, Pace(scale=1.0))
    many.paint(state, Step.FULL, Pace())
    assert lines == ["clean", "clean (preview)", "clean (preview)", "clean"]
