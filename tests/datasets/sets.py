"""A small set of noisy images, and writers of it, for the tests of both formats."""

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import PointCloud
from mi_splat.datasets.writing import (
    IMAGES,
    MASKS,
    list_colmap,
    list_transforms,
    make_folder,
    picture_name,
)
from mi_splat.io.documents import save_png
from mi_splat.io.points import to_bytes
from mi_splat.maths.rotation import from_matrix


def write_set(
    write_list: Callable[..., object],
    folder: Path,
    views: Iterable[View],
    *,
    test: Iterable[View] = (),
    alphas: Sequence[Tensor] | None = None,
    masks: Sequence[Tensor | None] = (),
    points: PointCloud | None = None,
) -> None:
    """Write PNG files of views, and the files that list them."""
    images = make_folder(folder / IMAGES)
    listing = dict[str, list[tuple[str, Camera]]]()
    rest = iter(alphas or ())
    for split, part in (("train", views), ("test", test)):
        listing[split] = []
        for shot in part:
            if alphas is None:
                image = shot.image
            else:
                image = torch.cat([shot.image, next(rest)[..., None]], -1)
            name = picture_name(split, len(listing[split]))
            save_png(to_bytes(image), images / name)
            listing[split].append((name, shot.camera))
    for (name, _), mask in zip(
        (*listing["train"], *listing["test"]), masks, strict=False
    ):
        if mask is not None:
            save_png(to_bytes(mask), make_folder(folder / MASKS) / name)
    write_list(folder, listing, points)


write_transforms = partial(write_set, list_transforms)
write_colmap = partial(write_set, list_colmap)
FORMATS: dict[str, Callable[..., None]] = {
    "transforms": write_transforms,
    "colmap": write_colmap,
}


PROBES = torch.tensor(
    [[0.3, -0.2, 0.1], [-0.4, 0.5, 0.2], [0.0, 0.1, 0.9]], dtype=torch.float64
)


CLOUD = PointCloud(
    torch.randn(50, 3, generator=torch.Generator().manual_seed(3)),
    torch.arange(150).reshape(50, 3) / 255,
)


def view(seed: int, **change: Any) -> View:
    """A noisy image from a camera by chance, with pixels that are not square and a
    centre that is off.
    """
    chance = np.random.default_rng(seed)
    pose = look_at((3 + chance.random(3)).tolist(), chance.normal(0, 0.2, 3).tolist())
    pose = change.pop("to_world", pose)
    size = (change.pop("width", 18), change.pop("height", 13))
    values = {"focal": (21.3, 19.7), "size": size, "principal": (8.25, 7.75), **change}
    camera = Camera(to_world=pose, lens=Lens(**values))
    bytes_ = chance.integers(0, 256, (camera.height, camera.width, 3))
    return View(camera, torch.from_numpy(bytes_.astype(np.float32) / np.float32(255)))


VIEWS = [view(seed) for seed in range(6)]
TESTS = [view(seed) for seed in range(6, 8)]


def assert_same_camera(read: Camera, wanted: Camera, tolerance: float) -> None:
    assert (read.width, read.height) == (wanted.width, wanted.height)
    numbers = [
        [camera.fx, camera.fy, camera.cx, camera.cy] for camera in (read, wanted)
    ]
    assert numbers[0] == pytest.approx(numbers[1], abs=tolerance)
    torch.testing.assert_close(read.to_world, wanted.to_world, atol=tolerance, rtol=0)
    there = project_points(PROBES, read)[0]
    back = project_points(PROBES, wanted)[0]
    torch.testing.assert_close(there, back, atol=100 * tolerance, rtol=0)


def colmap_binary(folder: Path, views: list[View], cloud: PointCloud) -> Path:
    """Write a model as COLMAP does, with 2D points and tracks; returns its folder."""
    model = folder / "sparse" / "0"
    images = folder / "images"
    model.mkdir(parents=True)
    images.mkdir()
    camera = views[0].camera
    simple = struct.pack("<iiQQ3d", 7, 0, camera.width, camera.height, 20.0, 9.0, 6.5)
    full = struct.pack(
        "<iiQQ4d",
        3,
        1,
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
    )
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + simple + full)
    records = []
    for i, shot in enumerate(views):
        pose = shot.camera.to_camera
        # either sign is the same rotation
        values = [*(-from_matrix(pose[:3, :3])).tolist(), *pose[:3, 3].tolist()]
        points = b"".join(struct.pack("<ddq", 1.0, 2.0, -1) for _ in range(i))
        name = f"part/view {i}.png"
        records.append(
            struct.pack("<i7di", i + 1, *values, 3 if i else 7) + f"{name}\0".encode()
        )
        records[-1] += struct.pack("<Q", i) + points
        (images / name).parent.mkdir(exist_ok=True)
        Image.fromarray((shot.image.numpy() * 255 + 0.5).astype(np.uint8)).save(
            images / name
        )
    (model / "images.bin").write_bytes(
        struct.pack("<Q", len(views)) + b"".join(records)
    )
    rows = zip(
        cloud.points.double().tolist(),
        (cloud.colours * 255).round().int().tolist(),
        strict=True,
    )
    data = [
        struct.pack("<Q3d3BdQ", i, *p, *c, 0.5, 2) + struct.pack("<4i", 1, 0, 2, 0)
        for i, (p, c) in enumerate(rows)
    ]
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(data)) + b"".join(data))
    return model


LENSES: dict[str, tuple[list[float], tuple[int, int], list[float]]] = {
    "SIMPLE_RADIAL": (
        [150.0, 80.3, 60.1, -0.12],
        (165, 121),
        [150.0, 150.0, 82.809375, 60.60083333333333],
    ),
    "RADIAL": (
        [150.0, 80.3, 60.1, 0.12, -0.03],
        (152, 114),
        [150.0, 150.0, 76.285, 57.095],
    ),
    "OPENCV": (
        [150.0, 140.0, 80.3, 60.1, -0.2, 0.05, 0.003, -0.002],
        (168, 124),
        [150.0, 140.0, 84.315, 62.10333333333333],
    ),
    "FULL_OPENCV": (
        [150.0, 140.0, 80.3, 60.1, 0.4, -0.1, 0.003, -0.002, 0.02, 0.3, -0.05, 0.03],
        (153, 115),
        [150.0, 140.0, 76.786875, 57.59583333333333],
    ),
    "OPENCV_FISHEYE": (
        [90.0, 95.0, 80.3, 60.1, 0.02, -0.01, 0.003, -0.001],
        (215, 136),
        [90.0, 95.0, 107.903125, 68.11333333333333],
    ),
    "FISHEYE": (
        [90.0, 95.0, 80.3, 60.1],
        (219, 137),
        [90.0, 95.0, 109.91062500000001, 68.61416666666668],
    ),
}
"""COLMAP's parameters of images of 160 x 120, and what COLMAP 4.2.1 undistorts them to:
size, and fx, fy, cx, cy.
"""


def lens_set(
    folder: Path,
    model: str,
    parameters: list[float],
    pixels: np.ndarray[Any, Any],
    count: int = 1,
) -> None:
    """Write a text model with images of one lens."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (folder / "images").mkdir()
    words = " ".join(map(repr, parameters))
    (sparse / "cameras.txt").write_text(
        f"1 {model} {pixels.shape[1]} {pixels.shape[0]} {words}\n"
    )
    names = [f"{number}.png" for number in range(count)]
    (sparse / "images.txt").write_text(
        "".join(f"{i} 1 0 0 0 0 0 {i} 1 {n}\n\n" for i, n in enumerate(names, 1))
    )
    for name in names:
        Image.fromarray(pixels).save(folder / "images" / name)


def ramps() -> np.ndarray[Any, Any]:
    """Bytes (120, 160, 3) in which red is the column and green is the row: they say
    where a pixel comes from.
    """
    rows, columns = np.mgrid[:120, :160]
    return np.stack([columns, rows, 255 + 0 * rows], -1).astype(np.uint8)
