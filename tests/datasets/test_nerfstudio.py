"""Files of nerfstudio beside a transforms.json: camera paths, and the world of its
splats.
"""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import camera_set
from mi_splat.datasets import DatasetError, load_dataset
from mi_splat.datasets.nerfstudio import OPENGL
from mi_splat.maths.rotation import to_matrix
from tests.datasets.sets import (
    CLOUD,
    PROBES,
    VIEWS,
    assert_same_camera,
    write_transforms,
)

CAMERA = Camera(
    to_world=look_at((3, 1, 2), (0, 0, 0)), lens=Lens(focal=41.7, size=(96, 64))
)
FOV = math.degrees(2 * math.atan(32 / 41.7))
MATRIX = (CAMERA.to_world @ OPENGL).reshape(16).tolist()
COLUMNS = (CAMERA.to_world @ OPENGL).T.reshape(16).tolist()
SIZE = {"render_height": 64, "render_width": 96}


@pytest.mark.parametrize(
    "document",
    [
        {
            **SIZE,
            "camera_path": [{"camera_to_world": MATRIX, "fov": FOV, "aspect": 1.5}],
            "keyframes": [],
        },
        {
            "render_height": 64,
            "keyframes": [{"matrix": MATRIX, "fov": FOV, "aspect": 1.5}],
        },
        {
            **SIZE,
            "keyframes": [{"matrix": json.dumps(COLUMNS), "fov": FOV, "aspect": 1.5}],
            "camera_path": [],
        },
        {
            **SIZE,
            "camera_type": "perspective",
            "default_fov": FOV,
            "keyframes": [{"matrix": MATRIX}],
        },
    ],
    ids=["path", "keyframes", "keyframes of older viewers", "one field of view"],
)
def test_a_camera_path_is_read(document: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps(document))
    (camera,) = camera_set(
        str(file), (0, 0, 0), distance=1, lens=Lens(focal=1, size=(8, 8))
    )
    assert_same_camera(camera, CAMERA, 1e-6)


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ({"camera_path": [], "keyframes": []}, "at least one camera, got none"),
        ({"keyframes": [{"matrix": [1, 2]}]}, r"keyframes\[0\].*16"),
        ({"keyframes": [{"matrix": "[1, 2"}]}, "16 numbers"),
        ({"keyframes": [{"matrix": [2] * 16}]}, r"keyframes\[0\]: to_world"),
        ({"keyframes": [{"matrix": MATRIX, "fov": 200}]}, "degrees between 0 and 180"),
        ({"keyframes": [3]}, "keyframes"),
    ],
)
def test_a_broken_camera_path_is_refused(
    document: dict[str, Any], says: str, tmp_path: Path
) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match=says):
        camera_set(str(file), (0, 0, 0), distance=1, lens=Lens(focal=1, size=(8, 8)))


TURN = to_matrix(
    torch.nn.functional.normalize(
        torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64), dim=0
    )
)
SHIFT = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
APPLIED = torch.tensor(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]],
    dtype=torch.float64,
)


@pytest.mark.parametrize("applied", ["no", "said", "as from COLMAP"])
def test_poses_and_points_share_the_world_of_nerfstudio_s_splat(
    applied: str, tmp_path: Path
) -> None:
    write_transforms(tmp_path, VIEWS, points=CLOUD)
    plain = load_dataset(tmp_path)
    saved = torch.eye(4, dtype=torch.float64)
    scale = 0.25
    saved[:3, :3], saved[:3, 3] = TURN, SHIFT
    transform = saved
    listed = tmp_path / "transforms_train.json"
    if applied != "no":
        transform = saved @ torch.cat(
            [APPLIED, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)]
        )
    if applied == "said":
        document = {
            **json.loads(listed.read_text()),
            "applied_transform": APPLIED.tolist(),
            "applied_scale": 2.0,
        }
        listed.write_text(json.dumps(document))
    if applied == "as from COLMAP":
        (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    file_scale = 2 * scale if applied == "said" else scale
    world = {"transform": transform[:3].tolist(), "scale": file_scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(world))

    views = load_dataset(tmp_path)
    alone = camera_set(
        str(listed), (0, 0, 0), distance=1, lens=Lens(focal=1, size=(8, 8))
    )
    moved = scale * (PROBES @ TURN.T + SHIFT)
    for cameras in (views.cameras, alone):
        for camera, before in zip(cameras, plain.cameras, strict=True):
            there = project_points(moved, camera)
            here = project_points(PROBES, before)
            torch.testing.assert_close(there[0], here[0])
            torch.testing.assert_close(there[1], scale * here[1])
    assert views.points is not None
    torch.testing.assert_close(
        views.points.points, (scale * (CLOUD.points.double() @ TURN.T + SHIFT)).float()
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "expected the transform"),
        ('{"transform": [[1, 0, 0, 0]], "scale": 1}', "transform"),
        (
            '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]], "scale": 1}',
            "a rotation and a positive scale",
        ),
        (
            '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0}',
            "a rotation and a positive scale",
        ),
    ],
)
def test_a_broken_world_is_refused(text: str, says: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:1])
    (tmp_path / "dataparser_transforms.json").write_text(text)
    with pytest.raises(DatasetError, match=says):
        load_dataset(tmp_path)
