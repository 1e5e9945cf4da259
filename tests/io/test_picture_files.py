"""Images of unknown origin: the number of pixels is limited before decoding, and
whatever is broken is said so.
"""

import io
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from attacks import cli
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.images import save_animation, save_picture
from mi_splat.io.picture_files import (
    FORMATS,
    MOST_PIXELS,
    PictureFileError,
    check_texture,
    load_picture,
    picture_header,
    picture_orientation,
    pixel_limit,
)
from mi_splat.render import variant
from tests.capture.trucks import truck, write_glb
from tests.project.layers import PACKAGES, ROOT

SQUARE = Image.linear_gradient("L").convert("RGB")


def png(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG that claims a size, and has hardly any pixels."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), *chunks]
    parts += [(b"IDAT", zlib.compress(bytes(100))), (b"IEND", b"")]
    told = (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(told)


def saved(kind: str, **options: object) -> bytes:
    """The square as a file."""
    buffer = io.BytesIO()
    SQUARE.save(buffer, kind, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "size",
    [(7072, 7072), (30_000, 30_000), (2**31 - 1, 2**31 - 1), (MOST_PIXELS + 1, 1)],
)
@pytest.mark.parametrize("action", ["error", "ignore"])
def test_too_many_pixels_are_refused_from_the_header(
    size: tuple[int, int], action: str, tmp_path: Path
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(*size))
    before = Image.MAX_IMAGE_PIXELS
    for read in (picture_header, load_picture):
        with warnings.catch_warnings():
            warnings.simplefilter(action)  # type: ignore[arg-type]
            with pytest.raises(
                PictureFileError,
                match=(
                    r"bomb\.png: expected at most 50,000,000 pixels, got"
                    rf" {size[0] * size[1]:,}"
                ),
            ):
                read(path)
    assert before == Image.MAX_IMAGE_PIXELS


@pytest.mark.parametrize("kind", FORMATS)
def test_a_raised_limit_is_above_pillow_s_own(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = saved(kind)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert load_picture(data, "square").size == (256, 256)
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_the_limit_can_be_raised_and_lowered(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png(20_000, 20_000))
    with pixel_limit(400_000_000):
        assert picture_header(path) == ((20_000, 20_000), "RGB")
    with pytest.raises(PictureFileError, match="at most"):
        picture_header(path)
    with (
        pixel_limit(256 * 256 - 1),
        pytest.raises(PictureFileError, match=r"at most 65,535 pixels, got 65,536"),
    ):
        load_picture(saved("PNG"), "square")
    with pytest.raises(InvalidValueError, match="max-pixels"), pixel_limit(0):
        pass


def many_scans(count: int) -> bytes:
    """A progressive JPEG whose last scan is repeated."""
    data = saved("JPEG", progressive=True)
    start = data.rindex(b"\xff\xc4", 0, data.rindex(b"\xff\xda"))
    return data[:-2] + data[start:-2] * count + data[-2:]


def test_a_jpeg_of_many_scans_is_not_decoded(tmp_path: Path) -> None:
    # a video after its end
    assert load_picture(many_scans(20) + b"\xff\xda" * 200, "square").size == (256, 256)
    (tmp_path / "scans.jpg").write_bytes(many_scans(200))
    mesh = write_glb(tmp_path, truck(), picture=many_scans(200))
    for read in (load_picture, check_texture):
        with pytest.raises(
            PictureFileError, match=r"scans\.jpg: expected a JPEG of at most 100 scans"
        ):
            read(tmp_path / "scans.jpg")
    with pytest.raises(MiSplatError, match=r"truck\.glb.* at most 100 scans"):
        load_mesh(mesh)


def test_a_jpeg_of_gigabytes_is_not_read_whole(tmp_path: Path) -> None:
    (tmp_path / "huge.jpg").write_bytes(many_scans(2))
    with (tmp_path / "huge.jpg").open("r+b") as file:
        file.truncate(1 << 36)  # sparse: it takes no disk
    with pytest.raises(
        PictureFileError,
        match=r"huge\.jpg: expected a JPEG of at most 268,435,456 bytes, got more",
    ):
        load_picture(tmp_path / "huge.jpg")


def text_that_expands(kind: str) -> bytes:
    """A PNG with a compressed text of megabytes."""
    text = zlib.compress(bytes(PngImagePlugin.MAX_TEXT_CHUNK + 1))
    return png(
        8,
        8,
        (kind.encode(), b"key\0" + (b"\1\0\0\0" if kind == "iTXt" else b"\0") + text),
    )


REFUSED = {
    **{
        f"half of a {kind}": (
            saved(kind)[: len(saved(kind)) // 2],
            "an image that can be read",
        )
        for kind in FORMATS
    },
    **{
        f"a {kind}": (saved(kind), "something else")
        for kind in ("GIF", "PPM", "EPS", "PDF", "TGA", "ICO")
    },
    **{
        f"an animated {kind}": (
            saved(kind, save_all=True, append_images=[SQUARE.rotate(90)]),
            "got an animation",
        )
        for kind in ("PNG", "WEBP")
    },
    **{
        f"{kind} that expands": (text_that_expands(kind), "too large")
        for kind in ("iTXt", "zTXt")
    },
    **{
        f"an image of phones, {brand}": (
            b"\0\0\0\x1cftyp" + brand.encode() + bytes(16),
            f"got {kind}; convert it",
        )
        for brand, kind in (("heic", "HEIC"), ("mif1", "HEIC"), ("avif", "AVIF"))
    },
    "a Git LFS pointer": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\n",
        "; run `git lfs pull`",
    ),
    "a TIFF with JPEG inside": (
        saved("TIFF", compression="jpeg"),
        "a TIFF without JPEG inside",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_picture_is_refused_whatever_its_name(
    name: str, tmp_path: Path
) -> None:
    data, words = REFUSED[name]
    (tmp_path / "square.png").write_bytes(data)
    with pytest.raises(PictureFileError, match=rf"square\.png: expected .*{words}"):
        load_picture(tmp_path / "square.png")


def test_commands_refuse_and_take_the_flag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bomb.png").write_bytes(png(30_000, 30_000))
    assert (
        cli.main(
            [
                "detect",
                "bomb.png",
                "--detectors",
                "fasterrcnn_small",
                "--out",
                "detected",
            ]
        )
        == 1
    )
    error = capsys.readouterr().err
    assert error.splitlines() == [
        "mi-splat: bomb.png: expected at most 50,000,000 pixels, got 900,000,000; make"
        " it smaller, or allow more (--max-pixels)"
    ]
    assert not Path("detected").exists()
    Path("a.png").write_bytes(saved("PNG"))
    for words in (
        ["--max-pixels", "100", "detect", "a.png"],
        ["detect", "a.png", "--max_pixels=100"],
    ):
        assert cli.main([*words, "--out", "detected"]) == 1
        assert "at most 100 pixels" in capsys.readouterr().err
    for words in (
        ["--max-pixels", "none"],
        ["--max-pixels"],
        ["--max-pixels=0"],
        ["--max-pixels", "9" * 5000],
    ):
        assert cli.main(["detect", "a.png", *words]) == 2
        assert (
            "detect: --max-pixels: expected a number of pixels"
            in capsys.readouterr().err
        )
    assert picture_header(Path("a.png"))[0] == (256, 256)


def test_no_picture_is_opened_elsewhere() -> None:
    # What draws.py reads back, it has written in memory a moment ago. The conformance
    # package needs NumPy alone, and has bounds of its own for JPEG and WebP.
    known = {
        "mi_splat/io/picture_files.py",
        "mi_splat/conformance/files.py",
        "attacks/transformations/draws.py",
    }
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    assert {
        str(file.relative_to(ROOT))
        for file in files
        if "Image.open(" in file.read_text()
    } == known
    assert issubclass(PictureFileError, MiSplatError)


# Images and animations are what their names say


def frames(count: int, height: int = 20, width: int = 33) -> list[NDArray[np.uint8]]:
    """Grey images that become brighter, with a red corner."""
    made = [
        np.full((height, width, 3), 20 + 40 * number, np.uint8)
        for number in range(count)
    ]
    for frame in made:
        frame[:8, :8] = (255, 0, 0)
    return made


@pytest.mark.parametrize(
    ("name", "kind"), [("a.png", "PNG"), ("a.jpg", "JPEG"), ("a.JPEG", "JPEG")]
)
def test_a_picture_has_the_format_of_its_name(
    name: str, kind: str, tmp_path: Path
) -> None:
    (frame,) = frames(1)
    save_picture(frame, tmp_path / name)
    with Image.open(tmp_path / name) as picture:
        assert picture.format == kind
        assert np.abs(np.asarray(picture).astype(int) - frame)[10:].max() <= 3


@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_a_gif_and_a_webp_show_every_frame(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    save_animation(frames(3), path, fps=10)
    with Image.open(path) as picture:
        assert (picture.format, getattr(picture, "n_frames", 1)) == (kind.upper(), 3)
        for number in range(3):
            picture.seek(number)
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            assert abs(pixels[15, 20, 0] - (20 + 40 * number)) <= 4
            assert np.abs(pixels[2, 2] - [255, 0, 0]).max() <= 4
            assert picture.info["duration"] == 100


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (
            lambda folder: save_picture(frames(1)[0], folder / "a.webp"),
            r"\.png or \.jpg",
        ),
        (
            lambda folder: save_animation([], folder / "a.gif", fps=10),
            "one size, got none",
        ),
        (
            lambda folder: save_animation(
                [*frames(1), *frames(1, 10)], folder / "a.gif", fps=10
            ),
            "got 2 sizes",
        ),
        (lambda folder: save_animation(frames(2), folder / "a.gif", fps=0), "fps"),
        (
            lambda folder: save_animation(frames(2), folder / "a.avi", fps=10),
            r"\.gif or \.webp",
        ),
        (
            lambda folder: save_animation(frames(2), folder / "gone" / "a.gif", fps=10),
            "check the path",
        ),
    ],
)
def test_what_is_not_written(
    write: Callable[[Path], None], says: str, tmp_path: Path
) -> None:
    with pytest.raises(MiSplatError, match=says):
        write(tmp_path)
    assert not list(tmp_path.iterdir())


# Images that Mitsuba decodes: their number of pixels is read from their headers

variant.use()
WINDOW = b"dataWindow\0box2i\0" + struct.pack("<I", 16)


@pytest.mark.parametrize(
    "ending", ["exr", "hdr", "pfm", "ppm", "tga", "png", "jpg", "bmp"]
)
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
        pytest.raises(
            PictureFileError,
            match=rf"a\.{ending}: expected at most 1,199 pixels, got 1,200",
        ),
    ):
        check_texture(path)


def exr(tmp_path: Path, channels: int = 3) -> bytes:
    """An OpenEXR image of 40 x 30 pixels."""
    path = tmp_path / "a.exr"
    mi.Bitmap(np.zeros((30, 40, channels), np.float32)).write(str(path))
    return path.read_bytes()


@pytest.mark.parametrize(
    "corners",
    [
        (0, 0, 99_999, 99_999),
        (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
        (0, 0, -1, -1),
        (5, 5, 4, 9),
    ],
)
def test_strange_windows_are_refused(
    corners: tuple[int, int, int, int], tmp_path: Path
) -> None:
    data = exr(tmp_path)
    offset = data.index(WINDOW) + len(WINDOW)
    (tmp_path / "b.exr").write_bytes(
        data[:offset] + struct.pack("<4i", *corners) + data[offset + 16 :]
    )
    with pytest.raises(
        PictureFileError,
        match=r"offset: expected (at most 50,000,000|an image with) pixels",
    ):
        check_texture(tmp_path / "b.exr", "offset")


def test_many_channels_count_as_pictures(tmp_path: Path) -> None:
    exr(tmp_path, channels=9)
    with pixel_limit(3599), pytest.raises(PictureFileError, match="got 3,600"):
        check_texture(tmp_path / "a.exr")


def test_headers_that_are_cut_off_are_refused(tmp_path: Path) -> None:
    data = exr(tmp_path)
    path = tmp_path / "b.exr"
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
    with (
        pixel_limit(1199),
        pytest.raises(
            PictureFileError, match="expected at most 1,199 pixels, got 1,200"
        ),
    ):
        check_texture(path)


def test_a_webp_may_have_half_as_many_pixels(tmp_path: Path) -> None:
    Image.new("RGB", (200, 100)).save(tmp_path / "a.webp", lossless=True)
    with pixel_limit(40_000):
        assert load_picture(tmp_path / "a.webp").size == (200, 100)
    with (
        pixel_limit(39_000),
        pytest.raises(PictureFileError, match="at most 19,500 pixels, got 20,000"),
    ):
        load_picture(tmp_path / "a.webp")


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@pytest.mark.parametrize(
    "tags", [b"", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\0\x01\x01\x12", bytes(40)]
)
def test_broken_exif_is_ignored(tags: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.jpg"
    Image.new("RGB", (4, 2)).save(file, exif=b"Exif\0\0" + tags)
    assert picture_orientation(file) == 1
    assert load_picture(file, upright=True).size == (4, 2)
