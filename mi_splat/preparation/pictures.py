"""The pictures of a set that is being prepared: upright, of bounded size, under names that every tool takes."""

import math
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.datasets.frames import SUFFIXES, DatasetError, picture_size
from mi_splat.errors import install
from mi_splat.io.documents import file_name
from mi_splat.io.images import save_picture
from mi_splat.io.picture_files import MOST_PIXELS, PictureFileError, focal_length_35mm, load_picture
from mi_splat.preparation.config import VIDEOS, PreparationError, PrepareConfig

MOST_SECONDS = 1800.0
"""Of the longest video that is read."""
CANDIDATES = 10
"""Pictures a second from which the sharpest is chosen."""

_SAFE = ("-nostdin", "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi")
"""Only files, and only of these kinds, by ffmpeg's names of them: playlists and the like lead to other files."""
_LENGTH = re.compile(rb"^  Duration: (\d{2,5}):(\d\d):(\d\d\.\d\d)", re.MULTILINE)
"""As ffmpeg itself writes it; titles and comments of the file stand before it, and further in."""

Pixels = NDArray[np.uint8]


def check_video(path: Path) -> None:
    """Raise, before any work is done, if a video cannot be read here."""
    if path.suffix.lower() not in VIDEOS:
        expected, do = f"a folder of pictures, or a video ({', '.join(VIDEOS)})", "pass one of these"
        raise PreparationError.of(str(path), expected, path.suffix or "a file without an ending", do)
    if find_spec("imageio_ffmpeg") is None:
        raise PreparationError.of(str(path), "imageio-ffmpeg, which reads videos", "no such package", install("video"))


def sharpness(pixels: Pixels) -> float:
    """Variance of the Laplacian of the grey values, which blur makes small (Pech-Pacheco et al., ICPR 2000)."""
    grey = pixels.mean(-1, dtype=np.float32)
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * grey[1:-1, 1:-1]
    return float(laplacian.var())


def sharpest_frames(
    path: Path, *, longest_side: int, interval: float, most: int, on_second: Callable[[int, int], None]
) -> Iterator[tuple[float, Pixels]]:
    """The sharpest picture of each interval of a video, upright, and its time."""
    length = _length(path)
    if length > MOST_SECONDS:
        raise _too_long(path, length)
    interval = max(interval, math.nextafter(length / most, math.inf))
    best: tuple[float, float, Pixels] | None = None
    part = count = 0
    for number, pixels in enumerate(_decoded(path, longest_side)):
        second = number / CANDIDATES
        if second > MOST_SECONDS + 1:  # whatever it says: one picture far from the last is many, all the same
            raise _too_long(path, second)
        if number % CANDIDATES == 0:
            on_second(int(second), math.ceil(length))
        if best is not None and int(second / interval) > part:
            yield best[1:]
            best, count = None, count + 1
        if count == most:
            if second > length + 1:
                do = "write it again with ffmpeg -c copy, or pass a longer interval"
                raise PreparationError.of(str(path), f"{length:.1f} seconds, as it says", "more", do)
            return
        part = int(second / interval)
        if pixels is not None and (best is None or sharpness(pixels) > best[0]):
            best = (sharpness(pixels), second, pixels)
    if best is not None:
        yield best[1:]


def _too_long(path: Path, seconds: float) -> PreparationError:
    expected, do = f"a video of at most {MOST_SECONDS:.0f} seconds", "cut it, for instance with ffmpeg -t 600"
    return PreparationError.of(str(path), expected, f"{seconds:.0f}", do)


def _ffmpeg() -> str:
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())


def _length(path: Path) -> float:
    """Seconds, as the file says; 0 if it does not."""
    done = subprocess.run([_ffmpeg(), *_SAFE, "-i", str(path.absolute())], capture_output=True)
    match = _LENGTH.search(done.stderr)
    return 0.0 if match is None else int(match[1]) * 3600 + int(match[2]) * 60 + float(match[3])


def _decoded(path: Path, longest_side: int) -> Iterator[Pixels | None]:
    """`CANDIDATES` pictures a second of a video; None where one is the same as that before it.

    ffmpeg writes each as PPM, which says how large it is.
    """
    fit = f"scale=w='min({longest_side},iw)':h='min({longest_side},ih)':force_original_aspect_ratio=decrease"
    command = [_ffmpeg(), "-loglevel", "error", *_SAFE, "-max_pixels", str(MOST_PIXELS), "-i", str(path.absolute())]
    command += ["-map", "0:V:0", "-vf", f"fps={CANDIDATES},{fit}", "-f", "image2pipe", "-c:v", "ppm", "-"]
    last = b""
    with tempfile.TemporaryFile() as errors:
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors) as process:
            assert process.stdout is not None
            try:
                while process.stdout.readline() == b"P6\n":
                    width, height = map(int, process.stdout.readline().split())
                    process.stdout.readline()
                    data = process.stdout.read(3 * width * height)
                    if len(data) < 3 * width * height:
                        break
                    yield None if data == last else np.frombuffer(data, np.uint8).reshape(height, width, 3)
                    last = data
            finally:
                process.kill()
        if not last:
            errors.seek(0)
            lines = errors.read(1 << 16).decode(errors="replace").split("\n")
            got = next((line.strip()[:160] for line in lines if line.strip()), "nothing that it could read")
            raise PreparationError.of(str(path), "a video that ffmpeg can read", got, "save it as MP4")


OnProgress = Callable[[str, int, int], None]
"""Called with what is going on, how much of it is done, and of how much."""

FEWEST_PICTURES = 3
"""Of which cameras can be found."""
_KINDS = frozenset(suffix.lower() for suffix in SUFFIXES)
_OF_PHONES = (".heic", ".heif", ".avif")
_FULL_FRAME = math.hypot(36.0, 24.0)
"""Millimetres: the diagonal that a focal length "in 35 mm" belongs to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A picture of the set."""

    name: str  # of its file in images/
    source: str  # its file, or when it is in a video
    size: tuple[int, int]  # width and height, pixels
    focal: float | None = None  # focal length in pixels, as the camera has written it; None if it has not


def pictures_in(folder: Path, most: int) -> list[Path]:
    """The pictures of a folder in the order of their names; those of phones that cannot be read are among them."""
    kinds = _KINDS.union(_OF_PHONES)
    pictures = sorted(path for path in folder.iterdir() if path.suffix.lower() in kinds and path.is_file())
    if len(pictures) > most:
        do = "leave some out, or allow more"
        error = PreparationError.of(str(folder), f"at most {most} pictures", len(pictures), do)
        raise error.hinted("--max-pictures")
    if len(pictures) < FEWEST_PICTURES:
        expected = f"at least {FEWEST_PICTURES} pictures ({', '.join(sorted(_KINDS))})"
        do = "20 to 200 that overlap by two thirds are usual"
        raise PreparationError.of(str(folder), expected, len(pictures) or "none", do)
    return pictures


def take_photographs(
    folder: Path, images: Path, config: PrepareConfig, on_progress: OnProgress
) -> tuple[list[Picture], dict[str, str]]:
    """Write the pictures of a folder into images/, turned as EXIF says and without what else it says."""
    paths = pictures_in(folder, config.max_pictures)
    taken: list[Picture] = []
    broken: dict[str, str] = {}
    for number, path in enumerate(paths):
        on_progress("reading pictures", number, len(paths))
        try:
            picture_size(path)
            photograph = load_picture(path, upright=True)
        except (PictureFileError, DatasetError) as error:
            broken[path.name] = str(error)
            continue
        focal = focal_length_35mm(photograph)
        pixels = _opaque(photograph)
        pixels.thumbnail((config.longest_side, config.longest_side), Image.Resampling.LANCZOS, reducing_gap=3.0)
        ending = ".jpg" if path.suffix.lower() in (".jpg", ".jpeg") else ".png"
        name = _free_name(file_name(path.stem), ending, {picture.name for picture in taken})
        save_picture(np.asarray(pixels), images / name)
        scale = math.hypot(*pixels.size) / _FULL_FRAME
        taken.append(
            Picture(name=name, source=path.name, size=pixels.size, focal=None if focal is None else focal * scale)
        )
    if len(taken) < FEWEST_PICTURES and broken:
        name, reason = next(iter(broken.items()))
        raise PreparationError(f"{len(broken)} of {len(paths)} pictures cannot be read, {name} for instance: {reason}")
    return taken, broken


def take_frames(video: Path, images: Path, config: PrepareConfig, on_progress: OnProgress) -> list[Picture]:
    """Write the sharpest pictures of a video into images/."""
    taken: list[Picture] = []
    frames = sharpest_frames(
        video,
        longest_side=config.longest_side,
        interval=config.interval,
        most=config.max_pictures,
        on_second=lambda done, total: on_progress("reading the video", done, total),
    )
    for second, pixels in frames:
        name = f"frame_{len(taken):05d}.jpg"
        save_picture(pixels, images / name)
        taken.append(Picture(name=name, source=f"{second:.1f} s", size=(pixels.shape[1], pixels.shape[0])))
    if len(taken) < FEWEST_PICTURES:
        expected, got = (
            f"a video of at least {FEWEST_PICTURES} intervals",
            f"{len(taken)} of {config.interval:g} seconds",
        )
        error = PreparationError.of(str(video), expected, got, "pass a longer one, or a shorter interval")
        raise error.hinted("--interval")
    return taken


def _opaque(picture: Image.Image) -> Image.Image:
    """A picture in sRGB colours; over black where it is transparent."""
    if "A" not in picture.mode and "a" not in picture.mode and "transparency" not in picture.info:
        return picture.convert("RGB")
    layers = Image.new("RGBA", picture.size, "black"), picture.convert("RGBA")
    return Image.alpha_composite(*layers).convert("RGB")


def _free_name(stem: str, ending: str, taken: set[str]) -> str:
    """A name that no other picture has, on disks, too, that take small and capital letters for the same."""
    small, number, name = {other.lower() for other in taken}, 2, f"{stem}{ending}"
    while name.lower() in small:
        name, number = f"{stem}-{number}{ending}", number + 1
    return name
