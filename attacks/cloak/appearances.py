"""What an attack shows: functions from a view and the target's mask in it to the
image that takes its place.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph, linalg
from torch import Tensor
from torch.nn import functional

from attacks.cloak.config import AttackConfig
from attacks.cloak.mesh_scene import (
    MeshScene,
    load_texture,
    repainted,
    stand_in,
)
from mi_splat.cameras.camera import Camera, View, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.capture.mesh import Asset, rotation
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.objects import object_file
from mi_splat.errors import InvalidValueError

# Appearances that retouch an image: two controls, and the attack of who has nothing
# but images and masks.
#
# A control damages the object without hiding it. If detectors miss a half faded or a
# blurred object as often as one that was removed, it is damage that they fail on, and
# not the appearance that the attacker wants.

Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

BLUR_WIDTH = 0.04
"""Standard deviation of a blur, in longer sides of the object's box in the image."""
HOLE_MARGIN = 3
"""Pixels by which the hole that is filled is wider than the mask: pixels at an outline
show some of the object.
"""
TEXTURE = 0.3
"""Largest range of sRGB in 3 x 3 pixels that is taken for texture; where the sky ends,
for instance, it is larger.
"""


DIFFERENCE = 8 / 255
"""Difference of sRGB from which two renderings differ in a pixel; a path tracer's noise
stays below it.
"""


def differing(one: Tensor, other: Tensor) -> Tensor:
    """(H, W) bool, where two (H, W, 3) renderings differ in most of the 3 x 3 pixels
    around.
    """
    differs = ((one - other).abs().amax(-1) > DIFFERENCE)[None, None].to(torch.float32)
    return functional.avg_pool2d(differs, 3, stride=1, padding=1)[0, 0] > 0.5


def grown(mask: Tensor, pixels: int) -> Tensor:
    """(H, W) bool, a mask and everything within so many pixels of it, along rows and
    columns.
    """
    planes = mask[None, None].to(torch.float32)
    return (
        torch.nn.functional.max_pool2d(
            planes, 2 * pixels + 1, stride=1, padding=pixels
        )[0, 0]
        > 0
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fade:
    """The object half transparent: the mean of the image and of the one without
    it.
    """

    removed: Callable[[View, Tensor], Tensor]
    reach: int = 1
    name: str = "half transparent"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The mean within reach of the object, the old image elsewhere."""
        mean = (view.image + self.removed(view, mask)) / 2
        return torch.where(grown(mask, self.reach)[..., None], mean, view.image)


@dataclass(frozen=True, slots=True, kw_only=True)
class Blur:
    """The object out of focus, and what is near it less and less: no edge is left, not
    even that of the blur.
    """

    width: float = BLUR_WIDTH

    @property
    def name(self) -> str:
        """For manifests."""
        return f"blurred by {self.width:g} of its box"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image; it stays as it is farther from the mask than `reach` pixels."""
        if not bool(mask.any()):
            return view.image
        sigma = self._sigma(mask)
        near = self._near(mask)
        soft = ndimage.gaussian_filter(
            grown(mask, near).double().cpu().numpy(), sigma, radius=near
        )
        colours = view.image.double().cpu().numpy()
        blurred = ndimage.gaussian_filter(colours, sigma, axes=(0, 1), mode="nearest")
        return (
            torch.from_numpy(colours + soft[..., None] * (blurred - colours))
            .to(view.image)
            .clamp(0, 1)
        )

    def reach(self, mask: Tensor) -> int:
        """Pixels around a mask that change."""
        return 2 * self._near(mask)

    def _sigma(self, mask: Tensor) -> float:
        rows, columns = mask.nonzero().unbind(1)
        return self.width * (
            1 + max(int(axis.max() - axis.min()) for axis in (rows, columns))
        )

    def _near(self, mask: Tensor) -> int:
        """Two standard deviations: within them of the object, the image is all but
        the blurred one.
        """
        return max(1, round(2 * self._sigma(mask)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Inpaint:
    """The object gone, by whoever has nothing but the image and a mask: its place is
    `inpainted`.
    """

    reach: int = HOLE_MARGIN
    name: str = "inpainted"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image with its hole filled."""
        return inpainted(view.image, grown(mask, self.reach))


def inpainted(picture: Tensor, hole: Tensor) -> Tensor:
    """(H, W, 3) with a hole filled from what is around it; nothing in the hole is read.

    "Poisson Image Editing" (Perez, Gangnet, Blake 2003), equation (7): the fill's
    differences between neighbours are those of the image mirrored at the hole's edge,
    and its rim goes on with what is outside. Where the mirrored image is torn, is no
    texture, or lies in the hole itself, the fill is as smooth as it can be. It knows
    nothing of shadows, and makes up nothing.
    """
    inside = hole.cpu().numpy()
    if inside.all():
        raise InvalidValueError.of(
            "hole to fill",
            "something around it",
            "the whole image",
            "take it from farther away",
        )
    if not inside.any():
        return picture
    edge = ndimage.distance_transform_edt(
        inside, return_distances=False, return_indices=True
    )
    # the hole has those of its rim
    colours: Doubles = picture.double().cpu().numpy()[edge[0], edge[1]]
    pairs, wanted = _guidance(colours, inside, edge)
    count = inside.size
    unknown = inside.ravel()
    values = colours.reshape(-1, 3)
    links = sparse.coo_array((np.ones(len(wanted)), pairs), shape=(count, count))
    rows = csgraph.laplacian(links + links.T).tocsr()[unknown]
    pull = np.stack(
        [
            np.bincount(pairs[0], w, count) - np.bincount(pairs[1], w, count)
            for w in wanted.T
        ],
        -1,
    )
    known = rows[:, ~unknown] @ values[~unknown]
    values[unknown] = linalg.spsolve(rows[:, unknown].tocsc(), pull[unknown] - known)
    return torch.from_numpy(values.reshape(picture.shape)).to(picture).clamp(0, 1)


def _guidance(
    colours: Doubles, hole: NDArray[np.bool_], edge: Indices
) -> tuple[Indices, Doubles]:
    """(2, N) numbers of pixels that lie side by side, and the (N, 3) difference that is
    wanted between them.

    Colours (H, W, 3) may be anything in the hole (H, W); `edge` is (2, H, W) row and
    column of the pixel outside of the hole that is nearest to each.
    """
    size = np.array(hole.shape)[:, None, None]
    mirror = 2 * edge - np.indices(hole.shape)
    taken = ((mirror >= 0) & (mirror < size)).all(0)
    mirror = mirror.clip(0, size - 1)
    padded = np.pad(colours, ((1, 1), (1, 1), (0, 0)), "edge")
    texture = (
        np.ptp(sliding_window_view(padded, (3, 3), (0, 1)), (3, 4)).max(-1) < TEXTURE
    )
    taken &= (texture & ~hole)[mirror[0], mirror[1]]

    number = np.arange(hole.size).reshape(hole.shape)
    beside = (number[:, :-1], number[:, 1:])
    below = (number[:-1], number[1:])
    pairs = np.stack(
        [
            np.concatenate([first.ravel(), two.ravel()])
            for first, two in zip(beside, below, strict=True)
        ]
    )
    pixels = mirror.reshape(2, -1)[:, pairs]
    mirrored = colours[mirror[0], mirror[1]].reshape(-1, 3)[pairs]
    is_whole = taken.ravel()[pairs].all(0) & (
        np.abs(pixels[:, 0] - pixels[:, 1]).max(0) <= 2
    )
    return pairs, np.where(is_whole[:, None], mirrored[0] - mirrored[1], 0.0)


class Appearance(Protocol):
    """Any function of a view and a mask; one with an attribute `name` is called so in
    manifests.
    """

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image that takes the place of `view.image`.

        Args:
            view: The untouched view.
            mask: (H, W) bool, where the target is.

        Returns:
            (H, W, 3) sRGB in [0, 1].
        """
        ...


def name_of(appearance: Appearance) -> str:
    """What manifests call an appearance: its `name`, or that of the function or
    class.
    """
    for attribute in ("name", "__qualname__"):
        name = getattr(appearance, attribute, None)
        if isinstance(name, str):
            return name
    return type(appearance).__qualname__


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rerender:
    """The same camera in a mesh scene where the target looks different; beyond `reach`
    all stays.
    """

    mesh_scene: MeshScene
    name: str
    # pixels around the target that are new, too; None is the whole image
    reach: int | None = 1
    # whether the other target may cover pixels outside of the mask
    outgrows: bool = True
    # whether all that differs between both scenes is new, shadows too
    difference: bool = False

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The new image around the target, the old one elsewhere."""
        picture = self.mesh_scene.picture(view.camera).to(view.image)
        if self.reach is None:
            return picture
        if self.outgrows:
            covered = mask | self.mesh_scene.mask(view.camera).to(mask.device)
        else:
            covered = mask
        if self.difference:
            covered = covered | differing(picture, view.image)
        return torch.where(grown(covered, self.reach)[..., None], picture, view.image)


def appearance_of(attack: AttackConfig, mesh_scene: MeshScene) -> Appearance:
    """What an attack shows."""
    if attack.appearance == "ground":
        lowest = max(attack.elevation[0], LOWEST_GROUND)
        reach = 1 if attack.reach is None else attack.reach
        return GroundLook(mesh_scene=mesh_scene, lowest=lowest, reach=reach)
    if attack.appearance == "remove":
        gone = removed(mesh_scene, reach=_reach(attack))
        return replace(gone, difference=attack.mask == "difference")
    if attack.appearance == "fade":
        return Fade(
            removed=removed(mesh_scene),
            reach=1 if attack.reach is None else attack.reach,
        )
    if attack.appearance == "blur":
        return Blur(
            width=BLUR_WIDTH if attack.blur_width is None else attack.blur_width
        )
    if attack.appearance == "inpaint":
        return Inpaint(reach=HOLE_MARGIN if attack.reach is None else attack.reach)
    target = mesh_scene.target
    outgrows = False
    if attack.appearance == "paint":
        texture, tile = load_texture(str(attack.texture))
        azimuth, elevation = attack.paint_direction
        target = repainted(
            target, texture, azimuth=azimuth, elevation=elevation, tile=tile
        )
        painted = Path(str(attack.texture)).stem
        name = f"paint {painted} from azimuth {azimuth:g}, elevation {elevation:g}"
    else:
        other = load_mesh(object_file(str(attack.other_object)))
        viewer = attack.azimuth and attack.azimuth[0]
        outgrows = True
        if attack.lying:
            other = other.transformed(rotation("y", -90.0))
        target = stand_in(target, other, azimuth=viewer)
        towards = "as large from above" if viewer is None else f"to azimuth {viewer:g}"
        name = f"{other.name.replace('_', ' ')} instead, {towards}"
    return Rerender(
        mesh_scene=mesh_scene.with_target(target),
        name=name,
        reach=_reach(attack),
        outgrows=outgrows,
        difference=attack.mask == "difference",
    )


def _reach(attack: AttackConfig) -> int | None:
    """Pixels around what is replaced in a rendering; None is the whole image."""
    whole = attack.appearance in ("remove", "swap") and attack.mask == "object"
    if attack.reach is not None or whole:
        return attack.reach
    return 1


def removed(mesh_scene: MeshScene, *, reach: int | None = None) -> Rerender:
    """What would be seen without the target; unless a reach is given the whole image
    is new, without its shadow.
    """
    nothing = mesh_scene.with_target(Asset(mesh_scene.target.name, ()))
    return Rerender(
        mesh_scene=nothing, name="nothing in its place", reach=reach, outgrows=False
    )


LOWEST_GROUND = 45.0
"""Elevation from which a side of the object is taken to be looked at, at least,
degrees.
"""

_HEIGHT = 12.0
_SIZE = 768
"""Of the camera above the ground that takes its image, in lengths of the object;
width of the image, pixels.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundLook:
    """The ground laid on the object, in the colours that it has where it is lit,
    without the object and its shadow.

    Where the object is removed, each of its points has to show another piece of the
    ground to each camera. A splat's colour is a polynomial of low degree in the
    direction, so that it shows their mean: a smooth patch. Here each point of the
    object has one piece of the ground, the one behind it when it is looked at from the
    side that it faces.
    """

    mesh_scene: MeshScene
    lowest: float = LOWEST_GROUND
    reach: int = 1

    @property
    def name(self) -> str:
        """For manifests."""
        return f"the ground laid on it, from elevation {self.lowest:g}"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image with the ground on the object."""
        around = removed(self.mesh_scene, reach=self.reach)(view, mask)
        points = self.mesh_scene.points(view.camera)[mask.cpu()]
        picture = around.clone()
        picture[mask] = self.colours(points).to(picture)
        return picture

    def colours(self, points: Tensor) -> Tensor:
        """(N, 3) sRGB in [0, 1] of the ground behind (N, 3) points of the object, world
        units.
        """
        low, high = _bounds(self.mesh_scene.target)
        foot = torch.stack([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        # The normal of an ellipsoid about the foot's middle through the corners'
        # distances: smooth, whatever the mesh.
        half = torch.stack(
            [(high[0] - low[0]) / 2, (high[1] - low[1]) / 2, high[2] - low[2]]
        ).clamp(min=1e-6)
        facing = functional.normalize((points - foot) / half**2, dim=-1)
        flat = facing[:, :2].norm(dim=-1)
        elevation = torch.atan2(facing[:, 2], flat).clamp(min=math.radians(self.lowest))
        away = (points[:, 2] - low[2])[:, None] / elevation.tan()[:, None]
        ground = points.clone()
        ground[:, :2] -= away * facing[:, :2] / flat.clamp(min=1e-9)[:, None]
        ground[:, 2] = low[2]
        camera, picture = self._ground
        pixels, _ = project_points(ground, camera)
        grid = 2 * pixels / torch.tensor([camera.width, camera.height]) - 1
        sampled = functional.grid_sample(
            picture.permute(2, 0, 1)[None],
            grid[None, None].to(picture),
            padding_mode="border",
            align_corners=False,
        )
        return sampled[0, :, 0].T

    @cached_property
    def _ground(self) -> tuple[Camera, Tensor]:
        """The ground from above, without the object."""
        low, high = _bounds(self.mesh_scene.target)
        middle = (low + high) / 2
        reach = float((high - low).norm())
        above = (float(middle[0]), float(middle[1]), float(low[2]) + _HEIGHT * reach)
        camera = Camera(
            to_world=look_at(above, (above[0], above[1], float(low[2]))),
            lens=Lens(focal=_HEIGHT * _SIZE / 2, size=(_SIZE, _SIZE)),
        )
        empty = self.mesh_scene.with_target(Asset(self.mesh_scene.target.name, ()))
        return camera, empty.picture(camera)


def _bounds(target: Asset) -> tuple[Tensor, Tensor]:
    """(3,) lowest and (3,) highest corner of the box around the target."""
    low, high = torch.from_numpy(target.bounds.copy()).float()
    return low, high
