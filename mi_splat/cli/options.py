"""Options that several commands share: sizes, colours and directions, and where a scene
is looked at from.

Light, so that --help is fast. A size, a colour and a direction is one word, so that a
file may follow it.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mi_splat.cli.console import UsageError
from mi_splat.errors import nearest
from mi_splat.fields import Converter, Length, Metavar, OutFolder, Range, between

if TYPE_CHECKING:
    from mi_splat.io.up_axis import UpAxis

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_AXES = {
    f"{sign}{'xyz'[axis]}": tuple(
        (-1.0 if sign == "-" else 1.0) if axis == column else 0.0 for column in range(3)
    )
    for sign in ("", "+", "-")
    for axis in range(3)
}


def _size(word: str) -> tuple[int, int]:
    parts = word.lower().split("x")
    if len(parts) > 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"expected pixels as 256 or 256x192, got {word!r}")
    return int(parts[0]), int(parts[-1])


def _three(word: str) -> tuple[float, float, float] | None:
    """Three numbers between commas; None if it is something else."""
    parts = word.split(",")
    if len(parts) != 3 or not all(_NUMBER.fullmatch(part.strip()) for part in parts):
        return None
    return float(parts[0]), float(parts[1]), float(parts[2])


def _colour(word: str) -> tuple[float, float, float]:
    """An sRGB colour, by its name, as CSS writes it, or as three numbers."""
    numbers = _three(word)
    if numbers is not None:
        return numbers
    from PIL import ImageColor  # only where it is needed

    try:
        red, green, blue, *rest = ImageColor.getrgb(word)
        if rest:
            raise ValueError(f"{word} is transparent")
    except ValueError:
        do = nearest(
            word,
            ImageColor.colormap,
            "write for instance white, #80b0e0 or 0.5,0.7,0.9",
        )
        raise ValueError(f"expected a colour, got {word!r}; {do}") from None
    return red / 255, green / 255, blue / 255


def _direction(word: str) -> tuple[float, float, float]:
    direction = _AXES.get(word, _three(word))
    if direction is None:
        raise ValueError(
            f"expected an axis such as y or -y, or three numbers, got {word!r}"
        )
    return direction[0], direction[1], direction[2]


def check_no_input_in(folder: Path, *inputs: Path | None) -> None:
    """Raise if replacing an older result would delete what is to be read."""
    for path in inputs:
        if (
            path is not None
            and path.exists()
            and path.resolve().is_relative_to(folder.resolve())
        ):
            raise UsageError.of(
                "--out",
                f"a folder without the input {path}",
                folder,
                "pass another folder",
            )


def axis_name(direction: Sequence[float]) -> str:
    """A direction as --up takes it: its axis, or three numbers."""
    return next(
        (name for name, axis in _AXES.items() if axis == tuple(direction)),
        _written(direction),
    )


def up_line(up: "UpAxis") -> str:
    """What a command says of the direction that it takes for up: which, why, and how to
    turn it.
    """
    x, y, z = up.direction
    if up.direction == (0.0, 0.0, 1.0):
        other = (0.0, -1.0, 0.0)
    else:
        other = (-x + 0.0, -y + 0.0, -z + 0.0)
    return (
        f"up is taken as {axis_name(up.direction)} ({up.reason}); --up"
        f" {axis_name(other)} turns it"
    )


def _written(value: Sequence[float]) -> str:
    return ",".join(f"{number:g}" for number in value)


Size = Annotated[
    tuple[int, int],
    Converter(_size, lambda size: f"{size[0]}x{size[1]}"),
    between(1, 1 << 15, "pixels", "for instance 256"),
    Metavar("PIXELS|WIDTHxHEIGHT"),
]
"""Width and height of images: 256, or 256x192."""
Colour = Annotated[
    tuple[float, float, float],
    Converter(_colour, _written),
    between(0, 1, "sRGB", "divide 8-bit values by 255"),
    Metavar("COLOUR"),
]
"""An sRGB colour: white, #80b0e0, or 0.5,0.7,0.9 in [0, 1]."""
Direction = Annotated[
    tuple[float, float, float], Converter(_direction, _written), Metavar("AXIS|X,Y,Z")
]
"""A direction: y, -y, or 0,-1,0."""


Rate = Annotated[
    float,
    Range(low=0, high=1000, open_low=True, unit="frames per second", do="24 is usual"),
    Metavar("RATE"),
]
Samples = Annotated[int, between(1, 1 << 16, "samples per pixel", "32 is usual")]
Azimuth = Annotated[float, between(-360, 360, "degrees")]
Elevation = Annotated[float, between(-90, 90, "degrees", "90 is straight down")]
FieldOfView = Annotated[
    float,
    Range(
        low=0, high=180, open_low=True, open_high=True, unit="degrees", do="45 is usual"
    ),
]
Roll = Annotated[float, between(-180, 180, "degrees")]
Point = Annotated[
    tuple[float, float, float], Range(unit="world units"), Metavar("X Y Z")
]


@dataclass(frozen=True, kw_only=True)
class JsonOptions:
    """What a command takes that prints a result."""

    json: bool = False
    """Print one JSON document on stdout instead of text."""


@dataclass(frozen=True, kw_only=True)
class ResultOptions(JsonOptions):
    """What a command takes that writes a folder of results."""

    out: OutFolder = Path("out")
    """Folder for the results: a new one, written whole at the end."""
    force: bool = False
    """Replace an older result in --out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """Where a scene is looked at from.

    Without any of these flags it is the scene's own first camera, or an orbit camera
    that shows the object, or all if no object is meant.
    """

    cameras: Annotated[tuple[str, ...], Metavar("CAMERAS")] = ()
    """Any of: ids of the scene's own cameras, or all of them by `all`; hemisphere:N,
    orbit:N@ELEVATION, cap:N@MIN_ELEVATION or grid:AxE (azimuths x elevations) around
    --centre; a transforms .json; cameras.json of an earlier result; the cameras.json
    that 3DGS writes beside a splat; the folder of a set of images (COLMAP or
    transforms); another scene .xml. FILE#NAME selects one camera by name. Default: the
    scene's first camera, or an orbit camera that shows the object.
    """
    azimuth: Azimuth | None = None
    """One camera on an orbit around --centre: degrees from +x towards +y. Default: 30,
    where an orbit is used.
    """
    elevation: Elevation | None = None
    """Degrees above the ground; 90 looks straight down. Default: 20, where an orbit is
    used.
    """
    camera_roll: Roll = 0.0
    """Roll of the one camera about its viewing axis in degrees, clockwise."""
    distance: Length | None = None
    """World units from the centre. Default: as near as shows the whole object or scene.
    """
    centre: Point | None = None
    """Point that the cameras of an orbit or a set face. Default: the centre of the
    object, or of all Gaussians.
    """
    up: Direction | None = None
    """Up direction of the scene, for orbits and sets: an axis, or X,Y,Z; scenes from
    COLMAP often have -y. Default: z for a scene XML; for a splat file taken from its
    comment, its cameras or its ground, else z.
    """
    fov: FieldOfView = 45.0
    """Field of view of orbits and sets in degrees, over the shorter side of the image.
    """
    size: Size | None = None
    """Image size in pixels, as 256 or 256x192. Default: the camera's own; 640x480 for
    orbits and sets.
    """
    near: Length | None = None
    """Near plane: Gaussians nearer to the camera than this are not drawn, world units.
    Default: chosen from scene and cameras.
    """
    background: Colour | None = None
    """Background colour, as white, #80b0e0 or 0.5,0.7,0.9. Default: the scene's own;
    black for a splat file.
    """

    @property
    def orbits(self) -> bool:
        """Whether one camera on an orbit is asked for."""
        given = (
            self.azimuth,
            self.elevation,
            self.camera_roll or None,
            self.distance,
            self.centre,
        )
        return any(value is not None for value in given)
