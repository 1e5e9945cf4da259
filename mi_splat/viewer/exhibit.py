"""What a page shows, as one value, and how somebody else's findings and photographs come into its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import torch
from PIL import ImageDraw
from torch import Tensor

from mi_splat.bounds import bounds
from mi_splat.cameras import Camera, View
from mi_splat.directions import UP, Point, up_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import OF
from mi_splat.rendering import RenderSettings
from mi_splat.rotation import from_z
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.scene_files import open_scene, orbit_camera, resized
from mi_splat.training.evaluation import HasMasks
from mi_splat.viewer.composition import BESIDE, DIFFERENCE, SPLIT
from mi_splat.viewer.lines import Lines
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of


class Inspection(Protocol):
    """What was found in a picture."""

    @property
    def text(self) -> str:
        """The findings in words, one a line; plain text."""
        ...

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """Draw the findings into a picture that has `scale` pixels for one of the picture that was inspected."""
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
class Photographs:
    """Pictures that were taken from cameras of a page.

    Attributes:
        views: The pictures; a set reads each when it is asked for.
        numbers: Of the picture from each camera, by the camera's name.
        name: What they are called on the page.
    """

    views: Sequence[View]
    numbers: Mapping[str, int]
    name: str = "photograph"

    def from_camera(self, camera: str | None) -> Tensor | None:
        """(H, W, 3) the picture from a camera of this name; None if there is none."""
        return None if camera is None or camera not in self.numbers else self.views[self.numbers[camera]].image

    def shown_from(self, camera: str | None) -> Tensor | None:
        """(H, W) 0 where the image of a camera is masked, as at a border that a lens left; None if nowhere."""
        if camera is None or camera not in self.numbers or not isinstance(self.views, HasMasks):
            return None
        return self.views.loss_mask(self.numbers[camera], files=False)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Exhibit:
    """What a page shows.

    Attributes:
        title: Of the page.
        splats: One, or two to be compared, the clean one first; none where there are photographs.
        settings: How they are rendered.
        start: The first camera.
        size: Width and height in pixels of the picture that is inspected, and that `mi-splat render` would make; what
            the page shows has the same shape. A camera of a file has its own.
        cameras: Cameras to choose from, by name.
        lines: Lines to be drawn, by name.
        photographs: What was taken from some of the cameras, shown before a splat or alone.
        up: (3,) direction in the files that is up; splats, cameras and lines are turned so that it is z.
        describe: Says in words where a camera stands, one line a thing; empty where there is nothing to say.

    Raises:
        InvalidValueError: There is nothing to show or more than two things, two have one name, one is called as a way
            of showing two is, or what is to be shown is no Unicode: names of files and JSON may hold what is not.
    """

    title: str
    splats: tuple[ShownSplat, ...]
    settings: RenderSettings
    start: Orbit
    size: tuple[int, int]
    cameras: Mapping[str, Orbit] = field(default_factory=dict)
    lines: Mapping[str, Lines] = field(default_factory=dict)
    photographs: Photographs | None = None
    up: Point = UP
    describe: Callable[[Camera], tuple[str, ...]] = lambda camera: ()

    def __post_init__(self) -> None:
        if not 1 <= len(set(self.names)) == len(self.names) <= 2:
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
        """What is shown, by name: photographs first."""
        photographs = () if self.photographs is None else (self.photographs.name,)
        return (*photographs, *(splat.name for splat in self.splats))

    def splat(self, name: str) -> ShownSplat:
        """The splat of this name."""
        return next(splat for splat in self.splats if splat.name == name)

    def camera_name(self, orbit: Orbit) -> str | None:
        """Name of the camera to choose that this is; None if it is none."""
        return next((name for name, camera in self.cameras.items() if camera == orbit), None)

    def size_at(self, orbit: Orbit) -> tuple[int, int]:
        """Width and height in pixels of the picture of a camera that is inspected."""
        return orbit.camera_size or self.size

    def turned(self, up: Point) -> Exhibit:
        """The same with another direction up: all is turned about the origin, so that it is z.

        Cameras of files keep their pictures. Others stay level, as far above the new ground as they were above the old.
        """
        if tuple(up) == tuple(self.up):
            return self
        back = from_z(torch.tensor(list(self.up), dtype=torch.float64))
        turn = from_z(torch.tensor(list(up), dtype=torch.float64)).T @ back

        def turned_orbit(orbit: Orbit) -> Orbit:
            target = (turn @ torch.tensor(list(orbit.target), dtype=torch.float64)).tolist()
            level = replace(orbit, target=target)
            return level if orbit.exact is None else orbit_of(orbit.exact.turned(turn), target, source=orbit.source)

        motion, describe = Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0), self.describe
        named = {name: turned_orbit(orbit) for name, orbit in self.cameras.items()}
        first = self.camera_name(self.start)
        return replace(
            self,
            splats=tuple(replace(splat, scene=splat.scene.transform(motion)) for splat in self.splats),
            cameras=named,
            start=turned_orbit(self.start) if first is None else named[first],
            lines={
                name: replace(lines, segments=lines.segments.double() @ turn.T) for name, lines in self.lines.items()
            },
            up=up,
            describe=lambda camera: describe(camera.turned(turn.T)),
        )


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
        exhibit = replace(exhibit, settings=settings)
        return exhibit if self.size is None else _of_size(exhibit, self.size)


def own_up(exhibit: Exhibit) -> Point | None:
    """(3,) axis of the files that is up in the pictures of most cameras of files; None if the page has it up already.

    It is told where `up_of` the cameras is within a quarter of a right angle of an axis, and away from up on the page.
    """
    cameras = [orbit.exact for orbit in exhibit.cameras.values() if orbit.exact is not None]
    if not cameras:
        return None
    back = from_z(torch.tensor(list(exhibit.up), dtype=torch.float64))
    up = back @ up_of(torch.stack([camera.to_world[:3, :3] for camera in cameras]))
    axis = int(up.abs().argmax())
    if not float(up.abs()[axis]) > math.cos(math.pi / 8):
        return None
    seen = tuple(float(up.sign()[axis]) if column == axis else 0.0 for column in range(3))
    return None if seen == tuple(exhibit.up) else seen


def _of_size(exhibit: Exhibit, size: tuple[int, int]) -> Exhibit:
    """The exhibit with pictures of one size, those of cameras of files included."""

    def sized(orbit: Orbit) -> Orbit:
        return orbit if orbit.exact is None else replace(orbit, exact=resized(orbit.exact, size))

    named, first = {name: sized(orbit) for name, orbit in exhibit.cameras.items()}, exhibit.camera_name(exhibit.start)
    start = sized(exhibit.start) if first is None else named[first]
    return replace(exhibit, size=size, cameras=named, start=start)


def exhibit_of_file(path: Path, *, name: str | None = None, clean: Path | None = None) -> Exhibit:
    """A splat file or a scene XML, alone or beside the clean one that it was made from."""
    loaded = open_scene(path)
    first = loaded if clean is None else open_scene(clean)
    middle = focus_of(list(first.cameras.values()), bounds(first.scene)[0])
    usual_name = path.name if path.stem in (BESIDE, SPLIT, DIFFERENCE) else path.stem
    splats = [ShownSplat(name=name or usual_name, scene=loaded.scene, path=path, file_settings=loaded.settings)]
    if clean is not None:
        splats = [
            ShownSplat(name="clean", scene=first.scene, path=clean, file_settings=first.settings),
            replace(splats[0], name=name or "attacked"),
        ]
    source = clean or path
    cameras = {key: orbit_of(camera, middle, source=f"{source}{OF}{key}") for key, camera in first.cameras.items()}
    seen = next(iter(first.cameras.values()), None)
    start = next(iter(cameras.values()), None) or whole(first.scene)
    return Exhibit(
        title=path.name,
        splats=tuple(splats),
        settings=first.settings,
        start=start,
        size=(640, 480) if seen is None else (seen.width, seen.height),
        cameras=cameras or {"whole scene": start},
    )


def whole(scene: GaussianScene) -> Orbit:
    """The camera from which `mi-splat render` shows all of a scene."""
    middle, _ = bounds(scene)
    azimuth, elevation, fov = 30.0, 20.0, 45.0  # the defaults of `mi-splat render`
    camera = orbit_camera(scene, azimuth=azimuth, elevation=elevation, distance=None, fov=fov, size=(640, 480))
    distance = round(math.dist(camera.position.tolist(), middle), 4)
    return Orbit(target=middle, azimuth=azimuth, elevation=elevation, distance=distance, fov=fov)
