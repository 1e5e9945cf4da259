"""Writers of picture sets: transforms files with OpenGL's camera axes, and COLMAP's text model.

Pictures are written one at a time. The files that list them are made from names and cameras alone, and appear whole or
not at all, so a set can be listed when its pictures are there.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras import Camera, View, angle_of
from mi_splat.datasets.colmap import TEST_LIST
from mi_splat.datasets.transforms import OPENGL, PARTS, POINTS
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json, save_png, save_text
from mi_splat.io.errors import from_os_error
from mi_splat.io.points import PointCloud, save_points, to_bytes
from mi_splat.rotation import from_matrix

IMAGES, MASKS = "images", "masks"
"""Folders of the pictures in every set that is written here, and of their masks."""

Listing = Mapping[str, Sequence[tuple[str, Camera]]]
"""Of each split, train and test, the file name of every picture and its camera."""


def write_transforms(
    folder: str | os.PathLike[str],
    views: Iterable[View],
    *,
    test: Iterable[View] = (),
    alphas: Iterable[Tensor] | None = None,
    masks: Iterable[Tensor | None] = (),
    points: PointCloud | None = None,
) -> None:
    """Write a set as Blender and NeRF have it: PNG files, transforms_train.json, transforms_test.json, points3D.ply."""
    root = make_folder(folder)
    listing = _write_pictures(root, views, test, alphas)
    for (name, _), mask in zip((entry for part in listing.values() for entry in part), masks, strict=False):
        if mask is not None:
            save_png(to_bytes(mask), make_folder(root / MASKS) / name)
    list_transforms(root, listing, points)


def write_colmap(
    folder: str | os.PathLike[str],
    views: Iterable[View],
    *,
    test: Iterable[View] = (),
    alphas: Iterable[Tensor] | None = None,
    points: PointCloud | None = None,
) -> None:
    """Write a set as COLMAP has it: PNG files in images/ and a text model of PINHOLE cameras in sparse/0.

    A list of the pictures held out goes beside the model as test.txt.
    """
    root = make_folder(folder)
    listing = _write_pictures(root, views, test, alphas)
    list_colmap(root, listing, points)


def list_transforms(
    folder: Path, listing: Listing, points: PointCloud | None, *, more: Mapping[str, Any] | None = None
) -> list[Path]:
    """Write the transforms files of pictures that are in images/, and the points.

    The file for tests is left out if there are none.
    """
    written = []
    if points is not None:
        save_points(points, folder / POINTS[0])
        written.append(folder / POINTS[0])
    for split, entries in listing.items():
        if entries:
            document = {**(more or {}), **_document(entries, points is not None)}
            save_json(document, folder / PARTS[split], indent=1)
            written.append(folder / PARTS[split])
    return written


def list_colmap(folder: Path, listing: Listing, points: PointCloud | None) -> list[Path]:
    """Write the text model of pictures that are in images/."""
    model = make_folder(folder / "sparse" / "0")
    entries = sorted((entry for part in listing.values() for entry in part), key=lambda entry: entry[0])
    lenses: dict[str, int] = {}
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of 2D points"]
    for number, (name, camera) in enumerate(entries, start=1):
        lens = f"PINHOLE {camera.width} {camera.height} {_digits(camera.fx, camera.fy, camera.cx, camera.cy)}"
        pose = camera.to_camera
        values = [*from_matrix(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()]
        images += [f"{number} {_digits(*values)} {lenses.setdefault(lens, len(lenses) + 1)} {name}", ""]
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY", *(f"{i} {lens}" for lens, i in lenses.items())]
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": _point_lines(points)}
    if listing.get("test"):
        texts[TEST_LIST] = sorted(name for name, _ in listing["test"])
    for name, lines in texts.items():
        save_text("\n".join([*lines, ""]), model / name)
    return [model / name for name in texts]


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """The folder, which is made with those above it if it is not there."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise from_os_error(os.fspath(folder), "a folder that can be made", error) from error
    return Path(folder)


def picture_name(split: str, index: int) -> str:
    """File name of a picture: the order of names is that of indices, and splits do not mix."""
    return f"{split}_{index:05d}.png"


def _write_pictures(
    root: Path, views: Iterable[View], test: Iterable[View], alphas: Iterable[Tensor] | None
) -> Listing:
    images = make_folder(root / IMAGES)
    listing: dict[str, list[tuple[str, Camera]]] = {"train": [], "test": []}
    rest = None if alphas is None else iter(alphas)
    for split, part in (("train", views), ("test", test)):
        for view in part:
            name = picture_name(split, len(listing[split]))
            save_png(_pixels(view, rest), images / name)
            listing[split].append((name, view.camera))
    if rest is not None and next(rest, None) is not None:
        raise InvalidValueError.of("alphas", "one for each view", "more", "pass one a picture")
    if not listing["train"]:
        raise InvalidValueError.of("views", "at least one", "none", "pass pictures to write")
    return listing


def _pixels(view: View, alphas: Iterator[Tensor] | None) -> NDArray[np.uint8]:
    """8-bit pixels of a view, with the next alpha if there are any."""
    if alphas is None:
        return to_bytes(view.image)
    alpha = next(alphas, None)
    wanted = (view.camera.height, view.camera.width)
    if alpha is None or tuple(alpha.shape) != wanted:
        got = "too few" if alpha is None else tuple(alpha.shape)
        raise InvalidValueError.of("alphas", f"one of shape {wanted} for each view", got, "pass one a picture")
    return to_bytes(torch.cat([view.image, alpha[..., None].to(view.image)], dim=-1))


def _document(entries: Sequence[tuple[str, Camera]], points: bool) -> dict[str, Any]:
    """The content of a transforms file; intrinsics that all cameras share are said once."""
    intrinsics = [_intrinsics(camera) for _, camera in entries]
    shared = intrinsics[0] if all(values == intrinsics[0] for values in intrinsics) else {}
    frames = [
        {
            "file_path": f"./{IMAGES}/{Path(name).stem}",  # Blender's readers append the suffix
            **({} if shared else intrinsic),
            "transform_matrix": (camera.to_world @ OPENGL).tolist(),
        }
        for (name, camera), intrinsic in zip(entries, intrinsics, strict=True)
    ]
    return {**shared, **({"ply_file_path": POINTS[0]} if points else {}), "frames": frames}


def _intrinsics(camera: Camera) -> dict[str, float]:
    """A camera's intrinsics under the names of both families of readers."""
    angles = {
        "camera_angle_x": angle_of(camera.fx, camera.width),
        "camera_angle_y": angle_of(camera.fy, camera.height),
    }
    pixels = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return {**angles, **pixels, "w": camera.width, "h": camera.height}


def _point_lines(points: PointCloud | None) -> list[str]:
    lines = ["# POINT3D_ID X Y Z R G B ERROR, then a track, which is empty"]
    if points is not None:
        rows = zip(points.points.tolist(), to_bytes(points.colours).tolist(), strict=True)
        lines += [f"{i} {_digits(*xyz)} {r} {g} {b} 0" for i, (xyz, (r, g, b)) in enumerate(rows, start=1)]
    return lines


def _digits(*values: float) -> str:
    """Numbers in the fewest digits that give the same float64 again."""
    return " ".join(repr(float(value)) for value in values)
