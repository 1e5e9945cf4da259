"""Cameras in the JSON files that the commands write, so that a later command can look
from the same places.

Also in the cameras.json that the trainer of 3D Gaussian Splatting (Kerbl et al. 2023)
writes beside its splats: a list of objects with img_name, width, height, fx, fy,
position (3,) and rotation (3, 3), camera to world with our axes.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import PERSPECTIVE, Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import DocumentReader, Fields, kind_of

OF = "#"
"""Stands between a file or a folder with cameras and the name of one of them."""
_AGAIN = "write it again"
_MOST_PIXELS = 1 << 31  # a camera has a bound of its own
_RECORD = DocumentReader(expected="cameras as the commands write them", do=_AGAIN)


def describe(name: str, camera: Camera) -> dict[str, object]:
    """A camera as JSON can hold it; the pose has x right, y down, z forward."""
    return {"name": name, **values_of(camera)}


def values_of(camera: Camera) -> dict[str, object]:
    """All of a camera but a name, as JSON can hold it; `camera_of` makes the same
    camera of it again.
    """
    lens = camera.lens
    values: dict[str, object] = {
        "to_world": camera.to_world.tolist(),
        "focal": list(lens.scale),
        "principal": [lens.cx, lens.cy],
        "size": list(lens.size),
    }
    if not lens.is_perspective:
        values["projection"] = lens.projection
    return values


def recorded_cameras(path: Path, *, reference: bool = True) -> dict[str, Camera] | None:
    """The cameras, by name, of a file that one of the commands or the trainer of 3DGS
    has written.

    Of an attack on a distribution of views it is the reference camera alone, with which
    the attack can be repeated.
    """
    try:
        document = _RECORD.read_json_value(path)
    except InvalidValueError:
        return None
    entries = _entries(document, str(path))
    if not entries or (not reference and "reference" in document):
        return None
    return {name: _camera(entry) for name, entry in entries}


def _entries(document: Any, path: str) -> list[tuple[str, Fields]]:
    """Names and fields of the cameras in a document; nothing in one of another
    program.
    """
    if isinstance(document, list):
        document = {"cameras": document}
    root = Fields(
        document if isinstance(document, dict) else {}, path, InvalidValueError, _AGAIN
    )
    if "frames" in root.values:
        return []
    # of an attack on a distribution of views, which are drawn about this camera
    if "reference" in root.values:
        return [_named(root.object("reference"), 0)]
    # of an attack, whose cameras are called by names beside the views
    if isinstance(root.values.get("views"), list):
        views = root.objects("views")
        pairs = zip(
            root.texts("cameras") or map(str, range(len(views))), views, strict=False
        )
        return [
            _named(view.object("camera"), name)
            for name, view in pairs
            if "camera" in view.values
        ]
    listed = isinstance(root.values.get("cameras"), list)
    if listed:
        return [
            _named(entry, number)
            for number, entry in enumerate(root.objects("cameras"))
        ]
    return []


def _named(entry: Fields, usual: object) -> tuple[str, Fields]:
    """A camera with its name, or the usual one if it has none."""
    name = entry.values.get("name", entry.values.get("img_name", usual))
    if not isinstance(name, str | int):
        raise entry.bad("name", "a text", name)
    return str(name), entry


def unique_names(names: Iterable[str]) -> list[str]:
    """As many names, all different: of those that are alike, the later ones get a
    number.
    """
    taken = dict[str, None]()
    for name in names:
        number = len(taken)
        free = name
        while free in taken:
            free = f"{name}-{number}"
            number = number + 1
        taken[free] = None
    return list(taken)


def camera_of(entry: Mapping[str, object], where: str = "camera") -> Camera:
    """A camera as `describe`, or the trainer of 3DGS, writes it."""
    if not isinstance(entry, Mapping):
        raise InvalidValueError.of(where, "an object", kind_of(entry), _AGAIN)
    return _camera(Fields(entry, where, InvalidValueError, _AGAIN))


def _camera(entry: Fields) -> Camera:
    try:
        if "rotation" in entry.values:  # of the trainer of 3DGS
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = torch.tensor(
                entry.rows("rotation", 3, 3), dtype=torch.float64
            )
            pose[:3, 3] = torch.tensor(
                entry.numbers("position", 3, 3), dtype=torch.float64
            )
            width, height = (
                entry.whole(name, 1, _MOST_PIXELS) for name in ("width", "height")
            )
            return Camera(
                to_world=pose,
                lens=Lens(
                    focal=(entry.number("fx"), entry.number("fy")), size=(width, height)
                ),
            )
        width, height = entry.wholes("size", 1, _MOST_PIXELS, 2)
        fx, fy = entry.numbers("focal", 2, 2)
        cx, cy = entry.numbers("principal", 2, 2)
        pose = torch.tensor(entry.rows("to_world", 4, 4), dtype=torch.float64)
        lens = Lens(
            focal=(fx, fy),
            size=(width, height),
            principal=(cx, cy),
            projection=entry.text("projection", PERSPECTIVE.name),
        )
        return Camera(to_world=pose, lens=lens)
    except InvalidValueError as error:
        raise InvalidValueError(f"{entry.where}: {error}") from error
