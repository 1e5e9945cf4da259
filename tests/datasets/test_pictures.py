"""The pictures of a set: modes, alpha, masks, shrinking, and that they are read only when needed."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mi_splat.cameras import project_points
from mi_splat.datasets import DatasetError, DatasetWarning, load_dataset, write_transforms
from tests.datasets.sets import CLOUD, FORMATS, PROBES, TESTS, VIEWS, view


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK"])
def test_pictures_of_any_8_bit_mode(mode: str, tmp_path: Path) -> None:
    suffix = ".tif" if mode == "CMYK" else ".png"
    write_transforms(tmp_path, [view(0, width=8, height=8)])
    (tmp_path / "images" / "train_00000.png").unlink()
    Image.new("RGB", (8, 8), (255, 255, 255)).convert(mode).save(tmp_path / "images" / f"train_00000{suffix}")
    found = load_dataset(tmp_path)
    assert found[0].image.min() == 1.0
    assert (found.mask(0) is not None) == (mode in ("LA", "RGBA"))


def test_palettes_with_transparency(tmp_path: Path) -> None:
    write_transforms(tmp_path, [view(0, width=2, height=1)])
    picture = Image.new("P", (2, 1), 0)
    picture.putpalette([0, 255, 0, 255, 0, 0])
    picture.putpixel((1, 0), 1)
    picture.save(tmp_path / "images" / "train_00000.png", transparency=0)
    found = load_dataset(tmp_path, background=(0.0, 0.0, 1.0))[0].image
    assert found.tolist() == [[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]]


def test_alpha_is_written_and_blended(tmp_path: Path) -> None:
    alpha = torch.zeros(13, 18)
    alpha[:, :9] = 1.0
    write_transforms(tmp_path, VIEWS[:1], test=TESTS[:1], alphas=[alpha, torch.ones(13, 18)])
    found = load_dataset(tmp_path, background=(1.0, 0.5, 0.25))
    assert torch.equal(found[0].image[:, :9], VIEWS[0].image[:, :9])
    assert found[0].image[4, 12].tolist() == [1.0, 0.5, 0.25]
    mask = found.mask(0)
    assert mask is not None
    assert torch.equal(mask, alpha)
    assert torch.equal(load_dataset(tmp_path, split="test")[0].image, TESTS[0].image)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("mask", ["train_00001.png", "train_00001.png.png"])
def test_masks_in_their_folder(name: str, mask: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path, VIEWS[:3])
    values = np.zeros((13, 18), np.uint8)
    values[:6] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(values).save(tmp_path / "masks" / mask)
    found = load_dataset(tmp_path, split=None)
    assert found.mask(0) is None
    second = found.mask(1)
    assert second is not None
    assert torch.equal(second, torch.from_numpy(values).float() / 255)
    assert torch.equal(found[1].image, VIEWS[1].image)


def test_shrinking_averages_and_scales_the_camera(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)  # 18 x 13: one row is left over at 3 and cut off
    small = load_dataset(tmp_path, downscale=3)
    camera = small.cameras[0]
    assert (camera.width, camera.height) == (6, 4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((7.1, 19.7 / 3, 2.75, 7.75 / 3))
    whole = VIEWS[0].image
    assert small[0].image[1, 2].tolist() == pytest.approx(whole[3:6, 6:9].mean((0, 1)).tolist())
    there, here = project_points(PROBES, VIEWS[0].camera)[0], project_points(PROBES, camera)[0]
    torch.testing.assert_close(here * 3, there)


@pytest.mark.parametrize("name", FORMATS)
def test_pictures_that_are_missing_are_left_out(name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path, VIEWS, points=CLOUD)
    (tmp_path / "images" / "train_00002.png").unlink()
    for split, wanted in ((None, "01345"), ("train", "14"), ("test", "05")) if name == "colmap" else ((None, "01345"),):
        with pytest.warns(DatasetWarning, match=r"1 of 6 pictures missing \(train_00002(\.png)?\); going on without"):
            found = load_dataset(tmp_path, split=split, test_every=4 if split == "test" else 2)  # type: ignore[arg-type]
        assert "".join(path.stem[-1] for path in found.paths) == wanted


def test_a_picture_is_as_its_camera_saw_it(tmp_path: Path) -> None:
    # A telephone held upright writes rows of 18 pixels and says that they are columns.
    write_transforms(tmp_path, [view(0), view(1, width=13, height=18)])
    pixels = (VIEWS[0].image.numpy() * 255 + 0.5).astype(np.uint8)
    exif = Image.Exif()
    exif[274] = 6
    for number in range(2):
        Image.fromarray(pixels).save(tmp_path / "images" / f"train_0000{number}.png", exif=exif)
    found = load_dataset(tmp_path)
    assert torch.equal(found[0].image, VIEWS[0].image)
    assert torch.equal(found[1].image, torch.rot90(VIEWS[0].image, -1))
    Image.fromarray(pixels).save(tmp_path / "images" / "train_00001.png")
    with pytest.raises(DatasetError, match="expected 13 x 18 pixels, got 18 x 13"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("name", FORMATS)
def test_smaller_pictures_of_the_set_are_used(name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path, VIEWS[:2])
    small = tmp_path / "images_2"
    small.mkdir()
    for number in range(2):
        Image.new("RGB", (9, 7), (255, 0, 0)).save(small / f"train_0000{number}.png")  # 6.5 rows, rounded
    shutil.move(tmp_path / "images", tmp_path / "elsewhere")
    two = load_dataset(tmp_path, split=None, downscale=2)
    camera = two.cameras[0]
    assert two[0].image.shape == (7, 9, 3)
    assert two[0].image[0, 0].tolist() == [1, 0, 0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((10.65, 19.7 * 7 / 13, 4.125, 7.75 * 7 / 13))
    with pytest.raises(DatasetError, match="2 of 2 pictures missing"):
        load_dataset(tmp_path, split=None)
    Image.new("RGB", (9, 5)).save(small / "train_00001.png")
    with pytest.raises(DatasetError, match=r"images_2.*expected 9 x 6\.5 pixels, rounded, got 9 x 5"):
        load_dataset(tmp_path, split=None, downscale=2)


def test_pictures_are_read_when_they_are_needed(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    found = load_dataset(tmp_path)
    (tmp_path / "images" / "train_00002.png").unlink()
    assert torch.equal(found[1].image, VIEWS[1].image)
    with pytest.raises(DatasetError, match=r"train_00002\.png.*no such file"):
        found[2]
    shutil.rmtree(tmp_path / "images")
    assert torch.equal(found[1].image, VIEWS[1].image)  # from memory


def test_memory_is_bounded(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    one = 4 * VIEWS[0].image.numel()
    found = load_dataset(tmp_path, cache_bytes=2 * one)
    first = found[0]
    assert found[0] is first
    found[1], found[2]
    assert found[0] is not first
    none = load_dataset(tmp_path, cache_bytes=0)
    none[0], none[1]
    assert len(none._cache) == 1


def test_a_set_is_a_sequence(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    found = load_dataset(tmp_path)
    assert torch.equal(found[-1].image, VIEWS[-1].image)
    assert [path.name for path in found[1:3].paths] == ["train_00001.png", "train_00002.png"]
    assert len(list(reversed(found))) == len(VIEWS)
    with pytest.raises(IndexError):
        found[len(VIEWS)]
