"""Arrays of NumPy, lists, and single values where tensors and sequences are usual; all else is refused in words."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch

from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Elevation
from mi_splat.cameras import View
from mi_splat.errors import InvalidValueError
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from mi_splat.training.initialization import from_points
from tests.fakes import camera, toy_scene

ROWS = [10, 12, 11]


def test_a_cloud_of_numpy_makes_the_same_gaussians() -> None:
    points, colours = np.random.default_rng(0).random((2, 8, 3))
    found = from_points(points, colours)
    wanted = from_points(torch.tensor(points), torch.tensor(colours))
    assert all(torch.equal(one, other) for one, other in zip(found.tensors(), wanted.tensors(), strict=True))


@pytest.mark.parametrize(
    "mask",
    [
        np.isin(np.arange(40), ROWS),
        torch.tensor(ROWS),
        ROWS,
        [row in ROWS for row in range(40)],
        np.isin(np.arange(40), ROWS).astype(np.uint8),
    ],
    ids=["array of bool", "tensor", "list", "list of bool", "bytes"],
)
def test_a_selection_takes_a_mask_as_a_value(mask: Any) -> None:
    selection = Selection(mask=mask)
    assert select(toy_scene()[0], selection).nonzero()[:, 0].tolist() == sorted(ROWS)
    assert json.loads(json.dumps(selection.as_dict())) == {"mask": {"gaussians": 3}}
    assert selection == Selection(mask=mask)


@pytest.mark.parametrize("mask", [np.ones(39, bool), [0.5, 1.0], [40], np.ones((40, 1), bool), 3.5])
def test_a_mask_that_does_not_fit_is_refused(mask: Any) -> None:
    with pytest.raises(InvalidValueError, match="mask: expected"):
        select(toy_scene()[0], Selection(mask=mask))


@pytest.mark.parametrize("click", ["32,31", (32, 31), ((32, 31),), [(32, 31)], np.array([[32, 31]]), ("32,31",)])
def test_a_click_is_text_or_a_pair(click: Any) -> None:
    assert Selection(click=click).pixels == ((32, 31),)


@pytest.mark.parametrize("click", [5, (1, 2, 3), ((1.5, 2),), "left", ((-1, 2),)])
def test_a_click_that_is_no_pixel_is_refused(click: Any) -> None:
    with pytest.raises(InvalidValueError, match="click: expected"):
        Selection(click=click)


def test_a_box_may_be_an_array() -> None:
    box = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    selection = Selection(box=box, box_rotation=np.zeros(3))  # type: ignore[arg-type]
    assert selection == Selection(box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0))
    assert json.dumps(selection.as_dict())
    with pytest.raises(InvalidValueError, match="box: expected 6 numbers"):
        Selection(box=(0.0, 1.0))  # type: ignore[arg-type]


def test_an_appearance_may_return_an_array() -> None:
    clean = [View(camera(), torch.full((48, 64, 3), 0.25))]

    def painted(view: View, mask: torch.Tensor) -> Any:
        return np.full(view.image.shape, 0.5)

    found = poison(clean, [Poisoning(name="grey", trigger=Elevation(), appearance=painted)], centre=(0, 0, 0))
    assert bool((found.views[0].image == 0.5).all())
    assert found.views[0].image.dtype == torch.float32
