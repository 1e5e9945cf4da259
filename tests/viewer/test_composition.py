"""Pictures beside each other, split, and their difference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_splat.viewer.composition import (
    BESIDE,
    DIFFERENCE,
    MARGIN,
    SPLIT,
    Pixels,
    compose,
    heat_map,
    lay_out,
    needed,
    pane_pixels,
    panes,
    split_pictures,
    ways_of_showing,
)

NAMES = ("clean", "attacked")


def flat(value: int, height: int = 4, width: int = 6) -> Pixels:
    return np.full((height, width, 3), value, np.uint8)


def test_ways_of_showing() -> None:
    assert ways_of_showing(("one",)) == ("one",)
    assert ways_of_showing(NAMES) == (BESIDE, SPLIT, "clean", "attacked", DIFFERENCE)
    assert panes(BESIDE, NAMES) == NAMES
    assert panes("clean", NAMES) == needed("clean", NAMES) == ("clean",)
    assert needed(SPLIT, NAMES) == needed(DIFFERENCE, NAMES) == NAMES


@given(st.integers(1, 3000), st.integers(1, 3000), st.floats(0.3, 3), st.integers(1, 2), st.integers(0, 4))
def test_pictures_lie_inside_and_apart(width: int, height: int, aspect: float, count: int, gap: int) -> None:
    layout = lay_out((width, height), aspect, count, gap=gap)
    w, h = layout.size
    assert len(layout.corners) == count
    page = compose([flat(200, h, w)] * count, layout)
    assert page.shape == (layout.canvas[1], layout.canvas[0], 3)
    if min(width, height) > 60:  # else a pixel is a lot
        assert min(map(min, layout.corners)) >= 0
        assert all(x + w <= layout.canvas[0] and y + h <= layout.canvas[1] for x, y in layout.corners)
        assert w / h == pytest.approx(aspect, rel=0.1)
        assert int((page == 200).all(-1).sum()) == count * w * h  # none covers another


def test_a_wide_page_has_a_row_and_a_high_one_leaves_room_for_its_controls() -> None:
    wide, high = lay_out((1000, 400), 1.0, 2), lay_out((320, 640), 1.0, 2)
    assert wide.corners[0][1] == wide.corners[1][1]
    assert wide.size == (400, 400)
    assert all(y + high.size[1] <= 0.45 * 640 for _, y in high.corners)


def test_what_is_around_the_pictures() -> None:
    page = compose([flat(9, 10, 10)], lay_out((30, 10), 1.0, 1))
    assert (page[:, 10:20] == 9).all()
    assert (page[:, :10] == MARGIN).all()


@pytest.mark.parametrize(("at", "left"), [(-1.0, 0), (0.0, 0), (0.5, 3), (1.0, 6), (2.0, 6)])
def test_a_split_picture(at: float, left: int) -> None:
    both = split_pictures(flat(10), flat(20), at)
    line = set(range(max(left - 1, 0), left + 1))
    for column in range(6):
        expected = 255 if column in line else 10 if column < left else 20
        assert (both[:, column] == expected).all()


def test_heat_rises_with_the_change_in_either_direction() -> None:
    colours = [heat_map(flat(100), flat(100 + change))[0, 0].astype(int).sum() for change in (0, 10, 40, 90, 128)]
    assert colours[0] == 0
    assert colours == sorted(set(colours))
    assert (heat_map(flat(0), flat(255)) == (255, 255, 210)).all()
    assert np.array_equal(heat_map(flat(0), flat(40)), heat_map(flat(40), flat(0)))


def test_panes_take_what_they_need() -> None:
    pictures = {"clean": flat(10), "attacked": flat(20)}
    assert (pane_pixels("attacked", pictures) == 20).all()
    assert (pane_pixels(SPLIT, pictures, split=1.0)[:, 0] == 10).all()
    assert np.array_equal(pane_pixels(DIFFERENCE, pictures), heat_map(flat(10), flat(20)))
