"""The sharpest pictures of a video, decoded by the ffmpeg that imageio-ffmpeg brings."""

import math
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_splat.errors import install
from mi_splat.io.picture_files import MOST_PIXELS
from mi_splat.preparation.config import VIDEOS, PreparationError

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
    """The program."""
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
