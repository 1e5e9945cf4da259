"""`mi-splat detect`: what detectors report on images, and on splats as cameras see
them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import Confidence, DetectorOptions
from mi_splat import provenance
from mi_splat.cli.console import UsageError, progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions
from mi_splat.fields import OutFolder

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.detectors.base import Detections, Detector

    Report = tuple[Mapping[str, object] | None, str, Tensor, Detections]
    """Where from, by which detector; the image, (H, W, 3) sRGB in [0, 1], and what is
    reported on it.
    """


EXAMPLES = (
    "detect photo.png YOUR.ply --cameras orbit:8@20 --out out/detect",
    "detect YOUR_PHOTOS --min-confidence 0.5 --out out/photos",
)
_SPLATS = (".ply", ".spz", ".sog", ".splat", ".glb", ".usd", ".usda", ".usdc", ".usdz")
"""Endings of splats: a folder with one of them is opened as a splat, whatever images
lie beside it.
"""
MOST_IMAGES = 1000
"""Images of one folder; each is decoded, and its boxes are drawn into a file of its
own.
"""


@dataclass(frozen=True, kw_only=True)
class DetectOptions(DetectorOptions, ResultOptions):
    """Run detectors on images, or on splats and scenes from cameras; draw the boxes and
    list them.

    Photographs are turned upright by their EXIF orientation. Writes an image with boxes
    for each image and detector, and result.json, into --out.
    """

    inputs: Positional[tuple[Path, ...]] = ()
    """Images, folders of images, splat files and scene XMLs; at least one."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """Cameras for splats and scenes."""
    min_confidence: Confidence | None = None
    """Confidence from which a detection is drawn and listed. Default: the operating
    threshold of each detector (see `mi-splat detectors`).
    """
    out: OutFolder = Path("out/detect")


def run(options: DetectOptions) -> None:
    """Detect, draw the boxes, and list them."""
    from attacks.cli.options import load_detectors
    from attacks.observe.comparison import thresholds_of
    from attacks.observe.drawing import annotated, listed
    from mi_splat.io.documents import file_name, save_json, save_png
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder

    _check_inputs(options)
    check_new_folder(options.out, force=options.force)
    rows: dict[str, dict[str, Any]] = {}
    with (
        progress("loading") as advance,
        new_folder(options.out, force=options.force) as folder,
    ):
        # Not before the first file is read and its cameras are found: a wrong name is
        # told at once.
        detectors = functools.cache(
            lambda: load_detectors(options.detectors, options.weights)
        )
        for source in _sources(options.inputs):
            advance(f"looking at {source}")
            for camera, detector, image, detections in _reports(
                source, detectors, options.view
            ):
                where = "" if camera is None else f"-{camera['name']}"
                name = file_name(f"{source.stem}{where}-{detector}")
                while name in rows:
                    name = f"{name}-{len(rows)}"
                least = options.min_confidence
                if least is None:
                    least = thresholds_of(detectors())[detector]
                items = [item for item in listed(detections) if item["score"] >= least]
                rows[name] = {
                    "source": str(source),
                    "camera": camera,
                    "detector": detector,
                    "detections": items,
                }
                rows[name] |= {
                    "size": [image.shape[1], image.shape[0]],
                    "picture": f"{name}.png",
                }
                drawn = annotated(image, detections, name, min_confidence=least)
                save_png(drawn, folder / f"{name}.png")
        document = {
            "story": "detect",
            "min_confidence": (
                thresholds_of(detectors())
                if options.min_confidence is None
                else options.min_confidence
            ),
            "view": _given(options.view),
            "fingerprints": {
                detector.name: detector.fingerprint for detector in detectors()
            },
            "pictures": list(rows.values()),
            **provenance.origin(),
        }
        save_json(document, folder / RECORD)
    lines = [f"{name}: {_reported(row) or 'nothing'}" for name, row in rows.items()]
    lines.append(f"{options.out}: {len(rows)} images with boxes, and {RECORD}")
    show_result({**document, "out": str(options.out)}, *lines, as_json=options.json)


def _reported(row: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{item['label']} {item['score']:.0%}" for item in row["detections"]
    )


def _reports(
    source: Path, detectors: Callable[[], list[Detector]], view: CameraOptions
) -> Iterator[Report]:
    import torch

    from attacks.observe.views import detect_views
    from mi_splat.cli.cameras import find_cameras, renderer_of
    from mi_splat.datasets.frames import read_picture
    from mi_splat.io.camera_records import describe
    from mi_splat.render.scene_files import open_scene

    if _is_picture(source):
        background = view.background or (0.0, 0.0, 0.0)
        image, _ = read_picture(
            source, downscale=1, background=background, upright=True
        )
        for detector in detectors():
            with torch.no_grad():
                (detections,) = detector.detect(image[None])
            yield None, detector.name, image, detections
        return
    loaded = open_scene(source)
    cameras = find_cameras(loaded, view)
    render = renderer_of(loaded, view, cameras)
    records = [describe(name, camera) for name, camera in cameras.items()]
    for seen in detect_views(
        loaded.scene, list(cameras.values()), detectors(), render=render
    ):
        yield records[seen.view], seen.detector, seen.image, seen.detections


def _sources(inputs: Sequence[Path]) -> Iterator[Path]:
    """The inputs, with the images of a folder in its place; those that cannot be read
    are named and left out.
    """
    from mi_splat.datasets import DatasetError
    from mi_splat.datasets.frames import picture_size
    from mi_splat.io.picture_files import PictureFileError

    for source in inputs:
        images = _images_in(source)
        if not images:
            yield source
            continue
        for image in images:
            try:
                picture_size(image)
            except (PictureFileError, DatasetError) as error:
                warn(f"{error}; going on without it")
                continue
            yield image


def _images_in(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names; none of a file, or of a
    folder that holds a splat.

    Raises:
        UsageError: There are more than `MOST_IMAGES`.
    """
    if not folder.is_dir():
        return []
    files = sorted(path for path in folder.iterdir() if path.is_file())
    if any(path.suffix.lower() in _SPLATS for path in files):
        return []
    images = [path for path in files if _is_picture(path)]
    if len(images) > MOST_IMAGES:
        do = "name fewer, for instance with a pattern of the shell"
        raise UsageError.of(
            str(folder), f"at most {MOST_IMAGES:,} images", f"{len(images):,}", do
        )
    return images


def _check_inputs(options: DetectOptions) -> None:
    """Raise if there are none, or a flag says where a scene is looked at from, and
    there is none among them.
    """
    if not options.inputs:
        raise UsageError.of(
            "inputs", "images, splats or scenes", "none", "name one or more"
        )
    idle = [f"--{name}" for name in _given(options.view) if name != "background"]
    if idle and all(
        _is_picture(source) or _images_in(source) for source in options.inputs
    ):
        got = f"images only, and {', '.join(idle)}"
        raise UsageError.of(
            "inputs",
            "a splat or a scene to look at from cameras",
            got,
            "leave the flag out",
        )


def _given(view: CameraOptions) -> dict[str, Any]:
    """What was said of the cameras, by the name of the flag, as JSON can hold it."""
    usual = dataclasses.asdict(CameraOptions())
    given = {
        name: value
        for name, value in dataclasses.asdict(view).items()
        if value != usual[name]
    }
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in given.items()
    }


def _is_picture(source: Path) -> bool:
    from mi_splat.datasets.frames import SUFFIXES

    return source.suffix.lower() in SUFFIXES
