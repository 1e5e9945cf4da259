"""Image sets: both formats there and back, poses, intrinsics, binary models."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from PIL import Image

from mi_splat.cameras.camera import Camera, View, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import Dataset, DatasetWarning, load_dataset
from mi_splat.datasets.packed import Packed
from mi_splat.errors import MiSplatError
from mi_splat.maths.rotation import normalise, to_matrix
from tests.datasets.sets import (
    CLOUD,
    FORMATS,
    PROBES,
    TESTS,
    VIEWS,
    assert_same_camera,
    colmap_binary,
    view,
    write_colmap,
    write_transforms,
)


@pytest.mark.parametrize(
    ("name", "tolerance"), [("transforms", 1e-9), ("colmap", 1e-6)]
)
def test_sets_come_back_as_they_were(
    name: str, tolerance: float, tmp_path: Path
) -> None:
    FORMATS[name](tmp_path / "set", VIEWS, test=TESTS, points=CLOUD)
    for split, wanted in (("train", VIEWS), ("test", TESTS)):
        dataset = load_dataset(tmp_path / "set", split=split)  # type: ignore[arg-type]
        assert len(dataset) == len(wanted)
        for ours, theirs in zip(dataset, wanted, strict=True):
            assert torch.equal(ours.image, theirs.image)
            assert_same_camera(ours.camera, theirs.camera, tolerance)
        assert dataset.points is not None
        assert torch.equal(dataset.points.colours, CLOUD.colours)
        torch.testing.assert_close(
            dataset.points.points, CLOUD.points, atol=1e-7, rtol=0
        )
        assert dataset.alpha(0) is None
    assert len(load_dataset(tmp_path / "set", split=None)) == len(VIEWS) + len(TESTS)


@hypothesis.settings(max_examples=20)
@hypothesis.given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(
        lambda q: math.hypot(*q) > 0.1
    ),
    position=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_any_pose_comes_back(
    quaternion: tuple[float, ...],
    position: tuple[float, ...],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = to_matrix(normalise(torch.tensor(quaternion, dtype=torch.float64)))
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    camera = Camera(to_world=pose, lens=Lens(focal=5.0, size=(2, 1)))
    folder = tmp_path_factory.mktemp("pose")
    for name, write in FORMATS.items():
        write(folder / name, [View(camera, torch.zeros(1, 2, 3))])
        (loaded,) = load_dataset(folder / name, split=None).cameras
        torch.testing.assert_close(
            loaded.to_world,
            camera.to_world,
            atol=1e-9 if name == "transforms" else 1e-6,
            rtol=0,
        )


def test_opengl_and_colmap_axes_by_hand(tmp_path: Path) -> None:
    camera = Camera(
        to_world=look_at((5, 0, 0), (0, 0, 0)), lens=Lens(focal=10.0, size=(4, 4))
    )
    single = [View(camera, torch.zeros(4, 4, 3))]
    write_transforms(tmp_path / "a", single)
    matrix = np.array(
        json.loads((tmp_path / "a" / "transforms_train.json").read_text())["frames"][0][
            "transform_matrix"
        ]
    )
    # right +y, up +z, back +x
    assert np.allclose(matrix, [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    write_colmap(tmp_path / "b", single)
    lines = (tmp_path / "b" / "sparse" / "0" / "images.txt").read_text().splitlines()
    words = [float(word) for word in lines[1].split()[1:8]]
    rotation = to_matrix(torch.tensor(words[:4], dtype=torch.float64))
    seen = rotation @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) + torch.tensor(
        words[4:], dtype=torch.float64
    )
    # world +y is at the right
    torch.testing.assert_close(seen, torch.tensor([1.0, 0.0, 5.0], dtype=torch.float64))


def test_a_set_of_blender(tmp_path: Path) -> None:
    # As the original NeRF scenes: an angle, no sizes, names without a suffix.
    (tmp_path / "train").mkdir()
    Image.new("RGBA", (20, 10), (255, 0, 0, 128)).save(tmp_path / "train" / "r_0.png")
    frame = {
        "file_path": "./train/r_0",
        "rotation": 0.01,
        "transform_matrix": np.eye(4).tolist(),
    }
    (tmp_path / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": math.pi / 2, "frames": [frame]})
    )
    black, white = (
        load_dataset(tmp_path, background=(level,) * 3) for level in (0.0, 1.0)
    )
    camera = black.cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(
        (10, 10, 10, 5)
    )
    assert torch.equal(
        camera.to_world, torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    )
    share = 128 / 255
    assert black[0].image[3, 3].tolist() == pytest.approx([share, 0, 0])
    assert white[0].image[3, 3].tolist() == pytest.approx([1, 1 - share, 1 - share])
    mask = black.alpha(0)
    assert mask is not None
    assert mask.shape == (10, 20)
    assert mask[0, 0] == pytest.approx(share)


def test_one_file_for_all_pictures_with_intrinsics_by_frame(tmp_path: Path) -> None:
    frames = []
    for i in range(9):
        Image.new("RGB", (8, 6)).save(tmp_path / f"{i}.jpg")
        own = {"fl_x": 7.5, "cx": 3.5} if i == 8 else {}
        frames.append(
            {"file_path": f"{i}.jpg", "transform_matrix": np.eye(4).tolist(), **own}
        )
    document = {
        "fl_x": 9.0,
        "fl_y": 8.0,
        "cx": 4.5,
        "cy": 2.5,
        "w": 8,
        "h": 6,
        "k1": 0.0,
        "frames": frames,
    }
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    whole = load_dataset(tmp_path / "transforms.json", split=None)
    assert [(c.fx, c.fy, c.cx, c.cy) for c in whole.cameras] == [
        (9.0, 8.0, 4.5, 2.5)
    ] * 8 + [(7.5, 8.0, 3.5, 2.5)]
    assert [path.stem for path in load_dataset(tmp_path, split="test").paths] == [
        "0",
        "8",
    ]
    assert [
        path.stem for path in load_dataset(tmp_path, split="test", test_every=4).paths
    ] == ["0", "4", "8"]
    assert len(load_dataset(tmp_path, split="train")) == 7
    document |= {"test_filenames": ["3.jpg"], "train_filenames": ["1.jpg", "2.jpg"]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert [path.stem for path in load_dataset(tmp_path, split="test").paths] == ["3"]
    assert [path.stem for path in load_dataset(tmp_path, split="train").paths] == [
        "1",
        "2",
    ]


def test_a_set_of_one_image_has_no_held_out_image(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:1])
    assert [
        len(load_dataset(tmp_path, split=split)) for split in ("train", "test")
    ] == [1, 0]
    (tmp_path / "transforms_train.json").rename(tmp_path / "transforms.json")
    assert [
        len(load_dataset(tmp_path, split=split)) for split in ("train", "test")
    ] == [1, 0]


def test_a_point_cloud_that_is_missing_is_warned_of(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS, points=CLOUD)
    (tmp_path / "points3D.ply").unlink()
    with pytest.warns(
        DatasetWarning, match=r"the point cloud points3D\.ply is missing"
    ):
        assert load_dataset(tmp_path).points is None


def test_of_several_models_the_first_is_read_with_a_warning(tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "sparse" / "1")
    with pytest.warns(
        DatasetWarning, match="has 2 models: .* to read another, pass its folder"
    ):
        load_dataset(tmp_path)
    assert len(load_dataset(tmp_path / "sparse" / "1", split=None)) == len(VIEWS)


def test_binary_models(tmp_path: Path) -> None:
    model = colmap_binary(tmp_path, VIEWS, CLOUD)
    dataset = load_dataset(tmp_path, split=None)
    assert (
        dataset.cameras[0].fx,
        dataset.cameras[0].fy,
        dataset.cameras[0].cx,
        dataset.cameras[0].cy,
    ) == (
        20,
        20,
        9,
        6.5,
    )
    for ours, theirs in zip(dataset[1:], VIEWS[1:], strict=True):
        assert torch.equal(ours.image, theirs.image)
        assert_same_camera(ours.camera, theirs.camera, 1e-9)
    assert dataset.points is not None
    assert torch.equal(dataset.points.points, CLOUD.points)
    assert torch.equal(dataset.points.colours, CLOUD.colours)
    assert [
        path.name for path in load_dataset(tmp_path, split="test", test_every=4).paths
    ] == [
        "view 0.png",
        "view 4.png",
    ]
    for root in (model, model.parent):  # images are found from the model's folder too
        assert len(load_dataset(root, split=None)) == len(VIEWS)
    (model / "points3D.bin").unlink()
    assert load_dataset(tmp_path).points is None


# The images of a set: modes, alpha, shrinking, and that they are read only when
# needed


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK"])
def test_pictures_of_any_8_bit_mode(mode: str, tmp_path: Path) -> None:
    suffix = ".tif" if mode == "CMYK" else ".png"
    write_transforms(tmp_path, [view(0, width=8, height=8)])
    (tmp_path / "images" / "train_00000.png").unlink()
    Image.new("RGB", (8, 8), (255, 255, 255)).convert(mode).save(
        tmp_path / "images" / f"train_00000{suffix}"
    )
    dataset = load_dataset(tmp_path)
    assert dataset[0].image.min() == 1.0
    assert (dataset.alpha(0) is not None) == (mode in ("LA", "RGBA"))


def test_alpha_is_written_and_blended(tmp_path: Path) -> None:
    alpha = torch.zeros(13, 18)
    alpha[:, :9] = 1.0
    write_transforms(
        tmp_path, VIEWS[:1], test=TESTS[:1], alphas=[alpha, torch.ones(13, 18)]
    )
    dataset = load_dataset(tmp_path, background=(1.0, 0.5, 0.25))
    assert torch.equal(dataset[0].image[:, :9], VIEWS[0].image[:, :9])
    assert dataset[0].image[4, 12].tolist() == [1.0, 0.5, 0.25]
    mask = dataset.alpha(0)
    assert mask is not None
    assert torch.equal(mask, alpha)
    assert torch.equal(load_dataset(tmp_path, split="test")[0].image, TESTS[0].image)


def test_shrinking_averages_and_scales_the_camera(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)  # 18 x 13: one row is left over at 3 and cut off
    small = load_dataset(tmp_path, downscale=3)
    camera = small.cameras[0]
    assert (camera.width, camera.height) == (6, 4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(
        (7.1, 19.7 / 3, 2.75, 7.75 / 3)
    )
    whole = VIEWS[0].image
    assert small[0].image[1, 2].tolist() == pytest.approx(
        whole[3:6, 6:9].mean((0, 1)).tolist()
    )
    there = project_points(PROBES, VIEWS[0].camera)[0]
    here = project_points(PROBES, camera)[0]
    torch.testing.assert_close(here * 3, there)


@pytest.mark.parametrize("name", FORMATS)
def test_pictures_that_are_missing_are_left_out(name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path, VIEWS, points=CLOUD)
    (tmp_path / "images" / "train_00002.png").unlink()
    for split, wanted in (
        ((None, "01345"), ("train", "14"), ("test", "05"))
        if name == "colmap"
        else ((None, "01345"),)
    ):
        with pytest.warns(
            DatasetWarning,
            match=r"1 of 6 images missing \(train_00002(\.png)?\); going on without",
        ):
            dataset = load_dataset(
                tmp_path,
                split=split,  # type: ignore[arg-type]
                test_every=4 if split == "test" else 2,
            )
        assert "".join(path.stem[-1] for path in dataset.paths) == wanted


def test_pictures_are_read_when_they_are_needed(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    dataset = load_dataset(tmp_path)
    (tmp_path / "images" / "train_00002.png").unlink()
    assert torch.equal(dataset[1].image, VIEWS[1].image)
    with pytest.raises(MiSplatError, match=r"train_00002\.png.*no such file"):
        dataset[2]
    shutil.rmtree(tmp_path / "images")
    assert torch.equal(dataset[1].image, VIEWS[1].image)  # from memory


def test_memory_is_bounded_and_counts_the_bytes_of_8_bit_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path, VIEWS)
    decoded: list[int] = []
    load = Dataset._load

    def counted(self: Dataset, index: int) -> Any:
        decoded.append(index)
        return load(self, index)

    monkeypatch.setattr(Dataset, "_load", counted)
    one = VIEWS[0].image.numel()  # bytes of an image, of which each value is a byte
    dataset = load_dataset(tmp_path, cache_bytes=2 * one)
    first = dataset[0].image
    assert torch.equal(dataset[0].image, first)
    assert len(decoded) == 1
    dataset[1], dataset[0]
    assert len(decoded) == 2  # two fit
    dataset[2], dataset[0]
    assert len(decoded) == 3  # the one read longest ago went
    assert torch.equal(dataset[1].image, VIEWS[1].image)
    assert len(decoded) == 4
    none = load_dataset(tmp_path, cache_bytes=0)
    none[0], none[1]
    assert len(none._cache) == 1


@hypothesis.given(
    seed=st.integers(0, 2**32 - 1), others=st.sampled_from((0, 1, 30, 2000))
)
def test_packed_images_are_equal_to_the_bit(seed: int, others: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (20, 30, 3), generator=generator).float() / 255
    where = torch.randint(0, image.numel(), (others,), generator=generator)
    image.view(-1)[where] = torch.rand(others, generator=generator)
    packed = Packed.of(image)
    assert torch.equal(packed.unpack(), image)
    assert torch.equal(packed.unpack(), image)  # what is kept does not change
    assert packed.bytes <= 4 * image.numel()
    if others <= 30:
        assert packed.bytes <= image.numel() + 8 * others
