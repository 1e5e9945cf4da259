"""Pictures and animations are what their names say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mi_splat.errors import InvalidValueError
from mi_splat.io import SplatFileError
from mi_splat.io.pictures import VideoError, check_animation, save_animation, save_picture


def frames(count: int, height: int = 20, width: int = 33) -> list[NDArray[np.uint8]]:
    """Grey pictures that become brighter, with a red corner."""
    made = [np.full((height, width, 3), 20 + 40 * number, np.uint8) for number in range(count)]
    for frame in made:
        frame[:8, :8] = (255, 0, 0)
    return made


@pytest.mark.parametrize(("name", "kind"), [("a.png", "PNG"), ("a.jpg", "JPEG"), ("a.JPEG", "JPEG")])
def test_a_picture_has_the_format_of_its_name(name: str, kind: str, tmp_path: Path) -> None:
    (frame,) = frames(1)
    save_picture(frame, tmp_path / name)
    with Image.open(tmp_path / name) as picture:
        assert picture.format == kind
        assert np.abs(np.asarray(picture).astype(int) - frame)[10:].max() <= 3


@pytest.mark.parametrize("name", ["a.webp", "a", "a.mp4"])
def test_other_endings_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"\.png or \.jpg"):
        save_picture(frames(1)[0], tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_gif_shows_every_frame(tmp_path: Path) -> None:
    save_animation(frames(3), tmp_path / "a.gif", fps=10)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.format, getattr(picture, "n_frames", 1)) == ("GIF", 3)
        assert picture.info["duration"] == 100
        for number in range(3):
            picture.seek(number)
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            assert abs(pixels[15, 20, 0] - (20 + 40 * number)) <= 4
            assert pixels[2, 2].tolist() == [255, 0, 0]


def test_a_video_shows_every_frame(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    save_animation(frames(5), tmp_path / "a.mp4", fps=12)
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "a.mp4"), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert b"h264" in done.stderr
    assert b"12 fps" in done.stderr
    pictures = np.frombuffer(done.stdout, np.uint8).reshape(-1, 20, 34, 3).astype(int)  # an even width
    assert np.abs(pictures[:, 15, 20, 1] - (20 + 40 * np.arange(5))).max() <= 6


def test_without_the_package_a_video_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "imageio_ffmpeg", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(VideoError, match=r"pip install -e '\.\[video\]' .*, or end the name in \.gif"):
        check_animation(tmp_path / "a.mp4")
    check_animation(tmp_path / "a.gif")


@pytest.mark.parametrize(
    ("pictures", "name", "fps", "says"),
    [
        ([], "a.gif", 10.0, "one size, got none"),
        ([*frames(1), *frames(1, 10)], "a.gif", 10.0, "got 2 sizes"),
        (frames(2), "a.gif", 0.0, "fps"),
        (frames(2), "a.avi", 10.0, r"\.gif or \.mp4"),
    ],
)
def test_what_makes_no_animation_is_refused(
    pictures: list[NDArray[np.uint8]], name: str, fps: float, says: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidValueError, match=says):
        save_animation(pictures, tmp_path / name, fps=fps)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match="check the path"):
        save_animation(frames(2), tmp_path / "gone" / "a.gif", fps=10)
