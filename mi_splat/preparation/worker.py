"""What a child process does for `mi-splat prepare`: it reads a video, or finds cameras
with COLMAP.

Both are large libraries of C++ that may end the whole process, on a damaged video for
instance. A task comes as one JSON text in the arguments; progress and the result go to
stdout, a JSON text a line: [text, done, total], and at the end an object.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ALL_PAIRS = 100
"""Images up to which each is matched with every other one, unless they come from a
video.
"""
NEIGHBOURS = 10
"""Of a video or of many images, each is matched with so many after it."""
ANCHORS = 40
"""And so many of them, evenly spread, with each other: they find where the way comes
back to.
"""

FEWEST_IMAGES = 3
"""Of a model."""
FEWEST_POINTS = 30
"""Of the model that an image has to show.

COLMAP places none with fewer, but may take some away later.
"""
_FOCAL = 1.2
"""Focal length in longest sides, where the camera has not written it; COLMAP's
default.
"""
_CHUNK = 8
_PAIRS_AT_ONCE = 100
_SEED = 0

MOST_SECONDS = 1800.0
"""Of the longest video that is read."""
CANDIDATES = 5
"""Frames of an interval of which the sharpest is taken."""
MOST_FRAMES = 600_000
"""Frames of a video that are looked at, whatever it says of its length."""
_SAFE = "protocol_whitelist;file|format_whitelist;mov,matroska,avi"
"""FFmpeg reads only files, and only of these kinds: playlists and the like lead to
other files.
"""

Report = Callable[[str, int, int], None]


class TaskRefusedError(Exception):
    """What the parent process is to say: what was expected, what came, what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Named:
    """An image of the set."""

    name: str
    size: tuple[int, int]
    focal: float | None


# COLMAP


def place(
    root: Path,
    images: Sequence[Named],
    in_order: bool,
    features: int,
    masks: Path | None,
    report: Report,
) -> dict[str, Any]:
    """Find the cameras of the images, and write the largest model, turned so that z is
    up, into sparse/0.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(_SEED)
    database = root / "colmap" / "database.db"
    database.parent.mkdir()
    _extract(database, root / "images", images, features, masks, report)
    _match(database, images, pairs_of(len(images), in_order=in_order), report)
    features_found, overlaps = _statistics(database)
    models = _trimmed(_map(database, root / "images", len(images), report))
    points: dict[str, int] = {}
    if models:
        points = {image.name: image.num_points3D for image in _placed(models[0])}
        _turn_up(models[0])
        target = root / "sparse" / "0"
        target.mkdir(parents=True)
        models[0].write_binary(str(target))
    return {
        "models": [model.num_reg_images() for model in models],
        "error": float(models[0].compute_mean_reprojection_error()) if models else 0.0,
        "points3D": models[0].num_points3D() if models else 0,
        "features": features_found,
        "overlaps": overlaps,
        "points": points,
        "made_by": f"pycolmap {pycolmap.__version__}",
    }


def pairs_of(count: int, *, in_order: bool) -> list[tuple[int, int]]:
    """Which images are matched with which, by their numbers."""
    if count <= ALL_PAIRS and not in_order:
        return list(itertools.combinations(range(count), 2))
    near = {
        (i, j)
        for i in range(count)
        for j in range(i + 1, min(i + NEIGHBOURS + 1, count))
    }
    return sorted(
        near.union(itertools.combinations(range(0, count, -(-count // ANCHORS)), 2))
    )


def _extract(
    database: Path,
    folder: Path,
    images: Sequence[Named],
    features: int,
    masks: Path | None,
    report: Report,
) -> None:
    """Find the features of all images; those of one size and focal length have one
    camera.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(
        max_image_size=max(max(image.size) for image in images)
    )
    options.sift.max_num_features = features
    done = 0
    cameras: dict[tuple[tuple[int, int], float | None], list[str]] = {}
    for image in images:
        cameras.setdefault((image.size, image.focal), []).append(image.name)
    for (size, focal), names in cameras.items():
        # A focal length and one coefficient: few photographs tell more of a lens.
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL",
            width=size[0],
            height=size[1],
            params=[focal or _FOCAL * max(size), size[0] / 2, size[1] / 2, 0.0],
            has_prior_focal_length=focal is not None,
        )
        with pycolmap.Database.open(str(database)) as opened:
            number = opened.write_camera(camera)
        reading = pycolmap.ImageReaderOptions(existing_camera_id=number)
        if masks is not None:
            reading.mask_path = str(
                _whole_masks(masks, database.with_name("masks"), images)
            )
        for start in range(0, len(names), _CHUNK):
            report("finding features", done, len(images))
            chunk = names[start : start + _CHUNK]
            pycolmap.extract_features(
                database_path=str(database),
                image_path=str(folder),
                image_names=chunk,
                reader_options=reading,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(chunk)


def _whole_masks(masks: Path, folder: Path, images: Sequence[Named]) -> Path:
    """A folder with a mask for each image, as COLMAP finds no features in an image
    without one.
    """
    if folder.is_dir():
        return folder
    folder.mkdir()
    for image in images:
        name = f"{image.name}.png"
        if (masks / name).is_file():
            shutil.copyfile(masks / name, folder / name)
        else:
            Image.new("L", image.size, 255).save(folder / name)
    return folder


def _match(
    database: Path,
    images: Sequence[Named],
    pairs: Sequence[tuple[int, int]],
    report: Report,
) -> None:
    import pycolmap

    listed = database.with_name("pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        report("matching pairs of images", start, len(pairs))
        chunk = pairs[start : start + _PAIRS_AT_ONCE]
        listed.write_text(
            "".join(f"{images[i].name} {images[j].name}\n" for i, j in chunk), "utf-8"
        )
        pycolmap.match_image_pairs(
            database_path=str(database),
            pairing_options=pycolmap.ImportedPairingOptions(
                match_list_path=str(listed)
            ),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def _statistics(database: Path) -> tuple[dict[str, int], dict[str, int]]:
    """Features of each image, and with how many others it overlaps, by its name."""
    import pycolmap

    with pycolmap.Database.open(str(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {
            name: opened.num_keypoints_for_image(number)
            for number, name in names.items()
        }
        overlaps = dict.fromkeys(features, 0)
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
        for pair, count in zip(pairs, inliers, strict=True):
            if count:
                for number in (
                    pycolmap.pair_id_to_image_pair(pair)
                    if isinstance(pair, int)
                    else pair
                ):
                    overlaps[names[number]] += 1
    return features, overlaps


def _map(database: Path, folder: Path, count: int, report: Report) -> list[Any]:
    import pycolmap

    placed = itertools.count(2)

    def one_more() -> None:
        report("placing cameras", min(next(placed), count), count)

    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=FEWEST_IMAGES, random_seed=_SEED
    )
    output = database.with_name("models")
    output.mkdir()
    models: dict[int, Any] = pycolmap.incremental_mapping(
        database_path=str(database),
        image_path=str(folder),
        output_path=str(output),
        options=options,
        initial_image_pair_callback=one_more,
        next_image_callback=one_more,
    )
    return list(models.values())


def _trimmed(models: Sequence[Any]) -> list[Any]:
    """Models without the images that show too few points, the largest first; those with
    too few images are gone.
    """
    for model in models:
        few = [
            image.frame_id
            for image in _placed(model)
            if image.num_points3D < FEWEST_POINTS
        ]
        for frame in few:
            model.deregister_frame(frame)
    whole = [model for model in models if model.num_reg_images() >= FEWEST_IMAGES]
    return sorted(whole, key=lambda model: -model.num_reg_images())


def _placed(model: Any) -> list[Any]:
    return [image for image in model.images.values() if image.has_pose]


def up_of(turns: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """(3,) where up is, as people hold cameras: across the rights of all cameras, on
    the side of their ups.

    Where cameras were all turned alike, or held on their side, it is the mean of the
    ups.

    Args:
        turns: (N, 3, 3) rotations from camera space, x right and y down, to the world.
    """
    rights = turns[:, :, 0]
    mean = -turns[:, :, 1].mean(0)
    squares, axes = np.linalg.eigh(rights.T @ rights / len(rights))
    axis = axes[:, 0] * (1.0 if axes[:, 0] @ mean >= 0 else -1.0)
    agrees = axis @ mean > 0.5 * np.linalg.norm(mean)
    up = axis if agrees and squares[1] > 1e-3 else mean
    return np.asarray(up / np.linalg.norm(up))


def _turn_up(model: Any) -> None:
    import pycolmap
    import torch

    from mi_splat.maths.rotation import from_z

    turns = np.stack(
        [image.cam_from_world().rotation.matrix().T for image in _placed(model)]
    )
    rotation = from_z(torch.from_numpy(up_of(turns))).T.numpy()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))


# Videos


def take_frames(
    video: Path,
    images: Path,
    longest_side: int,
    interval: float,
    most: int,
    report: Report,
) -> dict[str, Any]:
    """Write the sharpest frame of each interval of a video, upright; their names, sizes
    and times.
    """
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = _SAFE
    import cv2

    from mi_splat.io.images import save_picture
    from mi_splat.io.picture_files import check_pixels

    capture = cv2.VideoCapture(str(video.absolute()), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise TaskRefusedError(
            "a video that FFmpeg can read", "another file", "save it as MP4"
        )
    width, height = (
        int(capture.get(key))
        for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    )
    check_pixels(str(video), width, height)
    rate = capture.get(cv2.CAP_PROP_FPS)
    rate = rate if 0.1 <= rate <= 1000 else 30.0
    length = max(capture.get(cv2.CAP_PROP_FRAME_COUNT), 0.0) / rate
    if length > MOST_SECONDS:
        raise TaskRefusedError(
            f"a video of at most {MOST_SECONDS:.0f} seconds", f"{length:.0f}", "cut it"
        )
    interval = max(interval, length / most)
    step = max(1, round(interval * rate / CANDIDATES))
    best: tuple[float, float, Any] | None = None
    taken: list[dict[str, Any]] = []

    def keep() -> None:
        if best is None or len(taken) >= most:
            return
        _, second, frame = best
        image = Image.fromarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
        image.thumbnail((longest_side,) * 2, Image.Resampling.LANCZOS)
        name = f"frame_{len(taken):05d}.jpg"
        save_picture(np.asarray(image), images / name)
        taken.append(
            {"name": name, "source": f"{second:.1f} s", "size": list(image.size)}
        )

    part = 0
    for number in range(MOST_FRAMES):
        if not capture.grab() or number / rate > MOST_SECONDS:
            break
        if number % step:
            continue
        is_read, frame = capture.retrieve()
        second = number / rate
        if not is_read:
            continue
        if int(second / interval) > part:
            keep()
            best = None
            part = int(second / interval)
            report("reading the video", int(second), max(1, int(length)))
        sharp = float(
            cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), cv2.CV_32F).var()
        )
        if best is None or sharp > best[0]:
            best = (sharp, second, frame)
    keep()
    return {"images": taken}


# The process


def _task(task: Mapping[str, Any], report: Report) -> dict[str, Any]:
    root = Path(task["root"])
    if task["kind"] == "frames":
        limits = (task["longest_side"], task["interval"], task["most"])
        return take_frames(Path(task["video"]), root / "images", *limits, report)
    images = [
        Named(name=name, size=tuple(size), focal=focal)
        for name, size, focal in task["images"]
    ]
    masks = Path(task["masks"]) if task["masks"] else None
    return place(root, images, task["in_order"], task["features"], masks, report)


def _end_with_parent() -> None:
    """End this process when its standard input closes, as it does when the parent has
    gone.
    """

    def watch() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main(task: str) -> None:
    """Do one task, and write its progress and its result to stdout."""
    from mi_splat.errors import MiSplatError

    _end_with_parent()
    # COLMAP writes to the standard output of the process; the parent reads a copy of
    # it.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def answer(value: object) -> None:
        answers.write(json.dumps(value) + "\n")
        answers.flush()

    try:
        answer(
            _task(
                json.loads(task), lambda text, done, total: answer([text, done, total])
            )
        )
    except TaskRefusedError as refusal:
        answer({"refused": refusal.args})
    except MiSplatError as error:
        answer({"failed": str(error)})


if __name__ == "__main__":
    main(sys.argv[1])
