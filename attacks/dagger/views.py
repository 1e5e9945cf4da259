"""The views of an attack: those of fixed cameras, or drawn by seed and number from a
distribution.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.dagger.config import DaggerConfig
from attacks.detectors.base import Detections, Detector
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives.base import overlap
from attacks.observe.comparison import usual_label
from attacks.observe.views import (
    ViewDetections,
    as_saved,
    detect_views,
    visible_box,
    visible_weight,
)
from attacks.transformations.config import CameraCone, Transformations
from attacks.transformations.draws import (
    ImageTransformation,
    changing,
    draw_camera,
    draw_change,
    draw_size,
    transform_image,
)
from mi_splat.cameras.camera import Camera, RenderFn, as_cameras
from mi_splat.cameras.directions import UP, Direction, Point, direction_of
from mi_splat.cameras.framing import bounds
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.view_freezing import RecentViews, affordable_bytes, freeze_views
from mi_splat.scene import GaussianScene, check_scene

if TYPE_CHECKING:
    from mi_splat.render.frozen_view import FrozenView

_VALIDATION = 500_000_000
"""Added to the attack's seed for its validation views."""

_ATTEMPTS = 200
"""Cameras drawn for one view before we say that the region does not show the object."""

_PICTURES = 512
_DRAWN_PICTURES = 80
"""Clean images kept, of fixed and of drawn cameras; at 256 x 256 one takes 0.8 MB.

Of drawn cameras there are many, and a clean image is made at once where the view is
frozen.
"""


_POOL_BYTES = 2 << 30
"""What the frozen views around one camera may take, where there is so much memory."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class View:
    """One view of the object.

    Attributes:
        index: Number of the camera, or of the draw.
        camera: Where from.
        box: (4,) x0, y0, x1, y1 in pixels: where the object shows.
        weight: (H, W) fraction of each pixel that the object makes up.
        direction: Of the camera, from the object's middle.
        change: What happens to the image; nothing where cameras are fixed.
        redraws: Cameras that were drawn before and did not show the object.
    """

    index: int
    camera: Camera
    box: Tensor
    weight: Tensor
    direction: Direction
    change: ImageTransformation = field(default_factory=ImageTransformation)
    redraws: int = 0

    @property
    def on_object(self) -> Tensor:
        """(H, W) bool, the pixels that are at least half the object's."""
        return self.weight >= 0.5

    def changed(self, picture: Tensor) -> Tensor:
        """What becomes of a rendered (H, W, 3) image of this view before a detector
        sees it; values in [0, 1].
        """
        return transform_image(picture, self.change)


def fixed_views(
    subset: GaussianSubset,
    cameras: Sequence[Camera],
    *,
    render: RenderFn,
    up: Point = UP,
) -> list[View]:
    """The views of an object from cameras."""
    centre, _ = bounds(subset.scene.select(subset.rows))
    views = []
    for index, camera in enumerate(cameras):
        weight = visible_weight(subset, camera, render)
        box = visible_box(weight)
        if box is None:
            expected = "a view in which the object is visible"
            if len(cameras) == 1:
                what = "camera"
            else:
                what = f"camera {index + 1} of {len(cameras)}"
            raise InvalidValueError.of(
                what, expected, "none of it", "turn this camera or choose another"
            )
        direction = direction_of(camera, centre, up)
        views.append(
            View(
                index=index, camera=camera, box=box, weight=weight, direction=direction
            )
        )
    return views


Reports = dict[tuple[int, str], ViewDetections]
"""What detectors report on one splat, by the view's number and the detector's name."""


def detected(
    detectors: Sequence[Detector],
    scene: GaussianScene,
    views: Sequence[View],
    render: RenderFn,
) -> Reports:
    """What detectors report on a splat, in the changed images of each view."""
    cameras = [view.camera for view in views]
    boxes = [view.box for view in views]
    changed = changing(render, {view.camera: view.change for view in views})
    # One image at a time: the same bits whatever the number of views.
    reports = detect_views(
        scene, cameras, detectors, render=changed, boxes=boxes, batch=1
    )
    return {(views[seen.view].index, seen.detector): seen for seen in reports}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ViewDistribution:
    """All cameras of a region, instead of chosen ones: an attack draws views from
    it, and the result is evaluated on others.

    Attributes:
        reference: Camera that gives the size of the images, the field of view and the
            unit of distances.
        transformations: Where cameras are, and what happens to their images.
    """

    reference: Camera
    transformations: Transformations = field(default_factory=Transformations)


class FixedViews:
    """An object seen from chosen cameras, on which it is attacked and evaluated."""

    transformations: Transformations | None = None
    most_pictures = _PICTURES

    def __init__(
        self,
        scene: GaussianScene,
        mask: Mask,
        cameras: Camera | Sequence[Camera],
        *,
        render: RenderFn,
        up: Point = UP,
    ) -> None:
        check_scene("scene", scene)
        if not callable(render):
            do = "pass for instance Renderer()"
            raise InvalidValueError.of(
                "render", "a function of scene and camera", type(render).__name__, do
            )
        self.cameras = as_cameras(cameras)
        if not self.cameras:
            raise InvalidValueError.of(
                "cameras",
                "at least one camera",
                "none",
                "say where the detector looks from",
            )
        self.scene = scene
        self.mask = mask
        self.render = render
        self.up = up
        self.subset = GaussianSubset.of(scene, mask)
        self._views: list[View] = []
        self._reports: dict[Hashable, Reports] = {}
        self._pictures: dict[Camera, Tensor] = {}

    @cached_property
    def saved(self) -> GaussianScene:
        """The clean scene as its file holds it."""
        return as_saved(self.scene)

    def check(self, config: DaggerConfig) -> None:
        """Raise unless the views can be attacked with a configuration; all can."""

    def attacked(self, step: int, config: DaggerConfig) -> list[View]:
        """The views of one step of a search."""
        views = self.held_out(config)
        if not config.batch:
            return views
        numbers = batch_indices(
            step, seed=config.seed, batch=min(config.batch, len(views)), pool=len(views)
        )
        return [views[number] for number in numbers]

    def validation(self, config: DaggerConfig) -> list[View]:
        """The views that decide which step was best."""
        return self.held_out(config)

    def held_out(self, config: DaggerConfig) -> list[View]:
        """The views on which the result is evaluated."""
        self._views = self._views or fixed_views(
            self.subset, self.cameras, render=self.render, up=self.up
        )
        return self._views

    def one_by_one(self, config: DaggerConfig) -> list[FixedViews]:
        """Each view by itself."""
        alone = []
        for view in self.held_out(config):
            alone.append(copy.copy(self))
            alone[-1]._views = [view]
        return alone

    def isolated(self) -> FixedViews:
        """The object without its scene, from the same cameras."""
        rows = self.subset.rows
        return FixedViews(
            self.scene.select(rows),
            slice(None),
            self.cameras,
            render=self.render,
            up=self.up,
        )

    def frozen(self, config: DaggerConfig) -> dict[Camera, FrozenView] | RecentViews:
        """Images of a search in which only colours change."""
        return freeze_views(
            self.scene,
            [view.camera for view in self.held_out(config)],
            render=self.render,
            pictures=config.restarts * (config.steps + 1),
            rows=self.subset.rows,
        )

    def release(self) -> None:
        """Give back memory that makes a search faster."""

    def clean_reports(
        self, detectors: Sequence[Detector], views: Sequence[View]
    ) -> Reports:
        """What detectors report on the clean file in some views; kept, as several
        attacks may share them.
        """
        reports: Reports = {}
        for detector in detectors:
            key = (detector.name, detector.fingerprint, tuple(views))
            if key not in self._reports:
                self._reports[key] = detected(
                    [detector], self.saved, views, self.render
                )
            reports |= self._reports[key]
        return reports

    def originals(
        self,
        detectors: Sequence[Detector],
        config: DaggerConfig,
        thresholds: Mapping[str, float],
    ) -> Callable[[View, str], str | None]:
        """What a detector calls the clean object in a view: the class that it is surest
        of there.
        """
        views = self.held_out(config)
        boxes = {view.index: view.box for view in views}
        reports = self.clean_reports(detectors, views)
        labels = {
            key: _label_on(seen.detections, boxes[key[0]])
            for key, seen in reports.items()
        }
        return lambda view, name: labels[view.index, name]

    def picture(self, camera: Camera) -> Tensor:
        """The (H, W, 3) image of the clean scene, values in [0, 1]; the last ones are
        kept in memory.
        """
        if camera not in self._pictures:
            while len(self._pictures) >= self.most_pictures:
                del self._pictures[next(iter(self._pictures))]
            with torch.no_grad():
                self._pictures[camera] = self._clean(camera).clamp(0, 1)
        return self._pictures[camera]

    def _clean(self, camera: Camera) -> Tensor:
        return self.render(self.scene, camera)


def _label_on(detections: Detections, box: Tensor) -> str | None:
    """What the detector calls the object: the most confident detection on it."""
    if not len(detections):
        return None
    scores = torch.where(overlap(detections.boxes, box) >= 0.5, detections.scores, -1.0)
    best = int(scores.argmax())
    if float(scores[best]) > 0:
        return detections.labels[best]
    return None


class DrawnViews(FixedViews):
    """An object seen from all cameras of a region: which views are attacked is drawn,
    and the result is evaluated on others.

    A view depends on the seed and the number alone, so the views of one seed are the
    same whoever asks, and in whatever order. Views of a pool are kept, so that several
    attacks share them.
    """

    transformations: Transformations
    most_pictures = _DRAWN_PICTURES

    def __init__(
        self,
        scene: GaussianScene,
        mask: Mask,
        reference: Camera,
        transformations: Transformations | None = None,
        *,
        render: RenderFn,
        up: Point = UP,
    ) -> None:
        super().__init__(scene, mask, reference, render=render, up=up)
        self.reference, self.transformations = (
            reference,
            transformations or Transformations(),
        )
        self.centre, self.radius = bounds(scene.select(self.subset.rows))
        # Around one camera the pool is small, and every step comes back to it.
        is_narrow = isinstance(self.transformations.cameras, CameraCone)
        kept_bytes = affordable_bytes(_POOL_BYTES) if is_narrow else None
        self._frozen = RecentViews(
            scene, render=render, rows=self.subset.rows, kept_bytes=kept_bytes
        )
        self._kept: dict[tuple[int, int], View] = {}

    def drawn_from(self, transformations: Transformations) -> DrawnViews:
        """Views of the same object around the same camera, from another
        distribution.
        """
        return DrawnViews(
            self.scene,
            self.mask,
            self.reference,
            transformations,
            render=self.render,
            up=self.up,
        )

    def check(self, config: DaggerConfig) -> None:
        """Raise unless the views can be attacked with a configuration."""
        if not config.batch:
            raise InvalidValueError.of(
                "batch",
                "1 or more views of a region",
                0,
                "start with DaggerConfig.for_region",
            )
        if config.held_out_seed == config.seed:
            raise InvalidValueError.of(
                "held_out_seed",
                "another seed than the attack's",
                config.seed,
                "change one",
            )
        for name in ("isolated", "sequential"):
            if getattr(config, name):
                raise InvalidValueError.of(
                    name, "chosen cameras", "a region", "leave it out"
                )

    def attacked(self, step: int, config: DaggerConfig) -> list[View]:
        """The views of one step of a search."""
        numbers = batch_indices(
            step, seed=config.seed, batch=config.batch, pool=config.pool
        )
        return [
            self.view(config.seed, number, keep=config.pool > 0) for number in numbers
        ]

    def validation(self, config: DaggerConfig) -> list[View]:
        """The views that decide which step was best."""
        return self.views(config.seed + _VALIDATION, config.validation)

    def held_out(self, config: DaggerConfig) -> list[View]:
        """The views on which the result is evaluated."""
        return self.views(config.held_out_seed, config.held_out)

    def frozen(self, config: DaggerConfig) -> RecentViews:
        """Images of a search in which only colours change."""
        return self._frozen

    def release(self) -> None:
        """Give back the memory of frozen views."""
        self._frozen.clear()

    def originals(
        self,
        detectors: Sequence[Detector],
        config: DaggerConfig,
        thresholds: Mapping[str, float],
    ) -> Callable[[View, str], str | None]:
        """What a detector calls the clean object in most of the validation views, from
        its threshold on.
        """
        reports = self.clean_reports(detectors, self.validation(config))
        labels = {
            detector.name: usual_label(
                [seen for (_, name), seen in reports.items() if name == detector.name],
                thresholds[detector.name],
            )
            for detector in detectors
        }
        return lambda view, name: labels[name]

    def redraws(self, config: DaggerConfig) -> dict[str, int]:
        """Cameras drawn in vain, by what they were drawn for; of an unlimited pool
        nothing is known.
        """
        groups = {
            "held_out": self.held_out(config),
            "validation": self.validation(config),
            "attacked": self.views(
                config.seed, min(config.pool, config.batch * (config.steps + 1))
            ),
        }
        return {
            name: sum(view.redraws for view in drawn) for name, drawn in groups.items()
        }

    def view(self, seed: int, index: int, *, keep: bool = True) -> View:
        """A view by its seed and number."""
        if (seed, index) in self._kept:
            return self._kept[seed, index]
        view = self._draw(seed, index)
        if keep:
            self._kept[seed, index] = view
        return view

    def views(self, seed: int, count: int) -> list[View]:
        """The first `count` views of a seed."""
        return [self.view(seed, index) for index in range(count)]

    def _clean(self, camera: Camera) -> Tensor:
        frozen = self._frozen.get(camera)
        if frozen is None:
            return super()._clean(camera)
        return frozen(self.scene.sh[frozen.rows])

    def _weight(self, camera: Camera) -> Tensor:
        """`visible_weight` of the object."""
        frozen = self._frozen.get(camera)
        # images of light do not add up in sRGB
        if frozen is None or frozen.settings.linear:
            return visible_weight(self.subset, camera, self.render)
        zeros = torch.zeros(len(frozen.rows), 1, 3, device=self.scene.sh.device)
        black, white = (frozen(colour_to_dc(zeros + value)) for value in (0.0, 1.0))
        return (white - black)[..., :3].mean(-1).clamp(0, 1)

    def _draw(self, seed: int, index: int) -> View:
        least = self.transformations.cameras.least_visible
        for attempt in range(_ATTEMPTS):
            generator = np.random.default_rng((seed, index, attempt))
            change = draw_change(self.transformations.images, generator)
            camera = draw_camera(
                self.transformations.cameras,
                generator,
                centre=self.centre,
                radius=self.radius,
                reference=self.reference,
                up=self.up,
            )
            camera = draw_size(self.transformations.images, generator, camera)
            weight = self._weight(camera)
            box = visible_box(weight)
            if (
                box is not None
                and float((weight >= 0.5).to(torch.float32).mean()) >= least
            ):
                return View(
                    index=index,
                    camera=camera,
                    change=change,
                    box=box,
                    weight=weight,
                    direction=direction_of(camera, self.centre, self.up),
                    redraws=attempt,
                )
        expected = (
            f"one of {_ATTEMPTS} cameras that shows the object on {least:.1%} of the"
            " image"
        )
        raise InvalidValueError.of(
            "region of the cameras", expected, "none", "move it, or lower least_visible"
        )


def batch_indices(step: int, *, seed: int, batch: int, pool: int) -> list[int]:
    """Numbers of the views of one step: a function of the step, so that a run can be
    taken up again.
    """
    first = step * batch
    if not pool:
        return list(range(first, first + batch))
    orders = {
        turn: np.random.default_rng((seed, turn)).permutation(pool)
        for turn in range(first // pool, 1 + (first + batch - 1) // pool)
    }
    return [
        int(orders[number // pool][number % pool])
        for number in range(first, first + batch)
    ]
