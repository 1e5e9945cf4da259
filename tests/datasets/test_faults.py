"""What is wrong with an image set is said in one line that names the file."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_splat.datasets import DatasetError, load_dataset
from mi_splat.datasets.writing import make_folder
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import load_splat
from tests.datasets.sets import (
    CLOUD,
    VIEWS,
    colmap_binary,
    write_colmap,
    write_transforms,
)

Harm = Callable[[Path], object]


def edit(change: Callable[[dict[str, Any]], object]) -> Harm:
    """A change of the transforms file."""

    def harm(folder: Path) -> None:
        file = folder / "transforms_train.json"
        document = json.loads(file.read_text())
        change(document)
        file.write_text(json.dumps(document))

    return harm


def rewrite(name: str, change: Callable[[bytes], bytes]) -> Harm:
    """A change of the bytes of a file."""
    return lambda folder: (folder / name).write_bytes(
        change((folder / name).read_bytes())
    )


def pose(values: object) -> Harm:
    """Another matrix for the second frame."""
    return edit(lambda document: document["frames"][1].update(transform_matrix=values))


def entry(**values: object) -> Harm:
    """Other values for the whole file."""
    return edit(lambda document: document.update(values))


PICTURE = "images/train_00001.png"
SINGULAR = np.diag([1.0, 1.0, 0.0, 1.0]).tolist()

COMMON: dict[str, tuple[Harm, str]] = {
    "few images": (
        lambda folder: [*map(Path.unlink, (folder / "images").glob("*_0000[135].png"))],
        r"3 of 6 images missing \(train_00001.*, \.\.\.\); put them there",
    ),
    "another size": (
        lambda folder: Image.new("RGB", (5, 5)).save(folder / PICTURE),
        r"00001\.png: expected 18 x 13.*5 x 5",
    ),
    "16 bits": (
        lambda f: Image.fromarray(np.zeros((13, 18), np.uint16)).save(f / PICTURE),
        r"00001\.png.*8 bits",
    ),
    "no image inside": (
        rewrite(PICTURE, lambda data: b"hello"),
        r"train_00001\.png: expected an image",
    ),
}

TRANSFORMS: dict[str, tuple[Harm, str]] = {
    **COMMON,
    "broken JSON": (
        rewrite("transforms_train.json", lambda data: data[:-30]),
        r"transforms_train\.json: expected JSON",
    ),
    "nested JSON": (
        rewrite("transforms_train.json", lambda data: b"[" * 100_000),
        r"train\.json: expected at most 64 levels",
    ),
    "no frames": (entry(frames=None), "list of frames"),
    "an empty set": (entry(frames=[]), "at least one frame"),
    "a frame that is none": (
        edit(lambda d: d["frames"].append(3)),
        "frame 6: expected an object",
    ),
    "doubled": (
        edit(lambda d: d["frames"].append(d["frames"][0])),
        r"train_00000\.png twice",
    ),
    "singular pose": (pose(SINGULAR), r"frame 1 .*train_00001.*to_world"),
    "NaN pose": (
        pose(np.full((4, 4), np.nan).tolist()),
        r"frames/1/transform_matrix/0/0: expected a finite number",
    ),
    "scaled pose": (pose((2 * np.eye(4)).tolist()), r"frame 1 .*remove scale"),
    "no pose": (pose(None), r"frame 1 .*matrix of numbers"),
    "no focal length": (
        edit(lambda d: [d.pop(k) for k in [*d] if k[:3] in ("fl_", "cam")]),
        "fl_x or camera_angle_x",
    ),
    "angle in degrees": (
        edit(lambda d: (d.pop("fl_x"), d.update(camera_angle_x=45.0))),
        "between 0 and pi",
    ),
    "a focal length in words": (entry(fl_x="wide"), "fl_x: expected a finite number"),
    "half a pixel": (entry(w=18.5), "integers"),
    "another size in the file": (
        entry(w=36, h=26),
        r"00000\.png: expected 36 x 26 pixels, got 18 x 13",
    ),
    "a fourth coefficient": (
        entry(k1=0.1, k4=0.1),
        "k1, k2, p1, p2, k3 of OPENCV, got k4; name the camera_model FULL",
    ),
    "endless distortion": (entry(k1=1e9), r"frame 0 .*coefficients up to 1e\+06"),
    "a lens that folds": (entry(k1=-50), "a lens that can be undone"),
    "a panorama": (
        entry(camera_model="EQUIRECTANGULAR"),
        "got EQUIRECTANGULAR; cut the panoramas .*ns-process-data",
    ),
    "a lens of another program": (
        entry(camera_model="FOV"),
        "got FOV; find the cameras again.*mi-splat prepare",
    ),
    "a mask from elsewhere": (
        edit(lambda d: d["frames"][0].update(mask_path="/etc/hosts")),
        "mask_path: .*in the set",
    ),
    "a mask of another size": (
        lambda f: Image.new("L", (9, 9)).save(
            make_folder(f / "masks") / "train_00000.png"
        ),
        "a mask of 18 x 13 pixels, got 9 x 9",
    ),
    "an image from elsewhere": (
        edit(lambda d: d["frames"][0].update(file_path="../../x")),
        "a file in the set",
    ),
    "an image of the system": (
        edit(lambda d: d["frames"][0].update(file_path="/etc/passwd")),
        "a file in the set",
    ),
    "points from elsewhere": (
        entry(ply_file_path="/x.ply"),
        "ply_file_path: expected the name of a file in the set",
    ),
    "an endless name": (
        edit(lambda d: d["frames"][0].update(file_path="x" * 5000)),
        "5000 characters",
    ),
    "truncated points": (
        rewrite("points3D.ply", lambda data: data[:-1]),
        r"points3D\.ply.*truncated",
    ),
}


@pytest.mark.parametrize(("harm", "says"), TRANSFORMS.values(), ids=TRANSFORMS)
def test_transforms(harm: Harm, says: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS, points=CLOUD)
    harm(tmp_path)
    with pytest.raises(MiSplatError, match=says):
        load_dataset(tmp_path)


MODEL = "sparse/0/"


def replace(name: str, old: str, new: str) -> Harm:
    """Other text in a file of the model."""
    return rewrite(MODEL + name, lambda data: data.replace(old.encode(), new.encode()))


TEXT: dict[str, tuple[Harm, str]] = {
    **COMMON,
    "a lens of NaN": (
        rewrite(MODEL + "cameras.txt", lambda data: b"1 RADIAL 18 13 20 9 6 nan 0\n"),
        "camera 1: distortion: expected coefficients",
    ),
    "a lens of the view": (
        rewrite(MODEL + "cameras.txt", lambda data: b"1 FOV 18 13 20 20 9 6 0.1\n"),
        (
            r"got FOV; pip install pycolmap,"
            r" .*pycolmap\.undistort_images\('undistorted', '.*sparse/0', '.*images'\)"
        ),
    ),
    "panoramas": (
        rewrite(MODEL + "cameras.txt", lambda data: b"1 EQUIRECTANGULAR 18 13 18 13\n"),
        "got EQUIRECTANGULAR; cut the panoramas",
    ),
    "a lens without focal length": (
        rewrite(MODEL + "cameras.txt", lambda data: b"1 RADIAL 18 13 0 9 6 0 0\n"),
        "focal",
    ),
    "an image from elsewhere": (
        replace("images.txt", "train_00001", "../x"),
        "a file in the set",
    ),
    "unknown model": (
        replace("cameras.txt", "PINHOLE", "CAMERA"),
        "camera 1: expected a camera model.*; undistort",
    ),
    "too few parameters": (
        replace("cameras.txt", " 7.75", ""),
        "4 parameters of PINHOLE",
    ),
    "words": (
        replace("cameras.txt", "18 13", "wide 13"),
        r"cameras\.txt, line 2: .*'1 PINHOLE wide",
    ),
    "no images": (
        lambda folder: (folder / MODEL / "images.txt").unlink(),
        r"images\.txt.*no such file",
    ),
    "an empty set": (
        rewrite(MODEL + "images.txt", lambda data: b"# nothing\n"),
        "at least one image, got none",
    ),
    "doubled name": (
        replace("images.txt", "train_00002", "train_00001"),
        r"train_00001\.png twice",
    ),
    "no lines of points": (
        replace("images.txt", "png\n\n", "png\n"),
        r"images\.txt, line 3: expected a line of 2D points",
    ),
    "zero quaternion": (
        rewrite(
            MODEL + "images.txt", lambda data: b"1 0 0 0 0 0 0 0 1 train_00001.png\n"
        ),
        "a quaternion",
    ),
    "short": (
        rewrite(MODEL + "images.txt", lambda data: b"1 1 0 0 0 0 0 0 1\n"),
        "line 1: expected IMAGE_ID",
    ),
    "no UTF-8": (
        rewrite(MODEL + "images.txt", lambda data: b"\xff" + data),
        r"images\.txt: expected text",
    ),
    "bad points": (
        rewrite(MODEL + "points3D.txt", lambda data: data + b"7 0 0 0 300 0 0 0\n"),
        r"points3D\.txt: colours",
    ),
}


@pytest.mark.parametrize(("harm", "says"), TEXT.values(), ids=TEXT)
def test_text_models(harm: Harm, says: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS, points=CLOUD)
    harm(tmp_path)
    with pytest.raises(MiSplatError, match=says):
        load_dataset(tmp_path, split=None)


def splice(name: str, at: int, form: str, *values: float) -> Harm:
    """Other values at a place of a binary file."""
    data = struct.pack(form, *values)
    return rewrite(
        MODEL + name,
        lambda old: old[:at] + data + (old[at + len(data) :] if at else b""),
    )


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize(
    "change",
    [
        lambda data: b"",
        lambda data: data[:5],
        lambda data: data[:-1],
        lambda data: data + b"\0",
        lambda data: struct.pack("<Q", 1 << 60) + data[8:],
        lambda data: struct.pack("<Q", 1) + data[8:],
    ],
    ids=["empty", "start", "truncated", "appended", "huge count", "small count"],
)
def test_binary_sizes(
    name: str, change: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    colmap_binary(tmp_path, VIEWS, CLOUD)
    rewrite(MODEL + name, change)(tmp_path)
    with pytest.raises(
        DatasetError, match=rf"{name}.* bytes; it is truncated or no COLMAP file"
    ):
        load_dataset(tmp_path)


BINARY: dict[str, tuple[Harm, str]] = {
    "distortion": (splice("cameras.bin", 12, "<i", 3), "cameras.bin"),
    "unknown model": (splice("cameras.bin", 12, "<i", 99), "number 99; undistort"),
    "panoramas": (splice("cameras.bin", 12, "<i", 17), "cameras.bin"),
    "doubled camera": (splice("cameras.bin", 56, "<i", 7), "7 twice"),
    "NaN": (splice("images.bin", 12, "<d", float("nan")), "a quaternion"),
    "no such camera": (splice("images.bin", 68, "<i", 9), "a camera 9"),
    "endless name": (
        rewrite(MODEL + "images.bin", lambda d: d[:80] + b"x" * (len(d) - 80)),
        "truncated",
    ),
    "many 2D points": (splice("images.bin", 88, "<Q", 1 << 62), "truncated"),
    "long track": (splice("points3D.bin", 51, "<Q", 1 << 61), "more records"),
}


@pytest.mark.parametrize(("harm", "says"), BINARY.values(), ids=BINARY)
def test_binary_values(harm: Harm, says: str, tmp_path: Path) -> None:
    colmap_binary(tmp_path, VIEWS, CLOUD)
    harm(tmp_path)
    with pytest.raises(MiSplatError, match=says):
        load_dataset(tmp_path, split=None)


def test_folders_that_are_no_set(tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match="none of these; pass the folder of a data set"
    ):
        load_dataset(tmp_path)
    Image.new("RGB", (5, 5)).save(tmp_path / "photo.JPG", "JPEG")
    for read in (load_dataset, load_splat):
        with pytest.raises(
            MiSplatError,
            match=(
                r"find the cameras of the photographs first, with `mi-splat prepare .*"
                r" --out SET`"
            ),
        ):
            read(tmp_path)
    with pytest.raises(DatasetError, match="no such folder"):
        load_dataset(tmp_path / "nowhere")
    write_transforms(tmp_path, VIEWS[:1])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"downscale": 0}, "downscale"),
        ({"downscale": 1.5}, "downscale"),
        ({"downscale": 100}, "size: expected a number in"),
        ({"background": (0.0, 2.0, 0.0)}, "background"),
        ({"split": "val"}, "split"),
        ({"test_every": 1}, "test_every"),
    ],
)
def test_arguments(words: dict[str, Any], says: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    with pytest.raises(InvalidValueError, match=says):
        load_dataset(tmp_path, **words)
