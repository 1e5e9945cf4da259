"""cameras.json of a result: where a splat is looked at from, how it is rendered, and where the object is in it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.observe.views import BATCH, ViewDetections, detect_views
from attacks.transformations.draws import PictureChange, changing
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import camera_of
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

CAMERAS = "cameras.json"
_UNITS = "world units; pixels; poses are camera to world, x right, y down, z forward; colours are sRGB"


def cameras_document(cameras: Sequence[Mapping[str, Any]], **settings: Any) -> dict[str, Any]:
    """cameras.json: all that a picture of a splat needs, and where the object is in it."""
    return {"units": _UNITS, **settings, "cameras": list(cameras)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultCameras:
    """What cameras.json says.

    Attributes:
        cameras: The cameras by number.
        boxes: (4,) pixels of the object in each; None where it does not show.
        settings: Of the renderer.
        changes: What happens to the picture of each before a detector sees it; nothing without an entry.
    """

    cameras: tuple[Camera, ...]
    boxes: tuple[Tensor | None, ...]
    settings: RenderSettings
    changes: Mapping[Camera, PictureChange] = field(default_factory=dict)

    def look(
        self, scene: GaussianScene, detectors: Sequence[Detector], views: Sequence[int], *, batch: int = BATCH
    ) -> Iterator[ViewDetections]:
        """What detectors report of a splat from some of the cameras."""
        cameras, render = [self.cameras[view] for view in views], Renderer(self.settings)
        changes = {camera: self.changes.get(camera, PictureChange()) for camera in cameras}
        reports = detect_views(
            scene,
            cameras,
            detectors,
            render=changing(render, changes) if self.changes else render,
            boxes=[self.boxes[view] for view in views],
            batch=batch,
        )
        return (replace(seen, view=views[seen.view]) for seen in reports)


def result_cameras(values: Mapping[str, Any], where: str) -> ResultCameras:
    """The cameras of a result."""
    try:
        entries = values["cameras"]
        cameras = tuple(map(camera_of, entries))
        boxes = tuple(_box(entry["box"]) for entry in entries)
        pairs = zip(cameras, entries, strict=True)
        changes = {camera: _change(entry["change"]) for camera, entry in pairs if "change" in entry}
        red, green, blue = (float(part) for part in values["background"])
        mode = values.get("antialiased") is True
        settings = RenderSettings(background=(red, green, blue), near=float(values["near"]), antialiased=mode)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        expected, do = "cameras, boxes, background and near", "get the result again"
        raise InvalidValueError.of(where, expected, repr(error)[:200], do) from error
    return ResultCameras(cameras=cameras, boxes=boxes, settings=settings, changes=changes)


def _box(value: Any) -> Tensor | None:
    if value is None:
        return None
    x0, y0, x1, y1 = map(float, value)
    if not all(map(math.isfinite, (x0, y0, x1, y1))):
        raise ValueError(f"the box {value}")
    return torch.tensor([x0, y0, x1, y1])


def _change(values: Mapping[str, Any]) -> PictureChange:
    red, green, blue = map(float, values["gains"])
    return PictureChange(**{**values, "gains": (red, green, blue)})
