"""Pictures that Mitsuba decodes: their number of pixels is read from their headers."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_splat import variant
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import PictureFileError, pixel_limit
from mi_splat.io.texture_files import check_texture

variant.use()

import mitsuba as mi  # noqa: E402

WINDOW = b"dataWindow\0box2i\0" + struct.pack("<I", 16)


@pytest.mark.parametrize("ending", ["exr", "hdr", "pfm", "ppm", "tga", "png", "jpg", "bmp"])
def test_pixels_of_what_mitsuba_writes_are_counted(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{ending}"
    floats = ending in ("exr", "hdr", "pfm")
    pixels = np.zeros((30, 40, 3), np.float32 if floats else np.uint8)
    if ending in ("tga", "bmp"):
        Image.fromarray(pixels).save(path)
    else:
        mi.Bitmap(pixels).write(str(path))
    with pixel_limit(1200):
        check_texture(path)
    with (
        pixel_limit(1199),
        pytest.raises(PictureFileError, match=rf"a\.{ending}: expected at most 1,199 pixels, got 1,200"),
    ):
        check_texture(path)


def exr(tmp_path: Path, channels: int = 3) -> bytes:
    """An OpenEXR picture of 40 x 30 pixels."""
    path = tmp_path / "a.exr"
    mi.Bitmap(np.zeros((30, 40, channels), np.float32)).write(str(path))
    return path.read_bytes()


@pytest.mark.parametrize(
    "corners", [(0, 0, 99_999, 99_999), (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), (0, 0, -1, -1), (5, 5, 4, 9)]
)
def test_strange_windows_are_refused(corners: tuple[int, int, int, int], tmp_path: Path) -> None:
    data = exr(tmp_path)
    offset = data.index(WINDOW) + len(WINDOW)
    (tmp_path / "b.exr").write_bytes(data[:offset] + struct.pack("<4i", *corners) + data[offset + 16 :])
    with pytest.raises(PictureFileError, match=r"offset: expected (at most 50,000,000|a picture with) pixels"):
        check_texture(tmp_path / "b.exr", "offset")


def test_many_channels_count_as_pictures(tmp_path: Path) -> None:
    exr(tmp_path, channels=9)
    with pixel_limit(3599), pytest.raises(PictureFileError, match="got 3,600"):
        check_texture(tmp_path / "a.exr")


def test_headers_that_are_cut_off_are_refused(tmp_path: Path) -> None:
    data, path = exr(tmp_path), tmp_path / "b.exr"
    end = data.index(WINDOW) + len(WINDOW) + 16
    for size in range(0, end, 7):
        path.write_bytes(data[:size])
        with pytest.raises(PictureFileError, match=r"b\.exr"):
            check_texture(path)
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n")
    with pytest.raises(PictureFileError, match="Radiance HDR"):
        check_texture(path)
    with pytest.raises(MiSplatError, match="No such file"):
        check_texture(tmp_path / "none.exr")


def test_the_first_size_of_a_radiance_picture_counts(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    mi.Bitmap(np.zeros((30, 40, 3), np.float32)).write(str(path))
    data = path.read_bytes()
    line = b"-Y 30 +X 40\n"
    assert line in data
    path.write_bytes(data.replace(line, line + b"\n-Y 1 +X 1\n"))
    with pixel_limit(1199), pytest.raises(PictureFileError, match="expected at most 1,199 pixels, got 1,200"):
        check_texture(path)
