"""Boxes and mask files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from mi_splat.errors import InvalidValueError
from mi_splat.io import SplatFileError, save_splat
from mi_splat.io.points import PointCloud, save_points
from mi_splat.selection.masks import box_mask, load_mask, save_mask
from tests.gaussians import random_scene

BOX = (-1.0, -0.5, -0.25, 1.0, 0.5, 0.25)


def test_a_box_holds_the_means_between_its_corners() -> None:
    scene = random_scene(200)
    low, high = torch.tensor(BOX[:3]), torch.tensor(BOX[3:])
    inside = ((scene.means >= low) & (scene.means <= high)).all(1)
    assert 0 < int(inside.sum()) < 200
    assert torch.equal(box_mask(scene, BOX), inside)


@pytest.mark.parametrize(
    ("rotation", "box"),
    [
        ((90.0, 0.0, 0.0), (-0.5, -1.0, -0.25, 0.5, 1.0, 0.25)),
        ((0.0, 90.0, 0.0), (-0.25, -0.5, -1.0, 0.25, 0.5, 1.0)),
        ((0.0, 0.0, 90.0), (-1.0, -0.25, -0.5, 1.0, 0.25, 0.5)),
        ((0.0, 90.0, 90.0), (-0.5, -0.25, -1.0, 0.5, 0.25, 1.0)),  # the roll first
    ],
)
def test_a_turned_box_is_one_with_other_sides(
    rotation: tuple[float, float, float], box: tuple[float, float, float, float, float, float]
) -> None:
    scene = random_scene(500)
    assert torch.equal(box_mask(scene, BOX, rotation), box_mask(scene, box))


def test_yaw_turns_from_x_to_y_about_the_middle_of_the_box() -> None:
    a = math.radians(30)
    far = (5 + 0.9 * math.cos(a), 3 + 0.9 * math.sin(a), 0.0)
    other = (5 + 0.9 * math.cos(a), 3 - 0.9 * math.sin(a), 0.0)
    scene = random_scene(2).replace(means=torch.tensor([far, other]))
    box = (4.0, 2.9, -1.0, 6.0, 3.1, 1.0)
    assert box_mask(scene, box, (30.0, 0.0, 0.0)).tolist() == [True, False]


@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int64])
def test_a_mask_comes_back(kind: type, tmp_path: Path) -> None:
    scene, mask = random_scene(20), torch.arange(20) % 3 == 0
    save_mask(mask, tmp_path / "a.npy")
    assert np.load(tmp_path / "a.npy").dtype == np.bool_
    np.save(tmp_path / "b.npy", mask.numpy().astype(kind))
    for name in ("a.npy", "b.npy"):
        assert torch.equal(load_mask(tmp_path / name, scene), mask)


def test_row_numbers_are_a_mask(tmp_path: Path) -> None:
    np.save(tmp_path / "rows.npy", np.array([7, 2, 7]))
    assert load_mask(tmp_path / "rows.npy", random_scene(20)).nonzero()[:, 0].tolist() == [2, 7]


@pytest.mark.parametrize("kind", ["splat", "points"])
def test_a_part_is_found_by_its_positions(kind: str, tmp_path: Path) -> None:
    scene, rows = random_scene(50), torch.tensor([40, 3, 17])
    part = scene.select(rows)
    if kind == "splat":
        save_splat(part, tmp_path / "part.ply")
    else:
        save_points(PointCloud(part.means, torch.zeros(3, 3)), tmp_path / "part.ply")
    assert load_mask(tmp_path / "part.ply", scene).nonzero()[:, 0].tolist() == [3, 17, 40]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (np.ones(19, dtype=bool), "20 bools, one a Gaussian, got 19"),
        (np.array([0, 20]), r"row numbers in 0\.\.19, got 0 to 20"),
        (np.array([-1]), "row numbers"),
        (np.ones(20), "float64"),
        (np.ones((20, 1), dtype=bool), "shape"),
    ],
)
def test_an_array_that_does_not_fit_is_refused(values: np.ndarray, says: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(InvalidValueError, match=says):
        load_mask(tmp_path / "a.npy", random_scene(20))


def test_a_part_of_another_splat_is_refused(tmp_path: Path) -> None:
    scene = random_scene(20)
    moved = scene.select(slice(0, 5))
    save_splat(moved.replace(means=moved.means + torch.tensor([0.0, 0.0, 1e-3])), tmp_path / "part.ply")
    with pytest.raises(InvalidValueError, match="5 of 5 that are not"):
        load_mask(tmp_path / "part.ply", scene)


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(b"no array")
    with pytest.raises(SplatFileError, match="array of NumPy"):
        load_mask(tmp_path / "a.npy", random_scene(3))
    with pytest.raises(SplatFileError, match="missing"):
        load_mask(tmp_path / "missing.npy", random_scene(3))
    with pytest.raises(InvalidValueError, match=r"npy or \.ply"):
        load_mask(tmp_path / "mask.txt", random_scene(3))
