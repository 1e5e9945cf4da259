"""Data sets and lists of cameras on a page: the cameras to choose from, and the photograph of each."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from mi_splat.datasets import Dataset, is_dataset, load_dataset
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import OF, recorded_cameras, unique_names
from mi_splat.rendering import RenderSettings
from mi_splat.viewer.content import Content, Photographs
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of

LONGEST_SIDE = 1600
"""Pixels of the longer side beyond which a photograph is made smaller by a whole number."""


def photographs_of(
    path: Path, *, background: tuple[float, float, float], centre: Point | None = None
) -> tuple[dict[str, Orbit], Photographs]:
    """The cameras of a data set by name, which says which are held out, and its pictures."""
    views = load_dataset(path, split=None, background=background)
    longest = max(max(camera.width, camera.height) for camera in views.cameras)
    factor = -(-longest // LONGEST_SIDE)
    if factor > 1 and not any(factor % frame.shrunk for frame in views.frames):
        views = replace(views, downscale=factor)
    held_out = load_dataset(path, split="test").paths
    return _listed(views, path, frozenset(held_out), centre)


def photographs_in(sets: Sequence[Dataset], path: Path) -> tuple[dict[str, Orbit], Photographs]:
    """As `photographs_of`, for views that are loaded, the held-out ones first."""
    views, *held_out = sets
    frames = tuple(frame for part in (*held_out, views) for frame in part.frames)
    return _listed(replace(views, frames=frames), path, {file for part in held_out for file in part.paths})


def _listed(
    views: Dataset, path: Path, held_out: Collection[Path], centre: Point | None = None
) -> tuple[dict[str, Orbit], Photographs]:
    names, first = unique_names(file.stem for file in views.paths), views.cameras[0]
    labels = [f"{name} (held out)" if file in held_out else name for name, file in zip(names, views.paths, strict=True)]
    if centre is None:
        centre = focus_of(views.cameras, (first.position + first.to_world[:3, 2]).tolist())
    orbits = {
        label: orbit_of(camera, centre, source=f"{path}{OF}{name}")
        for label, name, camera in zip(labels, names, views.cameras, strict=True)
    }
    return orbits, Photographs(views=views, numbers={label: i for i, label in enumerate(orbits)})


def content_of_dataset(path: Path, *, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Content:
    """The photographs of a data set without a splat."""
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
    )


def with_cameras(content: Content, path: Path) -> Content:
    """A content with the cameras of a data set or of a list before its own; one splat also gets the photographs."""
    if content.photographs is not None:
        got, do = f"those of {path}", "leave one of the two data sets out"
        raise InvalidValueError(message("cameras", "none beside a data set, which has its own", got, do))
    centre, photographs = content.start.target, None
    recorded = recorded_cameras(path) if path.is_file() else None
    if recorded is not None:
        orbits = {name: orbit_of(camera, centre, source=f"{path}{OF}{name}") for name, camera in recorded.items()}
    elif is_dataset(path):
        orbits, photographs = photographs_of(path, background=content.settings.background, centre=centre)
    else:
        expected = "a data set (COLMAP or transforms), or a JSON file with cameras"
        got = "neither" if path.exists() else "nothing there"
        raise InvalidValueError(message("cameras", expected, f"{path}, {got}", "name one that is there"))
    first = next(iter(orbits.values()))
    own = {f"{name} of the scene" if name in orbits else name: orbit for name, orbit in content.cameras.items()}
    alone = len(content.names) == 1
    return replace(
        content,
        title=f"{content.title} {'with the photographs' if photographs and alone else 'from the cameras'} of {path}",
        start=first,
        size=first.camera_size or content.size,
        cameras={**orbits, **own},
        photographs=photographs if alone else None,
    )
