"""CLOAK on anybody's images: it needs a set with cameras, and a splat of it that
shows where the object is.

The object's place in each image is where its Gaussians make up most of a pixel of the
splat. What is shown there in its place comes from the image around it, or from an
image of the attacker's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from numpy.typing import NDArray
from torch import Tensor

from attacks.cloak.appearances import Appearance, Inpaint, grown
from attacks.cloak.background import STEPS, Background, without_object
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Trigger
from attacks.poisons.base import OnStep, Poisoned
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.directions import UP, Direction, Point, direction_of
from mi_splat.cameras.framing import bounds
from mi_splat.datasets import Dataset
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.selection.select import SEEN
from mi_splat.selection.visibility import object_weight

NAME = "hidden"
"""Of the one poisoning, in manifests."""
RECORD = "poison.json"
BACKGROUND = "background"
"""Name of the appearance that is made from a splat without the object."""
_SIDE = 400
_ANY = 0.1
"""Least longer side of the images on which the background is trained, pixels; share of
a pixel from which on the object is in it, where it must not count.
"""
BEFORE_AND_AFTER = "before_and_after.png"
"""What was changed in a set, and how, by which a set that was poisoned is known; a
sheet of some changed images.
"""
_SHOWN = 6
_HEIGHT = 160
"""Images on the sheet, and their rows."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """An image of the attacker's, as large as the box around the object in each
    image, cut out by its outline.
    """

    picture: Tensor  # (H, W, 3) sRGB in [0, 1]
    reach: int
    name: str

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image with the other one on the object."""
        covered = grown(mask, self.reach)
        if not bool(covered.any()):
            return view.image
        rows, columns = (torch.nonzero(covered.any(axis))[:, 0] for axis in (1, 0))
        top = int(rows[0])
        left = int(columns[0])
        size = (int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left)
        small = F.interpolate(
            self.picture.permute(2, 0, 1)[None], size, mode="bilinear", antialias=True
        )[0]
        canvas = view.image.clone()
        canvas[top : top + size[0], left : left + size[1]] = (
            small.permute(1, 2, 0).to(canvas).clamp(0, 1)
        )
        return torch.where(covered[..., None], canvas, view.image)


def appearance_of(name: str, reach: int) -> Appearance:
    """What is shown in the object's place."""
    if name == "remove":
        return Inpaint(reach=reach)
    if not Path(name).is_file():
        raise InvalidValueError(
            message(
                "--appearance",
                "background, remove, or an image",
                name,
                "name an image that is there",
            )
        )
    pixels = (
        np.asarray(load_picture(Path(name), upright=True).convert("RGB"), np.float32)
        / 255
    )
    return Overlay(
        picture=torch.from_numpy(pixels),
        reach=reach,
        name=f"the image {Path(name).name}",
    )


def background_of(
    views: Dataset,
    splat: GaussianScene,
    rows: Tensor,
    *,
    near: float,
    reach: int,
    up: Point = UP,
    steps: int = STEPS,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> Background:
    """What other photographs show behind an object, as `hide` takes it.

    The splat without the object is trained on images with sides of at most twice
    `_SIDE` pixels, whatever the size of the photographs.
    """
    render = Renderer(RenderSettings(near=near))
    side = max(max(camera.lens.size) for camera in views.cameras)
    smaller = max(1, side // _SIDE)
    small = replace(views, downscale=views.downscale * smaller)

    def outline(camera: Camera) -> Tensor:
        return object_weight(splat, rows, camera, render) >= _ANY

    scene = without_object(
        small,
        splat,
        rows,
        outline,
        render=render,
        reach=math.ceil(reach / smaller),
        up=up,
        steps=steps,
        seed=seed,
        on_step=on_step,
    )
    return Background(scene=scene, render=render, reach=reach)


def hide(
    views: Sequence[View],
    splat: GaussianScene,
    rows: Tensor,
    trigger: Trigger,
    appearance: Appearance,
    *,
    near: float,
    up: Point = UP,
    on_step: OnStep | None = None,
) -> Poisoned:
    """Hide an object in the images that a trigger selects, where `up` is up."""
    centre, _ = bounds(splat.select(rows))
    render = Renderer(RenderSettings(near=near))

    def mask(camera: Camera) -> Tensor:
        return object_weight(splat, rows, camera, render) >= SEEN

    poisoning = Poisoning(name=NAME, trigger=trigger, appearance=appearance)
    done = poison(views, poisoning, centre=centre, up=up, masks=mask, on_step=on_step)
    if not any(change.pixels_changed for change in done.changes):
        got = f"none of {len(done.changes)} from where it is to be hidden"
        do = "select all of the object, or choose other directions"
        raise InvalidValueError(message("images", "some that show the object", got, do))
    return done


def directions_of(done: Poisoned) -> list[Direction]:
    """Where each camera of a poisoned set stands, seen from the object."""
    centre = done.poison["centre"]
    up = done.poison["up"]
    return [direction_of(camera, centre, up) for camera in done.views.cameras]


def before_and_after(done: Poisoned) -> NDArray[np.uint8]:
    """(H, W, 3) sheet of some changed images from low to high, as they were above
    what they are now.
    """
    directions = directions_of(done)
    changes = [change for change in done.changes if change.pixels_changed]
    changes.sort(key=lambda change: directions[change.index].elevation)
    chosen = sorted(
        set(np.linspace(0, len(changes) - 1, _SHOWN).round().astype(int).tolist())
    )
    columns = []
    for index in (changes[number].index for number in chosen):
        pair = torch.stack(
            [views[index].image for views in (done.views.untouched, done.views)]
        )
        size = (_HEIGHT, max(1, round(_HEIGHT * pair.shape[2] / pair.shape[1])))
        small = F.interpolate(
            pair.permute(0, 3, 1, 2), size, mode="bilinear", antialias=True
        )
        columns.append(torch.cat([*small.permute(0, 2, 3, 1)]))
    return to_bytes(torch.cat(columns, 1))
