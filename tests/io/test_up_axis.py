"""Which way is up in a splat file: what it says, its cameras, its ground, its format,
or z.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mi_splat.cameras.camera import look_at
from mi_splat.io.splat_files import load_stored, save_splat
from mi_splat.io.up_axis import (
    Direction,
    UpAxis,
    cameras_up,
    commented_up,
    ground_up,
    up_axis,
)
from mi_splat.maths.rotation import from_z
from tests.gaussians import random_scene
from tests.io.ply_files import BODY, HEAD

BRUSH = "Exported from Brush"


def _up_of(path: Path) -> UpAxis:
    return up_axis(path, load_stored(path))


def _commented(path: Path, *comments: str) -> Path:
    lines = "".join(f"comment {comment}\n" for comment in comments).encode()
    path.write_bytes(HEAD.replace(b"element vertex", lines + b"element vertex") + BODY)
    return path


@pytest.mark.parametrize(
    ("comments", "wanted"),
    [
        (["Vertical Axis: z"], (0, 0, 1)),
        (["Vertical axis: y"], (0, 1, 0)),
        (["vertical axis: -Y"], (0, -1, 0)),
        ([BRUSH, "Vertical axis: y"], (0, -1, 0)),
        ([BRUSH, "Vertical axis: z"], (0, 0, 1)),
        (["Vertical axis: z", "Vertical axis: x (twin)"], (1, 0, 0)),
        (["Vertical axis: [0, -3, 4]"], (0, -0.6, 0.8)),
        (["Vertical axis: 0 0 0"], None),
        (["Vertical axis: up"], None),
        (["made by hand"], None),
    ],
)
def test_comments_are_followed(
    comments: Sequence[str], wanted: Direction | None, tmp_path: Path
) -> None:
    assert commented_up(comments) == wanted
    found = _up_of(_commented(tmp_path / "a.ply", *comments))
    assert found.direction == (wanted or (0, 0, 1))
    assert found.is_stated == (wanted is not None)


def _stage(count: int = 4000, *, seed: int = 0) -> NDArray[np.float64]:
    """A ground of z up, objects on it, and some floaters."""
    random = np.random.default_rng(seed)
    ground = random.uniform(-4, 4, (count, 3)) * [1, 1, 0.005]
    things = random.normal(0, 0.4, (count, 3)) * [1, 1, 0.5] + [0.5, -0.3, 0.7]
    floaters = random.uniform(-20, 20, (count // 50, 3))
    return np.concatenate([ground, things, floaters])


@pytest.mark.parametrize(
    "up",
    [
        (0, 0, 1),
        (0, -1, 0),
        (0, 1, 0),
        (-1, 0, 0),
        (0.0, -0.8, 0.6),
        (0.6, 0.64, -0.48),
    ],
)
def test_a_ground_is_found_in_any_direction(up: Direction) -> None:
    turn = from_z(torch.tensor(up, dtype=torch.float64)).numpy()
    found = ground_up(_stage() @ turn.T + 7, np.ones(8080))
    assert found is not None
    assert np.dot(found, up) > 0.998
    if max(map(abs, up)) == 1:
        assert found == up


def test_what_has_no_ground_is_not_guessed() -> None:
    random = np.random.default_rng(0)
    ball = random.normal(size=(3000, 3))
    plate = random.uniform(-1, 1, (3000, 3)) * [1, 0.01, 1]
    pole = random.uniform(-0.02, 0.02, (800, 3)) + np.linspace(0, -4, 800)[:, None] * [
        0,
        0,
        1,
    ]
    box = np.abs(random.uniform(-1, 1, (3000, 3)))
    box[np.arange(3000), random.integers(0, 3, 3000)] = random.integers(0, 2, 3000)
    for points in (
        ball,
        np.concatenate([plate, pole]),
        box,
        ball[:50],
        np.zeros((500, 3)),
    ):
        assert ground_up(points, np.ones(len(points))) is None
    assert ground_up(_stage(), np.full(8080, 0.01)) is None  # nothing solid


def test_upright_cameras_tell_and_others_do_not() -> None:
    random = np.random.default_rng(0)
    eyes = random.normal(size=(30, 3)) * 3 + [0, 0, 4]
    poses = np.stack(
        [look_at(eye.tolist(), (0.0, 0.0, 0.0))[:3, :3].numpy() for eye in eyes]
    )
    assert cameras_up(poses) == (0, 0, 1)
    turn = from_z(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)).numpy()
    assert cameras_up(turn @ poses) == (0, -1, 0)
    level = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))[:3, :3].numpy()
    assert cameras_up(np.stack([level] * 5)) == (0, 0, 1)  # all look the same way
    half = poses.copy()
    half[::2] = half[::2] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])  # portrait
    assert cameras_up(half) is None
    assert cameras_up(poses[:0]) is None


def test_cameras_of_3dgs_beside_a_splat_decide(tmp_path: Path) -> None:
    folder = tmp_path / "point_cloud" / "iteration_7000"
    folder.mkdir(parents=True)
    (folder / "point_cloud.ply").write_bytes(HEAD + BODY)
    turn = from_z(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)).numpy()
    eyes = np.random.default_rng(0).normal(size=(9, 3)) * 3
    rotations = [
        (turn @ look_at(eye.tolist(), (0.0, 0.0, 0.0))[:3, :3].numpy()).tolist()
        for eye in eyes
    ]
    listed = tmp_path / "cameras.json"
    listed.write_text(json.dumps([{"rotation": rotation} for rotation in rotations]))
    for path in (tmp_path, folder / "point_cloud.ply"):
        assert _up_of(path) == UpAxis(
            (0, -1, 0), "as the cameras of its training stood"
        )
    for broken in ("[]", "[1]", "{", '[{"rotation": [[1]]}]', '[{"rotation": "x"}]'):
        listed.write_text(broken)
        assert _up_of(tmp_path).direction == (0, 0, 1)


def test_formats_that_define_up_count_unless_this_program_wrote_them(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.glb"
    save_splat(random_scene(50), path)
    assert _up_of(path) == UpAxis((0, 0, 1), "nothing says otherwise")
    path.write_bytes(path.read_bytes().replace(b'"mi-splat"', b'"so-splat"'))
    assert _up_of(path) == UpAxis((0, -1, 0), "as its format defines")
