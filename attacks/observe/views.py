"""A scene seen from many cameras: images of 8 bits that went through PNG, and what
every detector reports on them.

Both attacks are judged by this module alone: what it has not seen on an 8-bit image
counts for neither.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from attacks.detectors.base import Detections, Detector
from attacks.detectors.registry import as_detectors
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives.base import confidence
from attacks.observe.rows import CLEAN
from mi_splat.cameras.camera import Camera, RenderFn, as_cameras
from mi_splat.cameras.directions import Direction, Point, direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.formats.gaussian_ply import through_ply
from mi_splat.io.images import from_bytes, through_png
from mi_splat.maths.sh import degree_of, sh_basis
from mi_splat.scene import GaussianScene
from mi_splat.selection.visibility import object_weight

BATCH = 16
"""Images that a detector looks at together."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ViewDetections:
    """One view of a scene as one detector sees it."""

    view: int  # index of the camera
    camera: Camera
    detector: str  # name of the detector
    pixels: Tensor  # (H, W, 3) uint8 sRGB, the image that the detector looked at
    box: Tensor | None
    detections: Detections  # what the detector reports

    @property
    def image(self) -> Tensor:
        """The image as (H, W, 3) float32 in [0, 1]."""
        return from_bytes(self.pixels)

    def direction(self, centre: Point) -> Direction:
        """Azimuth and elevation of the camera as seen from `centre` (3,), world
        units.
        """
        return direction_of(self.camera, centre)

    def confidence(self, label: str | None = None, *, iou: float = 0.5) -> float:
        """Highest score of `label` (any class if None) on the object; 0 without a
        box.
        """
        if self.box is None:
            return 0.0
        return confidence(
            self.detections,
            self.box,
            labels=None if label is None else [label],
            iou=iou,
        )

    def confidence_of(self, label: str, classes: Sequence[str]) -> float | None:
        """The same; None for a class that is not among those of the detector: it cannot
        report it.
        """
        if label in classes:
            return self.confidence(label)
        return None


def detect_views(
    scene: GaussianScene,
    cameras: Camera | Sequence[Camera],
    detectors: Detector | str | Sequence[Detector | str],
    *,
    render: RenderFn,
    boxes: Sequence[Tensor | None] | None = None,
    batch: int = BATCH,
) -> Iterator[ViewDetections]:
    """Render a scene from every camera through 8 bits, and let every detector look at
    the images.

    Each image is rendered once for all detectors. Nothing is rendered before the
    first value is asked for, so that a caller can report progress.
    """
    cameras = as_cameras(cameras)
    detectors = as_detectors(detectors)
    if boxes is not None and len(boxes) != len(cameras):
        raise InvalidValueError.of(
            "boxes",
            f"{len(cameras)}, one for each camera",
            len(boxes),
            "use None in gaps",
        )
    for views in _batches(cameras, batch):
        with torch.no_grad():
            images = torch.stack(
                [through_png(render(scene, cameras[view])) for view in views]
            )
            seen = [(detector.name, detector.detect(images)) for detector in detectors]
        pixels = (images * 255).round().to(torch.uint8)
        for name, reports in seen:
            for view, picture, detections in zip(views, pixels, reports, strict=True):
                yield ViewDetections(
                    view=view,
                    camera=cameras[view],
                    detector=name,
                    pixels=picture,
                    box=None if boxes is None else boxes[view],
                    detections=detections,
                )


def _batches(cameras: Sequence[Camera], size: int) -> Iterator[list[int]]:
    """Indices of consecutive cameras, at most `size` at a time and all of one image
    size.
    """
    batch: list[int] = []
    for view, camera in enumerate(cameras):
        same = not batch or (cameras[batch[0]].width, cameras[batch[0]].height) == (
            camera.width,
            camera.height,
        )
        if batch and (len(batch) == size or not same):
            yield batch
            batch = []
        batch.append(view)
    if batch:
        yield batch


def as_saved(scene: GaussianScene) -> GaussianScene:
    """What a user gets who loads the scene's file: every attribute has gone through the
    space and precision of it.
    """
    return through_ply(scene).to(scene.means.device)


def object_boxes(
    scene: GaussianScene,
    mask: Mask,
    cameras: Camera | Sequence[Camera],
    *,
    render: RenderFn,
) -> list[Tensor | None]:
    """Where an object shows in each view, what hides it taken into account."""
    subset = GaussianSubset.of(scene, mask)
    return [
        visible_box(visible_weight(subset, camera, render))
        for camera in as_cameras(cameras)
    ]


def detect_scenes(
    scenes: Mapping[str, GaussianScene],
    mask: Mask,
    cameras: Camera | Sequence[Camera],
    detectors: Detector | str | Sequence[Detector | str],
    *,
    render: RenderFn,
) -> dict[str, list[ViewDetections]]:
    """Look at every scene, as its file holds it, from every camera with every
    detector.
    """
    if CLEAN not in scenes:
        raise InvalidValueError.of(
            "scenes",
            f"one of the name {CLEAN}",
            list(scenes),
            "add the unattacked scene",
        )
    detectors = as_detectors(detectors)
    boxes = object_boxes(scenes[CLEAN], mask, cameras, render=render)
    return {
        name: list(
            detect_views(
                as_saved(scene), cameras, detectors, render=render, boxes=boxes
            )
        )
        for name, scene in scenes.items()
    }


def visible_weight(subset: GaussianSubset, camera: Camera, render: RenderFn) -> Tensor:
    """How much of each pixel the object makes up: (H, W) in [0, 1], occlusion by the
    rest of the scene included.

    As in `object_weight`.
    """
    return object_weight(subset.scene, subset.rows, camera, render)


def visible_box(weight: Tensor) -> Tensor | None:
    """(4,) pixel box around the pixels of which the object makes up at least a half;
    None without any.
    """
    rows, columns = torch.nonzero(weight >= 0.5, as_tuple=True)
    if not len(rows):
        return None
    corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return torch.stack(corners).to(torch.float32)


def clamped_fraction(subset: GaussianSubset, camera: Camera) -> float:
    """Fraction of the object's colour channels clamped at 0 from this camera: their SH
    gradient is exactly zero.
    """
    means = subset.scene.means[subset.rows].detach()
    sh = subset.scene.sh[subset.rows].detach()
    directions = torch.nn.functional.normalize(
        means - camera.position.to(means), dim=-1
    )
    basis = sh_basis(directions, degree_of(sh.shape[1]))
    colours = 0.5 + (basis[..., None] * sh).sum(1)
    return float((colours <= 0).to(torch.float64).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageChange:
    """How far the attacked images are from the clean ones; values in [0, 1], all
    views together.
    """

    # euclidean norm of the difference, per view (root mean square over views)
    l2: float
    linf: float  # largest change of a channel of a pixel
    psnr: float | None  # dB over whole images; None when nothing changed
    psnr_object: float | None  # dB over the pixels that are at least half the object's
    # largest change of a pixel of which the object makes up less than 1/255
    outside: float

    def __str__(self) -> str:
        if self.psnr is None:
            return "no pixel changed"
        return f"PSNR {self.psnr:.1f} dB"


def image_change(
    before: Iterable[Tensor], after: Iterable[Tensor], weights: Sequence[Tensor]
) -> ImageChange:
    """Compare (H, W, 3) images pairwise; `weights` are (H, W) as from
    `visible_weight`.
    """
    # Squares of all pixels at once, so that means are summed in one order; all else a
    # image at a time.
    squares = torch.empty(
        3 * sum(weight.numel() for weight in weights), dtype=torch.float64
    )
    on_object: list[Tensor] = []
    total = largest = outside = 0.0
    end = 0
    for clean, changed, weight in zip(before, after, weights, strict=True):
        gap = (clean.detach() - changed.detach()).double()
        square = gap.square()
        begin = end
        end = end + gap.numel()
        squares[begin:end] = square.flatten()
        on_object.append(square[weight >= 0.5])
        total += float(square.sum())
        largest = max(largest, float(gap.abs().max()))
        beside = gap[weight < 1 / 255]
        if beside.numel():
            outside = max(outside, float(beside.abs().max()))
    return ImageChange(
        l2=math.sqrt(total / len(weights)),
        linf=largest,
        psnr=_psnr(squares),
        psnr_object=_psnr(torch.cat(on_object)),
        outside=outside,
    )


def _psnr(squares: Tensor) -> float | None:
    error = float(squares.mean()) if squares.numel() else 0.0
    if error > 0:
        return -10 * math.log10(error)
    return None


# cameras.json of a result: where a splat is looked at from, how it is rendered, and
# where the object is in it

CAMERAS = "cameras.json"
_UNITS = (
    "world units; pixels; poses are camera to world, x right, y down, z forward;"
    " colours are sRGB"
)


def cameras_document(
    cameras: Sequence[Mapping[str, Any]], **settings: Any
) -> dict[str, Any]:
    """cameras.json: all that an image of a splat needs, and where the object is in
    it.
    """
    return {"units": _UNITS, **settings, "cameras": list(cameras)}
