"""Commands for what is on the page: the one that makes its picture again, and the words for its camera."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import torch

from mi_splat.directions import UP, Point
from mi_splat.io.camera_records import OF
from mi_splat.rendering import RenderSettings
from mi_splat.rotation import from_z
from mi_splat.viewer.orbit import Orbit


def render_command(
    path: Path,
    orbit: Orbit,
    size: tuple[int, int],
    *,
    middle: Point | None,
    settings: RenderSettings,
    file_settings: RenderSettings,
    up: Point = UP,
) -> str:
    """The `mi-splat render` that makes a picture, to the bit where up is z or the camera is one of a file."""
    camera = camera_words(
        orbit, size, settings=settings, background=file_settings.background, centre=middle, up=up, path=path
    )
    return shlex.join(["mi-splat", "render", str(path), *camera])


def camera_words(
    orbit: Orbit,
    size: tuple[int, int],
    *,
    settings: RenderSettings,
    background: Point | None = None,
    centre: Point | None = None,
    up: Point = UP,
    path: Path | None = None,
) -> list[str]:
    """The flags by which a command looks from a camera."""
    if orbit.exact is not None and orbit.source:
        command = ["--cameras", orbit.source.removeprefix(f"{path}{OF}")]
    else:
        command = _orbit_words(orbit, centre, up)
    command += ["--size", f"{size[0]}x{size[1]}"]
    if settings.background != background:
        command += _option("background", *settings.background)
    command += _option("near", settings.near)  # of a bare splat it follows the camera, unless it is given
    return command


def _orbit_words(orbit: Orbit, centre: Point | None, up: Point) -> list[str]:
    """The numbers of a camera."""
    words = [*_option("azimuth", orbit.azimuth), *_option("elevation", orbit.elevation)]
    words += [*_option("distance", orbit.distance), *_option("fov", orbit.fov)]
    if orbit.roll:
        words += _option("camera-roll", orbit.roll)
    if tuple(up) != UP:
        words += up_words(up)
        turn = from_z(torch.tensor(list(up)))
        words += _option("centre", *(turn @ torch.tensor(list(orbit.target), dtype=torch.float64)).tolist())
    elif centre is None or tuple(orbit.target) != tuple(centre):
        words += _option("centre", *orbit.target)
    return words


def up_words(up: Point) -> list[str]:
    """The flag by which a command knows what is up; none where that is z."""
    return [] if tuple(up) == UP else [*_option("up", *up)]


def _option(name: str, *values: float) -> Sequence[str]:
    """An option and its numbers, which read back as what they were."""
    return [f"--{name}", *(repr(value).removesuffix(".0") for value in values)]
