"""The views of an attack: those of fixed cameras, or drawn by seed and number from a distribution."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.observe.views import visible_box, visible_weight
from attacks.transformations.config import Transformations
from attacks.transformations.draws import PictureChange, change_picture, draw_camera, draw_change
from mi_splat.bounds import bounds
from mi_splat.cameras import Camera, RenderFn
from mi_splat.directions import UP, Direction, Point, direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.rotation import from_z
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.sh import colour_to_dc
from mi_splat.view_freezing import RecentViews

T = TypeVar("T")

_ATTEMPTS = 200
"""Cameras drawn for one view before we say that the region does not show the object."""

_PICTURES = 512
"""Clean pictures kept; at 256 x 256 one takes 0.8 MB."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class View:
    """One view of the object.

    Attributes:
        index: Number of the camera, or of the draw.
        camera: Where from.
        box: (4,) x0, y0, x1, y1 in pixels: where the object shows.
        weight: (H, W) fraction of each pixel that the object makes up.
        direction: Of the camera, from the object's middle.
        change: What happens to the picture; nothing where cameras are fixed.
        redraws: Cameras that were drawn before and did not show the object.
    """

    index: int
    camera: Camera
    box: Tensor
    weight: Tensor
    direction: Direction
    change: PictureChange = field(default_factory=PictureChange)
    redraws: int = 0

    def changed(self, picture: Tensor) -> Tensor:
        """What becomes of a rendered (H, W, 3) picture of this view before a detector sees it; values in [0, 1]."""
        return change_picture(picture, self.change)


def fixed_views(subset: GaussianSubset, cameras: Sequence[Camera], *, render: RenderFn, up: Point = UP) -> list[View]:
    """The views of an object from cameras."""
    centre, _ = bounds(subset.scene.select(subset.rows))
    views = []
    for index, camera in enumerate(cameras):
        weight = visible_weight(subset, camera, render)
        box = visible_box(weight)
        if box is None:
            expected = "a view in which the object is visible"
            what = "camera" if len(cameras) == 1 else f"camera {index + 1} of {len(cameras)}"
            raise InvalidValueError.of(what, expected, "none of it", "turn this camera or choose another")
        direction = direction_of(camera, centre, up)
        views.append(View(index=index, camera=camera, box=box, weight=weight, direction=direction))
    return views


class ViewDistribution:
    """The views that an attack is made for: an object, its renderer, and what is random about them.

    A view depends on the seed and the number alone, so the views of one seed are the same whoever asks, and in whatever
    order. Views that were asked for are kept, unless told otherwise.

    Attributes:
        scene: The clean splat.
        mask: The object's Gaussians.
        reference: Camera that gives the size of the pictures, the field of view and the unit of distances.
        transformations: What is random.
        render: The renderer.
        up: (3,) direction of the world that is up in the regions of cameras.
        centre: (3,) middle of the object, world units.
        radius: Of the object, world units.
        frozen: Views in which only the object's colours change, see `RecentViews`.
    """

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
        """The distribution; see the attributes."""
        check_scene("scene", scene)
        self.scene, self.mask, self.reference, self.render, self.up = scene, mask, reference, render, up
        self.transformations = transformations or Transformations()
        self._subset = GaussianSubset.of(scene, mask)
        self.centre, self.radius = bounds(scene.select(self._subset.rows))
        self.frozen = RecentViews(scene, render=render, rows=self._subset.rows)
        self._kept: dict[tuple[int, int], View] = {}
        self._memory: dict[Hashable, Any] = {}
        self._pictures: dict[Camera, Tensor] = {}

    def view(self, seed: int, index: int, *, keep: bool = True) -> View:
        """One view.

        Args:
            seed: Of all views that belong together.
            index: Number of the view, 0 or more.
            keep: Whether to keep it for the next time.

        Returns:
            Its camera, what happens to its picture, and where the object is in it.

        Raises:
            InvalidValueError: No camera of the region shows the object.
        """
        if (seed, index) in self._kept:
            return self._kept[seed, index]
        view = self._draw(seed, index)
        if keep:
            self._kept[seed, index] = view
        return view

    def remembered(self, key: Hashable, make: Callable[[], T]) -> T:
        """What `make` returns, made once for each key, so that several attacks on the same views share it.

        Args:
            key: What the value depends on.
            make: Called if there is no value for this key yet.

        Returns:
            What was made.
        """
        if key not in self._memory:
            self._memory[key] = make()
        value: T = self._memory[key]
        return value

    def picture(self, camera: Camera) -> Tensor:
        """The picture of the clean scene, values in [0, 1]; the last ones are kept in memory.

        Args:
            camera: From where, and how large.

        Returns:
            (H, W, 3) sRGB.
        """
        if camera not in self._pictures:
            while len(self._pictures) >= _PICTURES:
                del self._pictures[next(iter(self._pictures))]
            frozen = self.frozen.get(camera)
            with torch.no_grad():
                clean = self.render(self.scene, camera) if frozen is None else frozen(self.scene.sh[frozen.rows])
            self._pictures[camera] = clean.clamp(0, 1)
        return self._pictures[camera]

    def _weight(self, camera: Camera) -> Tensor:
        """`visible_weight` of the object."""
        frozen = self.frozen.get(camera)
        if frozen is None or frozen.settings.linear:  # pictures of light do not add up in sRGB
            return visible_weight(self._subset, camera, self.render)
        zeros = torch.zeros(len(frozen.rows), 1, 3, device=self.scene.sh.device)
        black, white = (frozen(colour_to_dc(zeros + value)) for value in (0.0, 1.0))
        return (white - black)[..., :3].mean(-1).clamp(0, 1)

    def views(self, seed: int, count: int) -> list[View]:
        """The first `count` views of a seed.

        Args:
            seed: Seed of the draws; the same seed gives the same views.
            count: How many.

        Returns:
            As many views, in the order of their numbers.
        """
        return [self.view(seed, index) for index in range(count)]

    def _draw(self, seed: int, index: int) -> View:
        least = self.transformations.cameras.least_visible
        for attempt in range(_ATTEMPTS):
            generator = np.random.default_rng((seed, index, attempt))
            change = draw_change(self.transformations.pictures, generator)
            camera = draw_camera(
                self.transformations.cameras,
                generator,
                centre=self.centre,
                radius=self.radius,
                reference=self.reference,
            )
            if tuple(self.up) != UP:
                turn, middle = from_z(torch.tensor(list(self.up))), torch.tensor(list(self.centre), dtype=torch.float64)
                camera = camera.turned(turn, middle)
            weight = self._weight(camera)
            box = visible_box(weight)
            if box is not None and float((weight >= 0.5).to(torch.float32).mean()) >= least:
                return View(
                    index=index,
                    camera=camera,
                    change=change,
                    box=box,
                    weight=weight,
                    direction=direction_of(camera, self.centre, self.up),
                    redraws=attempt,
                )
        expected = f"one of {_ATTEMPTS} cameras that shows the object on {least:.1%} of the picture"
        raise InvalidValueError.of("region of the cameras", expected, "none", "move it, or lower least_visible")


def batch_indices(step: int, *, seed: int, batch: int, pool: int) -> list[int]:
    """Numbers of the views of one step: a function of the step, so that a run can be taken up again."""
    first = step * batch
    if not pool:
        return list(range(first, first + batch))
    orders = {
        turn: np.random.default_rng((seed, turn)).permutation(pool)
        for turn in range(first // pool, 1 + (first + batch - 1) // pool)
    }
    return [int(orders[number // pool][number % pool]) for number in range(first, first + batch)]
