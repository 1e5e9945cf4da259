"""What a page shows, as one value, and how somebody else's findings come into its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import torch
from PIL import ImageDraw
from torch import Tensor

from mi_splat.bounds import bounds
from mi_splat.cameras import Camera
from mi_splat.directions import UP, Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import RenderSettings
from mi_splat.rotation import from_z
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.scene_files import SplatScene, open_scene, orbit_camera
from mi_splat.viewer.composition import BESIDE, DIFFERENCE, SPLIT
from mi_splat.viewer.lines import Lines
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of


class Inspection(Protocol):
    """What was found in a picture."""

    @property
    def text(self) -> str:
        """It in words, one finding a line; plain text."""
        ...

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """Draw it into a picture that has `scale` pixels for one of the picture that was inspected."""
        ...


Inspector = Callable[[Tensor], Inspection]
"""Looks at a picture, (H, W, 3) float32 sRGB of 8 bits in [0, 1]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ShownSplat:
    """A splat and the file that it comes from.

    Attributes:
        name: What it is called on the page.
        scene: Its Gaussians.
        path: Its file: a splat or a scene XML.
        file_settings: How that file is rendered unless told otherwise.
    """

    name: str
    scene: GaussianScene
    path: Path
    file_settings: RenderSettings


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Exhibit:
    """What a page shows.

    Attributes:
        title: Of the page.
        splats: One, or two to be compared, the clean one first.
        settings: How they are rendered.
        start: The first camera.
        size: Width and height in pixels of the picture that is inspected, and that `mi-splat render` would make; what
            the page shows has the same shape.
        cameras: Cameras to choose from, by name.
        lines: Lines to be drawn, by name.
        up: (3,) direction in the files that is up; splats, cameras and lines are turned so that it is z.
        describe: Says in words where a camera stands, one line a thing; empty where there is nothing to say.

    Raises:
        InvalidValueError: There is no splat or more than two, two have one name, one is called as a way of showing two
            is, or what is to be shown is no Unicode: names of files and JSON may hold what is not.
    """

    title: str
    splats: tuple[ShownSplat, ...]
    settings: RenderSettings
    start: Orbit
    size: tuple[int, int]
    cameras: Mapping[str, Orbit] = field(default_factory=dict)
    lines: Mapping[str, Lines] = field(default_factory=dict)
    up: Point = UP
    describe: Callable[[Camera], tuple[str, ...]] = lambda camera: ()

    def __post_init__(self) -> None:
        if not 1 <= len(set(self.names)) == len(self.splats) <= 2:
            raise InvalidValueError(message("splats", "one, or two of different names", self.names, "name each once"))
        taken = {BESIDE, SPLIT, DIFFERENCE} & set(self.names)
        if taken:
            raise InvalidValueError(message("name of a splat", "none of a way of showing", taken.pop(), "rename it"))
        paths = (str(splat.path) for splat in self.splats)
        for text in (self.title, *self.names, *self.cameras, *self.lines, *paths):
            try:
                text.encode()
            except UnicodeEncodeError as error:
                raise InvalidValueError(message("name", "Unicode", ascii(text), "rename it")) from error

    @property
    def names(self) -> tuple[str, ...]:
        """What the splats are called."""
        return tuple(splat.name for splat in self.splats)

    def splat(self, name: str) -> ShownSplat:
        """The splat of this name."""
        return self.splats[self.names.index(name)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What the user asked for in place of what the files say; None changes nothing.

    Attributes:
        background: sRGB colour behind the Gaussians.
        near: Gaussians nearer than this (depth, world units) are left out.
        size: Width and height in pixels of the picture that is inspected.
    """

    background: tuple[float, float, float] | None = None
    near: float | None = None
    size: tuple[int, int] | None = None

    def applied(self, exhibit: Exhibit) -> Exhibit:
        """The exhibit as wished."""
        settings = exhibit.settings
        if self.background is not None:
            settings = replace(settings, background=self.background)
        if self.near is not None:
            settings = replace(settings, near=self.near)
        return replace(exhibit, settings=settings, size=self.size or exhibit.size)


def exhibit_of_file(path: Path, *, name: str | None = None, clean: Path | None = None, up: Point = UP) -> Exhibit:
    """A splat file or a scene XML, alone or beside the clean one that it was made from.

    Args:
        path: Splat file or scene XML.
        name: What its splat is called; None is the name of the file, or "attacked" beside a clean one. That of the file
            is without its ending, unless it is then a way of showing two splats.
        clean: Splat file or scene XML; with one, cameras and settings are its own.
        up: (3,) direction in the files that is up.

    Raises:
        MiSplatError: A file cannot be read, is of another kind, or holds no Gaussians.
    """
    loaded = _upright(open_scene(path), up)
    first = loaded if clean is None else _upright(open_scene(clean), up)
    middle = focus_of(list(first.cameras.values()), bounds(first.scene)[0])
    usual_name = path.name if path.stem in (BESIDE, SPLIT, DIFFERENCE) else path.stem
    splats = [ShownSplat(name=name or usual_name, scene=loaded.scene, path=path, file_settings=loaded.settings)]
    if clean is not None:
        splats = [
            ShownSplat(name="clean", scene=first.scene, path=clean, file_settings=first.settings),
            replace(splats[0], name=name or "attacked"),
        ]
    orbits = {key: orbit_of(camera, middle) for key, camera in first.cameras.items()}
    cameras = {key: orbit for key, orbit in orbits.items() if orbit is not None}
    seen = next((first.cameras[key] for key in cameras), None)
    start = next(iter(cameras.values()), None) or whole(first.scene)
    return Exhibit(
        title=path.name,
        splats=tuple(splats),
        settings=first.settings,
        start=start,
        size=(640, 480) if seen is None else (seen.width, seen.height),
        cameras=cameras or {"whole scene": start},
        up=up,
    )


def _upright(loaded: SplatScene, up: Point) -> SplatScene:
    """A scene turned about its origin, so that a direction of it is z."""
    if tuple(up) == UP:
        return loaded
    turn = from_z(torch.tensor(list(up))).T
    return replace(
        loaded,
        scene=loaded.scene.transform(Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0)),
        cameras={key: camera.turned(turn) for key, camera in loaded.cameras.items()},
    )


def whole(scene: GaussianScene) -> Orbit:
    """The camera from which `mi-splat render` shows all of a scene."""
    middle, _ = bounds(scene)
    azimuth, elevation, fov = 30.0, 20.0, 45.0  # the defaults of `mi-splat render`
    camera = orbit_camera(scene, azimuth=azimuth, elevation=elevation, distance=None, fov=fov, size=(640, 480))
    distance = round(math.dist(camera.position.tolist(), middle), 4)
    return Orbit(target=middle, azimuth=azimuth, elevation=elevation, distance=distance, fov=fov)
