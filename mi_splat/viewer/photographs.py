"""Data sets and lists of cameras on a page: their cameras to choose from, and what was photographed from each."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from mi_splat.cameras import Camera
from mi_splat.datasets import Dataset, is_dataset, load_dataset
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import OF, recorded_cameras, unique_names
from mi_splat.rendering import RenderSettings
from mi_splat.viewer.exhibit import Exhibit, Photographs
from mi_splat.viewer.lines import Lines, frustums
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of

LONGEST_SIDE = 1600
"""Pixels of the longer side of a photograph beyond which it is made smaller by a whole number."""
_CONE = 0.05
"""Length of a camera's pyramid in distances of the first camera."""


def photographs_of(
    path: Path, *, background: tuple[float, float, float], middle: Point | None = None
) -> tuple[dict[str, Orbit], Photographs]:
    """The cameras of a set by name, and its pictures; those that are held out say so."""
    views = load_dataset(path, split=None, background=background)
    longest = max(max(camera.width, camera.height) for camera in views.cameras)
    factor = -(-longest // LONGEST_SIDE)
    if factor > 1 and not any(factor % frame.shrunk for frame in views.frames):
        views = replace(views, downscale=factor)
    held_out = load_dataset(path, split="test").paths
    return _listed(views, path, frozenset(held_out), middle)


def photographs_in(sets: Sequence[Dataset], path: Path) -> tuple[dict[str, Orbit], Photographs]:
    """As `photographs_of`, of views that are loaded, the held-out ones first."""
    views, *held_out = sets
    frames = tuple(frame for part in (*held_out, views) for frame in part.frames)
    return _listed(replace(views, frames=frames), path, {file for part in held_out for file in part.paths})


def _listed(
    views: Dataset, path: Path, held_out: Collection[Path], middle: Point | None = None
) -> tuple[dict[str, Orbit], Photographs]:
    """The cameras of views by name, and the pictures."""
    names = unique_names(file.stem for file in views.paths)
    shown = [f"{name} (held out)" if file in held_out else name for name, file in zip(names, views.paths, strict=True)]
    centre = focus_of(views.cameras, _before(views.cameras[0])) if middle is None else middle
    orbits = {
        label: orbit_of(camera, centre, source=f"{path}{OF}{name}")
        for label, name, camera in zip(shown, names, views.cameras, strict=True)
    }
    return orbits, Photographs(views=views, numbers={label: i for i, label in enumerate(orbits)})


def exhibit_of_dataset(path: Path, *, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Exhibit:
    """A set of pictures alone."""
    orbits, photographs = photographs_of(path, background=background)
    first = next(iter(orbits.values()))
    return Exhibit(
        title=f"{path}: {len(orbits)} photographs",
        splats=(),
        settings=RenderSettings(background=background),
        start=first,
        size=first.camera_size or (640, 480),
        cameras=orbits,
        lines={"Cameras": _cones(orbits)},
        photographs=photographs,
    )


def with_cameras(exhibit: Exhibit, path: Path) -> Exhibit:
    """An exhibit with the cameras of a data set or of a list before its own; one splat also gets the photographs."""
    if exhibit.photographs is not None:
        got, do = f"those of {path}", "leave one of the two sets out"
        raise InvalidValueError(message("cameras", "none beside a set, which has its own", got, do))
    middle, photographs = exhibit.start.target, None
    recorded = recorded_cameras(path) if path.is_file() else None
    if recorded is not None:
        orbits = {name: orbit_of(camera, middle, source=f"{path}{OF}{name}") for name, camera in recorded.items()}
    elif is_dataset(path):
        orbits, photographs = photographs_of(path, background=exhibit.settings.background, middle=middle)
    else:
        expected = "a set of pictures (COLMAP or transforms), or a JSON file with cameras"
        got = "neither" if path.exists() else "nothing there"
        raise InvalidValueError(message("cameras", expected, f"{path}, {got}", "name one that is there"))
    first = next(iter(orbits.values()))
    own = {f"{name} of the scene" if name in orbits else name: orbit for name, orbit in exhibit.cameras.items()}
    alone = len(exhibit.names) == 1
    return replace(
        exhibit,
        title=f"{exhibit.title} {'beside the photographs' if photographs and alone else 'from the cameras'} of {path}",
        start=first,
        size=first.camera_size or exhibit.size,
        cameras={**orbits, **own},
        lines={**exhibit.lines, f"Cameras of {path.name}": _cones(orbits)},
        photographs=photographs if alone else None,
    )


def _before(camera: Camera) -> Point:
    """(3,) a point before a camera."""
    x, y, z = (camera.position + camera.to_world[:3, 2]).tolist()
    return x, y, z


def _cones(orbits: Mapping[str, Orbit]) -> Lines:
    """The pyramids that cameras of files see."""
    length = _CONE * next(iter(orbits.values())).distance
    return Lines(
        segments=frustums([orbit.exact for orbit in orbits.values() if orbit.exact is not None], length),
        colour="#ffa500",
    )
