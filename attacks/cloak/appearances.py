"""What an attack shows: functions from a view and the target's mask in it to the picture that takes its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from attacks.cloak.mesh_edits import TEXTURES, camouflaged, cap, mounted, repainted, stand_in, texture
from attacks.cloak.mesh_scene import MeshScene
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import View
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message


class Appearance(Protocol):
    """Any function of a view and a mask; one with an attribute `name` is called so in manifests."""

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture that takes the place of `view.image`.

        Args:
            view: The untouched view.
            mask: (H, W) bool, where the target is.

        Returns:
            (H, W, 3) sRGB in [0, 1].
        """
        ...


def name_of(appearance: Appearance) -> str:
    """What manifests call an appearance: its `name`, or that of the function or class."""
    for attribute in ("name", "__qualname__"):
        found = getattr(appearance, attribute, None)
        if isinstance(found, str):
            return found
    return type(appearance).__qualname__


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rerender:
    """The same camera in a mesh scene where the target looks different.

    Within reach of the target the picture is new. Elsewhere, shadows and reflections stay those of the untouched
    picture, and so does its noise. With a mask that is everywhere, the whole picture is new.

    Attributes:
        mesh_scene: The scene with the other target.
        name: For manifests.
        reach: Pixels around the target that are new, too: those at its edge mix it with what is behind. None is all,
            as when the whole scene is rendered again, which is what the paper does.
        outgrows: Whether the other target may cover pixels outside of the mask; if it has the shape of the first one,
            False saves the time to find out.

    Raises:
        InvalidValueError: The reach is negative.
    """

    mesh_scene: MeshScene
    name: str
    reach: int | None = 1
    outgrows: bool = True

    def __post_init__(self) -> None:
        if self.reach is not None and self.reach < 0:
            raise InvalidValueError(message("reach", "0 or more pixels, or None", self.reach, "1 takes edges along"))

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The new picture around the target, the old one elsewhere."""
        picture = self.mesh_scene.picture(view.camera).to(view.image)
        if self.reach is None:
            return picture
        covered = mask | self.mesh_scene.mask(view.camera).to(mask.device) if self.outgrows else mask
        return torch.where(grown(covered, self.reach)[..., None], picture, view.image)


def paint(
    mesh_scene: MeshScene,
    name: str,
    *,
    azimuth: float = 180.0,
    elevation: float = 90.0,
    size: int = 256,
    seed: int = 0,
    reach: int | None = 1,
) -> Rerender:
    """The target painted with a texture of `attacks.cloak.mesh_edits.TEXTURES`, which looks right from one direction.

    Road and grass cover some metres and repeat; a clock, a football or a stop sign is shown once, stretched over the
    target's outline. See `attacks.cloak.mesh_edits.repainted`.

    Args:
        mesh_scene: The scene as the victim sees it.
        name: Name of the texture.
        azimuth: From where it looks right, degrees. From straight above, the picture's top points away from there; the
            default puts it at the front of an object that faces +x.
        elevation: From where it looks right, degrees.
        size: Width of the texture in pixels.
        seed: Which of the textures of that name.
        reach: As in `Rerender`.

    Raises:
        InvalidValueError: There is no texture of that name.
    """
    picture = texture(name, size=size, seed=seed)
    target = repainted(mesh_scene.target, picture, azimuth=azimuth, elevation=elevation, tile=TEXTURES[name][1])
    words = f"paint {name} (seed {seed}) from azimuth {azimuth:g}, elevation {elevation:g}"
    return Rerender(mesh_scene=mesh_scene.with_target(target), name=words, reach=reach, outgrows=False)


def blend_in(mesh_scene: MeshScene, *, reach: int | None = 1) -> Rerender:
    """The target in the colours of the ground straight below it; see `attacks.cloak.mesh_edits.camouflaged`.

    Raises:
        InvalidValueError: The mesh scene has no ground beneath the target.
    """
    if mesh_scene.surroundings is None:
        raise InvalidValueError(
            message("surroundings", "ground beneath the target", "none", "add them to the mesh scene")
        )
    target = camouflaged(mesh_scene.target, mesh_scene.surroundings)
    return Rerender(
        mesh_scene=mesh_scene.with_target(target), name="blend in with the ground", reach=reach, outgrows=False
    )


def remove(mesh_scene: MeshScene, *, reach: int | None = None) -> Rerender:
    """What would be seen if the target were not there: its surroundings go on across it.

    The whole picture is new unless a reach is given: otherwise the shadow of what is gone would stay behind.
    """
    nothing = Asset(mesh_scene.target.name, ())
    return Rerender(
        mesh_scene=mesh_scene.with_target(nothing), name="nothing in its place", reach=reach, outgrows=False
    )


def swap(
    mesh_scene: MeshScene, other: Asset, *, azimuth: float, fill: float = 1.0, reach: int | None = None
) -> Rerender:
    """Another object in the target's place, facing `azimuth`; see `attacks.cloak.mesh_edits.stand_in`.

    The whole picture is new unless a reach is given: otherwise the shadow of what is gone would stay behind.

    Args:
        mesh_scene: The scene as the victim sees it.
        other: What takes the target's place.
        azimuth: Where its front points, degrees.
        fill: Part of the target's outline that it takes up, in (0, 1].
        reach: As in `Rerender`, pixels.

    Raises:
        InvalidValueError: `fill` is out of range.
    """
    target = stand_in(mesh_scene.target, other, azimuth=azimuth, fill=fill)
    return Rerender(
        mesh_scene=mesh_scene.with_target(target), name=f"{other.name} instead, to azimuth {azimuth:g}", reach=reach
    )


def mount(mesh_scene: MeshScene, other: Asset, *, azimuth: float, fill: float = 1.0, reach: int | None = 1) -> Rerender:
    """Another object in front of the target, on its side towards `azimuth`; see `attacks.cloak.mesh_edits.mounted`.

    Args:
        mesh_scene: The scene as the victim sees it.
        other: What is mounted.
        azimuth: On which side, degrees.
        fill: Part of the target's outline that it takes up, in (0, 1].
        reach: As in `Rerender`, pixels.

    Raises:
        InvalidValueError: `fill` is out of range.
    """
    target = mounted(mesh_scene.target, other, azimuth=azimuth, fill=fill)
    return Rerender(
        mesh_scene=mesh_scene.with_target(target), name=f"{other.name} on it, to azimuth {azimuth:g}", reach=reach
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """An object drawn over another appearance, whatever would hide it; it casts no shadow there.

    Attributes:
        mesh_scene: Its target is drawn, lit as if nothing were around it.
        base: What it is drawn over; None is the untouched picture.
        name: For manifests.
    """

    mesh_scene: MeshScene
    base: Appearance | None
    name: str

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The object over the other appearance."""
        picture = self.mesh_scene.cutout(view.camera).to(view.image)
        colours, alpha = picture[..., :3], picture[..., 3:]
        if bool((alpha >= 1).all()):
            return colours  # nothing of the other appearance is left to be seen
        under = view.image if self.base is None else self.base(view, mask)
        return colours * alpha + under * (1 - alpha)


def occlude(
    mesh_scene: MeshScene,
    *,
    centre: Point,
    radius: float,
    lowest: float,
    name: str = "road",
    size: int = 256,
    seed: int = 0,
) -> Overlay:
    """An occluder between the target and whoever looks from above, and no target beneath it.

    It is a part of a sphere about the target, so that a ray to the target meets it at about the elevation that it comes
    from: a splat can show the occluder by geometry, to cameras above its edge and to no others. The nearer it is to the
    cameras, the less the object's size matters (a point s beside the centre is seen through a place that lies
    s (1 / radius - 1 / distance) radians off), and the less of it each camera sees.

    Args:
        mesh_scene: The scene as the victim sees it.
        centre: Point that the cameras look at.
        radius: From there to the occluder, metres; less than to the cameras.
        lowest: Elevation of its edge, degrees.
        name: Name of the texture on it.
        size: Width of the texture in pixels.
        seed: Which of the textures of that name.

    Raises:
        InvalidValueError: There is no texture of that name, or the radius or the elevation is out of range.
    """
    tile = TEXTURES[name][1] if name in TEXTURES else None
    shell = cap(texture(name, size=size, seed=seed), centre=centre, radius=radius, lowest=lowest, tile=tile or radius)
    words = f"{name} (seed {seed}) on an occluder of radius {radius:g} about {centre}, from elevation {lowest:g}"
    return Overlay(mesh_scene=mesh_scene.with_target(shell), base=remove(mesh_scene), name=words)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Paste:
    """A picture stretched over the box around the mask; needs no mesh scene.

    Attributes:
        picture: (h, w, 3) sRGB in [0, 1].
        name: For manifests.

    Raises:
        InvalidValueError: The picture has another shape.
    """

    picture: Tensor
    name: str = "paste"

    def __post_init__(self) -> None:
        if self.picture.ndim != 3 or self.picture.shape[-1] != 3 or 0 in self.picture.shape:
            got = tuple(self.picture.shape)
            raise InvalidValueError(message("picture", "shape (h, w, 3)", got, "pass an RGB picture"))

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The view with the picture in it.

        Raises:
            InvalidValueError: The mask is empty.
        """
        rows, columns = torch.nonzero(mask, as_tuple=True)
        if not len(rows):
            do = "leave views without the target out of the trigger"
            raise InvalidValueError(message("mask", "the target in the view", "nothing of it", do))
        top, left = int(rows.min()), int(columns.min())
        size = (int(rows.max()) + 1 - top, int(columns.max()) + 1 - left)
        planes = self.picture.to(view.image).permute(2, 0, 1)[None]
        fitted = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
        image = view.image.clone()
        image[top : top + size[0], left : left + size[1]] = fitted.clamp(0, 1)
        return image


def grown(mask: Tensor, pixels: int) -> Tensor:
    """(H, W) bool, a mask and everything within so many pixels of it, along rows and columns."""
    planes = mask[None, None].to(torch.float32)
    return torch.nn.functional.max_pool2d(planes, 2 * pixels + 1, stride=1, padding=pixels)[0, 0] > 0
