"""What a page shows: splats, cameras and photographs, and the interface of
detectors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from PIL import ImageDraw
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, odd_fields_of_view
from mi_splat.cameras.directions import UP, Point
from mi_splat.cameras.framing import bounds
from mi_splat.cameras.rooms import place_inside
from mi_splat.cameras.sets import framing
from mi_splat.datasets import DatasetError, DatasetWarning, is_dataset, load_dataset
from mi_splat.datasets.poses import poses_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import OF, recorded_cameras, unique_names
from mi_splat.io.up_axis import UpAxis, cameras_up
from mi_splat.maths.rotation import from_z
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import open_scene, resized
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.training.evaluation import loss_mask_of
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of
from mi_splat.viewer.session import DIFFERENCE, SIDE_BY_SIDE

# pixels of the longer side beyond which a photograph is made smaller by a whole number
LONGEST_SIDE = 1600


def photographs_of(
    path: Path, *, background: tuple[float, float, float], centre: Point | None = None
) -> tuple[dict[str, Orbit], Photographs]:
    """The cameras of a data set by name, which says which are held out, and its
    images.
    """
    views = load_dataset(path, split=None, background=background)
    longest = max(max(camera.width, camera.height) for camera in views.cameras)
    factor = -(-longest // LONGEST_SIDE)
    views = replace(views, downscale=factor)
    held_out = frozenset(load_dataset(path, split="test").paths)
    names = unique_names(file.stem for file in views.paths)
    first = views.cameras[0]
    labels = [
        f"{name} (held out)" if file in held_out else name
        for name, file in zip(names, views.paths, strict=True)
    ]
    if centre is None:
        centre = focus_of(
            views.cameras, (first.position + first.to_world[:3, 2]).tolist()
        )
    orbits = {
        label: orbit_of(camera, centre, source=f"{path}{OF}{name}")
        for label, name, camera in zip(labels, names, views.cameras, strict=True)
    }
    return orbits, Photographs(
        views=views, numbers={label: i for i, label in enumerate(orbits)}
    )


def content_of_dataset(
    path: Path, *, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Content:
    """The photographs of a data set without a splat, from the first of their
    cameras.
    """
    orbits, photographs = photographs_of(path, background=background)
    first = next(iter(orbits.values()))
    return Content(
        title=f"{path}: {len(orbits)} photographs",
        splats=(),
        settings=RenderSettings(background=background),
        start=first,
        size=first.camera_size or (640, 480),
        cameras=orbits,
        photographs=photographs,
        file_up=_up_of_cameras(orbits.values()),
    )


def _up_of_cameras(orbits: Iterable[Orbit]) -> UpAxis | None:
    """What the cameras of photographs tell of the direction that is up."""
    exact = [orbit.exact for orbit in orbits if orbit.exact is not None]
    poses = [camera.to_world[:3, :3].double().numpy() for camera in exact]
    direction = cameras_up(np.array(poses)) if poses else None
    if direction is None:
        return None
    return UpAxis(direction, "as its cameras stand")


def with_cameras(content: Content, path: Path) -> Content:
    """A content with the cameras of a data set or of a list before its own; one splat
    also gets the photographs.
    """
    if content.photographs is not None:
        got = f"those of {path}"
        do = "leave one of the two data sets out"
        raise InvalidValueError(
            message("cameras", "none with a data set, which has its own", got, do)
        )
    centre = content.start.target
    photographs = None
    recorded = recorded_cameras(path) if path.is_file() else None
    if recorded is not None:
        orbits = {
            name: orbit_of(camera, centre, source=f"{path}{OF}{name}")
            for name, camera in recorded.items()
        }
    elif is_dataset(path) or (path.suffix.lower() == ".json" and path.is_file()):
        try:
            orbits, photographs = photographs_of(
                path, background=content.settings.background, centre=centre
            )
        except DatasetError:  # of images or lenses that cannot be read, the poses alone
            poses = poses_of(path, content.size)
            orbits = {
                name: orbit_of(camera, centre, source=f"{path}{OF}{name}")
                for name, camera in poses.items()
            }
    else:
        expected = "a data set (COLMAP or transforms), or a JSON file with cameras"
        got = "neither" if path.exists() else "nothing there"
        raise InvalidValueError(
            message("cameras", expected, f"{path}, {got}", "name one that is there")
        )
    exact = [orbit.exact for orbit in orbits.values() if orbit.exact is not None]
    if photographs is None and (odd := odd_fields_of_view(exact)) is not None:
        warnings.warn(f"{path}: {odd}", DatasetWarning, stacklevel=2)
    first = next(iter(orbits.values()))
    own = {
        f"{name} of the scene" if name in orbits else name: orbit
        for name, orbit in content.cameras.items()
    }
    alone = len(content.names) == 1
    shown = "with the photographs" if photographs and alone else "from the cameras"
    return replace(
        content,
        title=f"{content.title} {shown} of {path}",
        start=first,
        size=first.camera_size or content.size,
        cameras={**orbits, **own},
        photographs=photographs if alone else None,
    )


class Inspection(Protocol):
    """What a detector found in an image."""

    @property
    def text(self) -> str:
        """The findings as plain text, one a line."""
        ...

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """Draw the findings into an image that is `scale` times as wide as the
        inspected one.
        """
        ...


# inspects an image, (H, W, 3) float32 sRGB of 8 bits in [0, 1]
Inspector = Callable[[Tensor], Inspection]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ShownSplat:
    """A splat by the name that it has on the page, and its file."""

    name: str
    scene: GaussianScene
    path: Path


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Photographs:
    """Images of a data set, which is read as needed, by the names of their
    cameras.
    """

    views: Sequence[View]
    numbers: Mapping[str, int]
    name: str = "photograph"

    def from_camera(self, camera: str | None) -> Tensor | None:
        """(H, W, 3) the image of the camera of this name; None if there is none."""
        if camera is None or camera not in self.numbers:
            return None
        return self.views[self.numbers[camera]].image

    def counting_pixels(self, camera: str | None) -> Tensor | None:
        """(H, W) 0 where the image of a camera is masked, as at the border of an
        undistorted one; None if nowhere.
        """
        if camera is None or camera not in self.numbers:
            return None
        return loss_mask_of(self.views, self.numbers[camera])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Content:
    """What a page shows: one splat, or two of which the first is the clean one, or
    photographs with at most one.

    `size` (width, height) is that of the inspected image, unless a camera of a file
    has its own. Everything is turned so that `up`, a direction of the files, is z on
    the page; `file_up` is what they tell of it. `describe` says in words where a camera
    stands.
    """

    title: str
    splats: tuple[ShownSplat, ...]
    settings: RenderSettings
    start: Orbit
    size: tuple[int, int]
    cameras: Mapping[str, Orbit] = field(default_factory=dict)
    photographs: Photographs | None = None
    up: Point = UP
    file_up: UpAxis | None = None
    describe: Callable[[Camera], tuple[str, ...]] = lambda camera: ()

    def __post_init__(self) -> None:
        # Names come from files: two may be the same, equal to a display mode, or no
        # Unicode.
        if not 1 <= len(set(self.names)) == len(self.names) <= 2:
            raise InvalidValueError(
                message(
                    "splats",
                    "one, or two of different names",
                    self.names,
                    "name each once",
                )
            )
        taken = {SIDE_BY_SIDE, DIFFERENCE} & set(self.names)
        if taken:
            raise InvalidValueError(
                message("name of a splat", "no display mode", taken.pop(), "rename it")
            )
        for text in (
            self.title,
            *self.names,
            *self.cameras,
            *(str(splat.path) for splat in self.splats),
        ):
            try:
                text.encode()
            except UnicodeEncodeError as error:
                raise InvalidValueError(
                    message("name", "Unicode", ascii(text), "rename it")
                ) from error

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is shown, photographs first."""
        photographs = () if self.photographs is None else (self.photographs.name,)
        return (*photographs, *(splat.name for splat in self.splats))

    def splat(self, name: str) -> ShownSplat:
        """The splat of this name."""
        return next(splat for splat in self.splats if splat.name == name)

    def camera_name(self, orbit: Orbit) -> str | None:
        """Name of this camera in the list of cameras; None if it is not listed."""
        return next(
            (name for name, camera in self.cameras.items() if camera == orbit), None
        )

    def size_at(self, orbit: Orbit) -> tuple[int, int]:
        """Width and height in pixels of the inspected image of a camera."""
        return orbit.camera_size or self.size

    def turned(self, up: Point) -> Content:
        """The same with another up direction: everything is turned about the origin, so
        that it is z.
        """
        if tuple(up) == tuple(self.up):
            return self
        back = from_z(torch.tensor(list(self.up), dtype=torch.float64))
        turn = from_z(torch.tensor(list(up), dtype=torch.float64)).T @ back

        def turned_orbit(orbit: Orbit) -> Orbit:
            target = (
                turn @ torch.tensor(list(orbit.target), dtype=torch.float64)
            ).tolist()
            level = replace(orbit, target=target)
            if orbit.exact is None:
                return level
            return orbit_of(orbit.exact.turned(turn), target, source=orbit.source)

        motion = Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0)
        describe = self.describe
        return replace(
            self.with_orbits(turned_orbit),
            splats=tuple(
                replace(splat, scene=splat.scene.transform(motion))
                for splat in self.splats
            ),
            up=up,
            describe=lambda camera: describe(camera.turned(turn.T)),
        )

    def with_orbits(self, change: Callable[[Orbit], Orbit]) -> Content:
        """The same with changed cameras."""
        cameras = {name: change(orbit) for name, orbit in self.cameras.items()}
        first = self.camera_name(self.start)
        return replace(
            self,
            cameras=cameras,
            start=change(self.start) if first is None else cameras[first],
        )

    def with_settings(
        self,
        *,
        background: tuple[float, float, float] | None = None,
        near: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> Content:
        """The same with other settings than those of the files; None changes
        nothing.
        """
        settings = self.settings
        if background is None:
            settings = settings
        else:
            settings = replace(settings, background=background)
        content = replace(
            self, settings=settings if near is None else replace(settings, near=near)
        )
        if size is None:
            return content

        def sized(orbit: Orbit) -> Orbit:
            if orbit.exact is None:
                return orbit
            return replace(orbit, exact=resized(orbit.exact, size))

        return replace(content.with_orbits(sized), size=size)


def content_of_file(
    path: Path, *, name: str | None = None, clean: Path | None = None
) -> Content:
    """A splat file or a scene XML, alone or next to the clean one; a splat of 3DGS from
    the cameras of its training.
    """
    loaded = open_scene(path)
    first = loaded if clean is None else open_scene(clean)
    centre = focus_of(list(first.cameras.values()), bounds(first.scene)[0])
    name = name or (path.name if path.stem in (SIDE_BY_SIDE, DIFFERENCE) else path.stem)
    splats = [ShownSplat(name=name, scene=loaded.scene, path=path)]
    if clean is not None:
        splats = [
            ShownSplat(name="clean", scene=first.scene, path=clean),
            replace(splats[0], name="attacked"),
        ]
    source = clean or path
    cameras = {
        key: orbit_of(camera, centre, source=f"{source}{OF}{key}")
        for key, camera in first.cameras.items()
    }
    start = next(iter(cameras.values()), None) or whole(first.scene)
    content = Content(
        title=path.name,
        splats=tuple(splats),
        settings=first.settings,
        start=start,
        size=start.camera_size or (640, 480),
        cameras=cameras or {"whole scene": start},
        file_up=first.up,
    )
    # point_cloud of FOLDER/point_cloud/iteration_30000/point_cloud.ply
    trained = path.resolve().parent.parent
    listed = trained.parent / "cameras.json"
    if trained.name == "point_cloud" and listed.is_file():
        return with_cameras(content, listed)
    return content


def whole(scene: GaussianScene) -> Orbit:
    """The camera from which `mi-splat render` shows all of a scene, or a room from
    inside.
    """
    (centre, radius), fov = bounds(scene), 45.0
    distance, _ = framing(radius, fov=fov, size=(640, 480))
    azimuth = 30.0
    place = place_inside(scene)
    if place is not None and place.is_room:
        centre = place.centre
        distance = place.distance
        azimuth = place.azimuth
    return Orbit(
        target=centre,
        azimuth=azimuth,
        elevation=20.0,
        distance=round(distance, 4),
        fov=fov,
    )
