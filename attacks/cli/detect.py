"""`mi-splat detect`: what detectors report on pictures, and on splats as cameras see them."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import Confidence, Detectors
from mi_splat import provenance
from mi_splat.cli.console import UsageError, progress, show_result
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.cli.options import CameraOptions
from mi_splat.errors import message
from mi_splat.fields import Folder

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.detectors.base import Detections, Detector


EXAMPLES = ("detect photo.png desk.ply --cameras orbit:8@20 --out out/detect",)
SEE_ALSO = ("detectors", "evaluate")


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectOptions:
    """Let detectors look at pictures, or at splats and scenes from cameras; draw the boxes and list them.

    Writes a picture with boxes for each picture and detector, and result.json, into --out.
    """

    inputs: Positional[tuple[Path, ...]] = ()
    """Pictures, splat files and scene XMLs; at least one."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where splats and scenes are looked at from."""
    min_confidence: Confidence = 0.3
    """Confidence from which a detection is drawn and listed."""
    out: Folder = Path("out/detect")
    """Folder for the results; a new one."""
    force: bool = False
    """Replace a folder that an earlier call has written."""
    json: bool = False
    """Print the detections as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What one detector reports on one picture.

    Attributes:
        source: The picture's file, or that of the scene.
        camera: Where from, as JSON can hold it; None of a picture.
        detector: Its name.
        image: (H, W, 3) sRGB in [0, 1].
        detections: What is reported.
    """

    source: Path
    camera: Mapping[str, object] | None
    detector: str
    image: Tensor
    detections: Detections

    @property
    def name(self) -> str:
        """What the picture with boxes is called."""
        from mi_splat.io.documents import file_name

        camera = "" if self.camera is None else f"-{self.camera['name']}"
        return file_name(f"{self.source.stem}{camera}-{self.detector}")


def run(options: DetectOptions) -> int:
    """Detect, draw the boxes, and list them."""
    from attacks.cli.names import load_detectors
    from attacks.observe.drawing import annotated
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder

    if not options.inputs:
        raise UsageError(message("inputs", "pictures, splats or scenes", "none", "name one or more"))
    _check_idle(options)
    check_new_folder(options.out, force=options.force)
    with progress("loading") as advance:
        # Not before the first file is read and its cameras are found: a wrong name is told at once.
        detectors = functools.cache(lambda: load_detectors(options.detectors, options.weights))
        pictures: list[Seen] = []
        for source in options.inputs:
            advance(f"looking at {source}")
            pictures += seen_in(source, detectors, options.view)
        named = dict(zip(_distinct([seen.name for seen in pictures]), pictures, strict=True))
        rows = {name: {**_row(seen, options.min_confidence), "picture": f"{name}.png"} for name, seen in named.items()}
        document = {
            "story": "detect",
            "min_confidence": options.min_confidence,
            "view": _given(options.view),
            "fingerprints": {detector.name: detector.fingerprint for detector in detectors()},
            "pictures": list(rows.values()),
            **provenance.origin(),
        }
        with new_folder(options.out, force=options.force) as folder:
            for name, seen in named.items():
                drawn = annotated(seen.image, seen.detections, name, min_confidence=options.min_confidence)
                save_png(drawn, folder / f"{name}.png")
            save_json(document, folder / RECORD)
    lines = [f"{name}: {_boxes(row) or 'nothing'}" for name, row in rows.items()]
    lines.append(f"{options.out}: {len(rows)} pictures with boxes, and {RECORD}")
    show_result({**document, "out": str(options.out)}, *lines, as_json=options.json)
    return 0


def _boxes(row: Mapping[str, Any]) -> str:
    return ", ".join(f"{item['label']} {item['score']:.0%}" for item in row["detections"])


def seen_in(source: Path, detectors: Callable[[], list[Detector]], view: CameraOptions) -> Iterator[Seen]:
    """What every detector reports on a picture, or on a scene from every camera.

    Args:
        source: A picture, or a scene.
        detectors: Loads them; they have different names.
        view: Where a scene is looked at from.

    Yields:
        A value for each picture and detector.

    Raises:
        MiSplatError: The file cannot be read, or a camera is not there.
    """
    import torch

    from attacks.observe.views import detect_views
    from mi_splat.cli.cameras import find_cameras, renderer_of
    from mi_splat.datasets.pictures import read_picture
    from mi_splat.io.camera_records import describe
    from mi_splat.scene_files import open_scene

    if _is_picture(source):
        image, _ = read_picture(source, downscale=1, background=view.background or (0.0, 0.0, 0.0))
        for detector in detectors():
            with torch.no_grad():
                (detections,) = detector.detect(image[None])
            yield Seen(source=source, camera=None, detector=detector.name, image=image, detections=detections)
        return
    loaded = open_scene(source)
    cameras = find_cameras(loaded, view)
    render = renderer_of(loaded, view, cameras)
    records = [describe(name, camera) for name, camera in cameras.items()]
    for seen in detect_views(loaded.scene, list(cameras.values()), detectors(), render=render):
        camera, detections = records[seen.view], seen.detections
        yield Seen(source=source, camera=camera, detector=seen.detector, image=seen.image, detections=detections)


def _check_idle(options: DetectOptions) -> None:
    """Raise if a flag says where a scene is looked at from, and there is none among the inputs."""
    if any(not _is_picture(source) for source in options.inputs):
        return
    idle = [f"--{name}" for name in _given(options.view) if name != "background"]
    if idle:
        got = f"pictures only, and {', '.join(idle)}"
        raise UsageError(message("inputs", "a splat or a scene to look at from cameras", got, "leave the flag out"))


def _given(view: CameraOptions) -> dict[str, Any]:
    """What was said of the cameras, by the name of the flag, as JSON can hold it."""
    usual = CameraOptions()
    names = [field.name for field in dataclasses.fields(usual)]
    values = {name: getattr(view, name) for name in names if getattr(view, name) != getattr(usual, name)}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _is_picture(source: Path) -> bool:
    from mi_splat.datasets.pictures import SUFFIXES

    return source.suffix.lower() in SUFFIXES


def _row(seen: Seen, min_confidence: float) -> dict[str, Any]:
    """One picture and detector as JSON can hold it; boxes are x0, y0, x1, y1 in pixels."""
    from attacks.observe.drawing import listed

    return {
        "source": str(seen.source),
        "camera": seen.camera,
        "detector": seen.detector,
        "size": [seen.image.shape[1], seen.image.shape[0]],
        "detections": [item for item in listed(seen.detections) if item["score"] >= min_confidence],
    }


def _distinct(names: list[str]) -> list[str]:
    """The names, with a number behind those that were there before."""
    distinct: list[str] = []
    for name in names:
        numbered = (f"{name}-{number}" for number in itertools.count(len(distinct)))
        distinct.append(next(other for other in itertools.chain([name], numbered) if other not in distinct))
    return distinct
