"""Writers of the files that list an image set: transforms files with OpenGL's camera
axes, and COLMAP's text model.

They are made from names and cameras alone, and appear whole or not at all, so a set is
listed when its images are there.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import angle_of
from mi_splat.datasets.colmap import TEST_LIST
from mi_splat.datasets.folders import IMAGES as IMAGES
from mi_splat.datasets.folders import MASKS as MASKS
from mi_splat.datasets.transforms import OPENGL, PARTS, POINTS, SINGLE
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.errors import from_os_error
from mi_splat.io.points import PointCloud, save_points, to_bytes
from mi_splat.maths.rotation import from_matrix

Listing = Mapping[str, Sequence[tuple[str, Camera]]]
"""Of each split, train and test, the file name of every image and its camera."""


def list_transforms(
    folder: Path,
    listing: Listing,
    points: PointCloud | None,
    *,
    is_single: bool = False,
) -> list[Path]:
    """Write the transforms files of images that are in images/, and the points.

    The file for tests is left out if there are none. With `is_single` it is one file
    for all images, which lists the names of both splits, as nerfstudio's does.
    """
    written = []
    if points is not None:
        save_points(points, folder / POINTS[0])
        written.append(folder / POINTS[0])
    if is_single:
        every = sorted(
            (entry for part in listing.values() for entry in part),
            key=lambda entry: entry[0],
        )
        lists = {
            f"{split}_filenames": [_place(name) for name, _ in listing.get(split, ())]
            for split in PARTS
        }
        document = {**lists, **_document(every, points is not None)}
        save_json(document, folder / SINGLE, indent=1)
        return [*written, folder / SINGLE]
    for split, entries in listing.items():
        if entries:
            save_json(
                _document(entries, points is not None), folder / PARTS[split], indent=1
            )
            written.append(folder / PARTS[split])
    return written


def list_colmap(
    folder: Path, listing: Listing, points: PointCloud | None
) -> list[Path]:
    """Write the text model of images that are in images/."""
    model = make_folder(folder / "sparse" / "0")
    entries = sorted(
        (entry for part in listing.values() for entry in part),
        key=lambda entry: entry[0],
    )
    lenses: dict[str, int] = {}
    images = [
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of 2D points"
    ]
    for number, (name, camera) in enumerate(entries, start=1):
        lens = (
            f"PINHOLE {camera.width} {camera.height}"
            f" {_digits(camera.fx, camera.fy, camera.cx, camera.cy)}"
        )
        pose = camera.to_camera
        values = [*from_matrix(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()]
        images += [
            (
                f"{number} {_digits(*values)}"
                f" {lenses.setdefault(lens, len(lenses) + 1)} {name}"
            ),
            "",
        ]
    cameras = [
        "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY",
        *(f"{i} {lens}" for lens, i in lenses.items()),
    ]
    texts = {
        "cameras.txt": cameras,
        "images.txt": images,
        "points3D.txt": _point_lines(points),
    }
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
        raise from_os_error(
            os.fspath(folder), "a folder that can be made", error
        ) from error
    return Path(folder)


def picture_name(split: str, index: int) -> str:
    """File name of an image: the order of names is that of indices, and splits do not
    mix.
    """
    return f"{split}_{index:05d}.png"


def _document(entries: Sequence[tuple[str, Camera]], points: bool) -> dict[str, Any]:
    """The content of a transforms file; intrinsics that all cameras share are said
    once.
    """
    intrinsics = [_intrinsics(camera) for _, camera in entries]
    if all(values == intrinsics[0] for values in intrinsics):
        shared = intrinsics[0]
    else:
        shared = {}
    frames = [
        {
            "file_path": _place(name),
            **({} if shared else intrinsic),
            "transform_matrix": (camera.to_world @ OPENGL).tolist(),
        }
        for (name, camera), intrinsic in zip(entries, intrinsics, strict=True)
    ]
    return {
        **shared,
        **({"ply_file_path": POINTS[0]} if points else {}),
        "frames": frames,
    }


def _place(name: str) -> str:
    """An image as the transforms files name it; Blender's readers append .png."""
    return f"./{IMAGES}/{name.removesuffix('.png')}"


def _intrinsics(camera: Camera) -> dict[str, float | str]:
    """A camera's intrinsics under the names of both families of readers."""
    lens = camera.lens
    across, down = lens.scale
    pixels: dict[str, float | str] = {
        "fl_x": across,
        "fl_y": down,
        "cx": lens.cx,
        "cy": lens.cy,
        "w": camera.width,
        "h": camera.height,
    }
    if not lens.is_perspective:
        return {"camera_model": lens.projection.upper(), **pixels}
    return {
        "camera_angle_x": angle_of(across, camera.width),
        "camera_angle_y": angle_of(down, camera.height),
        **pixels,
    }


def _point_lines(points: PointCloud | None) -> list[str]:
    lines = ["# POINT3D_ID X Y Z R G B ERROR, then a track, which is empty"]
    if points is not None:
        rows = zip(
            points.points.tolist(), to_bytes(points.colours).tolist(), strict=True
        )
        lines += [
            f"{i} {_digits(*xyz)} {r} {g} {b} 0"
            for i, (xyz, (r, g, b)) in enumerate(rows, start=1)
        ]
    return lines


def _digits(*values: float) -> str:
    """Numbers in the fewest digits that give the same float64 again."""
    return " ".join(repr(float(value)) for value in values)
