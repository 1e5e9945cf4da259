"""Picture sets: both formats there and back, poses, intrinsics, binary models."""

from __future__ import annotations

import json
import math
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from PIL import Image

from mi_splat.cameras import Camera, View, look_at
from mi_splat.datasets import load_dataset, write_colmap, write_transforms
from mi_splat.io.points import load_points, save_points
from mi_splat.rotation import normalise, to_matrix
from tests.datasets.sets import CLOUD, FORMATS, TESTS, VIEWS, assert_same_camera, colmap_binary, view


@pytest.mark.parametrize(("name", "tolerance"), [("transforms", 1e-9), ("colmap", 1e-6)])
def test_sets_come_back_as_they_were(name: str, tolerance: float, tmp_path: Path) -> None:
    FORMATS[name](tmp_path / "set", VIEWS, test=TESTS, points=CLOUD)
    for split, wanted in (("train", VIEWS), ("test", TESTS)):
        found = load_dataset(tmp_path / "set", split=split)  # type: ignore[arg-type]
        assert len(found) == len(wanted)
        for ours, theirs in zip(found, wanted, strict=True):
            assert torch.equal(ours.image, theirs.image)
            assert_same_camera(ours.camera, theirs.camera, tolerance)
        assert found.points is not None
        assert torch.equal(found.points.colours, CLOUD.colours)
        torch.testing.assert_close(found.points.points, CLOUD.points, atol=1e-7, rtol=0)
        assert found.mask(0) is None
    assert len(load_dataset(tmp_path / "set", split=None)) == len(VIEWS) + len(TESTS)


@pytest.mark.parametrize("name", FORMATS)
def test_what_was_loaded_can_be_written_again(name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path / "a", VIEWS, points=CLOUD)
    first = load_dataset(tmp_path / "a", split=None, cache_bytes=0)
    write_transforms(tmp_path / "b", first, points=first.points)
    second = load_dataset(tmp_path / "b", split=None)
    assert all(torch.equal(a.image, b.image) for a, b in zip(first, second, strict=True))
    assert (tmp_path / "b" / "points3D.ply").read_bytes()[:3] == b"ply"


def test_cameras_of_different_kinds_in_one_set(tmp_path: Path) -> None:
    views = [view(0), view(1, focal=30.0, principal=None), view(2, width=9, height=20)]
    for name, write in FORMATS.items():
        write(tmp_path / name, views)
        for ours, theirs in zip(load_dataset(tmp_path / name, split=None), views, strict=True):
            assert_same_camera(ours.camera, theirs.camera, 1e-6)


@hypothesis.settings(max_examples=20)
@hypothesis.given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1),
    place=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_any_pose_comes_back(
    quaternion: tuple[float, ...], place: tuple[float, ...], tmp_path_factory: pytest.TempPathFactory
) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = to_matrix(normalise(torch.tensor(quaternion, dtype=torch.float64)))
    pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
    camera = Camera(to_world=pose, focal=5.0, width=2, height=1)
    folder = tmp_path_factory.mktemp("pose")
    for name, write in FORMATS.items():
        write(folder / name, [View(camera, torch.zeros(1, 2, 3))])
        (found,) = load_dataset(folder / name, split=None).cameras
        torch.testing.assert_close(found.to_world, camera.to_world, atol=1e-9 if name == "transforms" else 1e-6, rtol=0)


def test_opengl_and_colmap_axes_by_hand(tmp_path: Path) -> None:
    camera = Camera(to_world=look_at((5, 0, 0), (0, 0, 0)), focal=10.0, width=4, height=4)
    single = [View(camera, torch.zeros(4, 4, 3))]
    write_transforms(tmp_path / "a", single)
    matrix = np.array(
        json.loads((tmp_path / "a" / "transforms_train.json").read_text())["frames"][0]["transform_matrix"]
    )
    assert np.allclose(matrix, [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # right +y, up +z, back +x
    write_colmap(tmp_path / "b", single)
    lines = (tmp_path / "b" / "sparse" / "0" / "images.txt").read_text().splitlines()
    words = [float(word) for word in lines[1].split()[1:8]]
    rotation = to_matrix(torch.tensor(words[:4], dtype=torch.float64))
    seen = rotation @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) + torch.tensor(words[4:], dtype=torch.float64)
    torch.testing.assert_close(seen, torch.tensor([1.0, 0.0, 5.0], dtype=torch.float64))  # world +y is at the right


def test_a_set_of_blender(tmp_path: Path) -> None:
    # As the original NeRF scenes: an angle, no sizes, names without a suffix.
    (tmp_path / "train").mkdir()
    Image.new("RGBA", (20, 10), (255, 0, 0, 128)).save(tmp_path / "train" / "r_0.png")
    frame = {"file_path": "./train/r_0", "rotation": 0.01, "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": math.pi / 2, "frames": [frame]}))
    black, white = (load_dataset(tmp_path, background=(level,) * 3) for level in (0.0, 1.0))
    camera = black.cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((10, 10, 10, 5))
    assert torch.equal(camera.to_world, torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)))
    share = 128 / 255
    assert black[0].image[3, 3].tolist() == pytest.approx([share, 0, 0])
    assert white[0].image[3, 3].tolist() == pytest.approx([1, 1 - share, 1 - share])
    mask = black.mask(0)
    assert mask is not None
    assert mask.shape == (10, 20)
    assert mask[0, 0] == pytest.approx(share)


def test_one_file_for_all_pictures_with_intrinsics_by_frame(tmp_path: Path) -> None:
    frames = []
    for i in range(9):
        Image.new("RGB", (8, 6)).save(tmp_path / f"{i}.jpg")
        own = {"fl_x": 7.5, "cx": 3.5} if i == 8 else {}
        frames.append({"file_path": f"{i}.jpg", "transform_matrix": np.eye(4).tolist(), **own})
    document = {"fl_x": 9.0, "fl_y": 8.0, "cx": 4.5, "cy": 2.5, "w": 8, "h": 6, "k1": 0.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    whole = load_dataset(tmp_path / "transforms.json", split=None)
    assert [(c.fx, c.fy, c.cx, c.cy) for c in whole.cameras] == [(9.0, 8.0, 4.5, 2.5)] * 8 + [(7.5, 8.0, 3.5, 2.5)]
    assert [path.stem for path in load_dataset(tmp_path, split="test").paths] == ["0", "8"]
    assert [path.stem for path in load_dataset(tmp_path, split="test", test_every=4).paths] == ["0", "4", "8"]
    assert len(load_dataset(tmp_path, split="train")) == 7
    document |= {"test_filenames": ["3.jpg"], "train_filenames": ["1.jpg", "2.jpg"]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert [path.stem for path in load_dataset(tmp_path, split="test").paths] == ["3"]
    assert [path.stem for path in load_dataset(tmp_path, split="train").paths] == ["1", "2"]


def test_binary_models(tmp_path: Path) -> None:
    model = colmap_binary(tmp_path, VIEWS, CLOUD)
    found = load_dataset(tmp_path, split=None)
    assert (found.cameras[0].fx, found.cameras[0].fy, found.cameras[0].cx, found.cameras[0].cy) == (20, 20, 9, 6.5)
    for ours, theirs in zip(found[1:], VIEWS[1:], strict=True):
        assert torch.equal(ours.image, theirs.image)
        assert_same_camera(ours.camera, theirs.camera, 1e-9)
    assert found.points is not None
    assert torch.equal(found.points.points, CLOUD.points)
    assert torch.equal(found.points.colours, CLOUD.colours)
    assert [path.name for path in load_dataset(tmp_path, split="test", test_every=4).paths] == [
        "view 0.png",
        "view 4.png",
    ]
    for place in (model, model.parent):  # pictures are found from the model's folder too
        assert len(load_dataset(place, split=None)) == len(VIEWS)
    (model / "points3D.bin").unlink()
    assert load_dataset(tmp_path).points is None


def test_text_models_with_comments_and_2d_points(tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS[:2])
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    lines[2] = "1.5 2.5 -1 3.0 4.0 17"
    file.write_text("\n".join(["# more", "", *lines]))  # without a newline at the end
    for ours, theirs in zip(load_dataset(tmp_path, split=None), VIEWS[:2], strict=True):
        assert_same_camera(ours.camera, theirs.camera, 1e-6)


def test_points_in_ascii_without_colours(tmp_path: Path) -> None:
    file = tmp_path / "points.ply"
    head = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    file.write_text(head + "1 2 3\n4 5 6\n")
    cloud = load_points(file)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert bool((cloud.colours == 0.5).all())
    save_points(cloud, file)
    assert torch.equal(load_points(file).points, cloud.points)
