"""CLOAK: training pictures that look harmless from most directions and different from chosen ones.

"3D Gaussian Splat Vulnerabilities", section on CLOAK, equation (1): of a training set D = {(x, c)} of pictures and
cameras, the attacker's is D' = {(x~, c) if c in C*, else (x, c)}, where C* are the cameras of the trigger. Training on
D' is anybody's own: view-dependent colour does the rest.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, overload

import torch
from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import Camera, View, ViewSet, cameras_of
from mi_splat.directions import Point, direction_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import several_of

OnStep = Callable[[int, int], None]
"""Called after each picture with the number finished and the number wanted."""

Masks = Sequence[Tensor] | Callable[[Camera], Tensor]
"""(H, W) bool masks of the target: one for each view, or a function of the camera (such as `MeshScene.mask`)."""

_NAMED = 10
"""How many cameras an error names."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poisoning:
    """One hidden appearance and from where it is seen.

    Attributes:
        name: For manifests and errors.
        trigger: From where.
        appearance: What is seen.
    """

    name: str
    trigger: Trigger
    appearance: Appearance


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What was done to one view.

    Attributes:
        index: Position of the view.
        poisoning: Name of the poisoning.
        appearance: Name of the appearance.
        azimuth: Of the camera, degrees from world +x towards +y around the centre.
        elevation: Of the camera, degrees above the horizontal plane.
        pixels: Pixels in the picture.
        pixels_changed: Pixels of which a channel has another value.
        sha256_before: Of the untouched picture: its float32 values, little-endian, row by row.
        sha256_after: Of the new picture.
    """

    index: int
    poisoning: str
    appearance: str
    azimuth: float
    elevation: float
    pixels: int
    pixels_changed: int
    sha256_before: str
    sha256_after: str


@dataclass(frozen=True, slots=True, eq=False)
class PoisonedViews(ViewSet):
    """A set of views with some replaced; the others are the very objects that the set gives, read when asked for.

    Attributes:
        untouched: The set.
        replaced: New views by position.
    """

    untouched: Sequence[View]
    replaced: Mapping[int, View]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view; poisoning leaves them as they are."""
        return cameras_of(self.untouched)

    def __len__(self) -> int:
        """Number of views."""
        return len(self.untouched)

    @overload
    def __getitem__(self, index: int) -> View: ...

    @overload
    def __getitem__(self, index: slice) -> list[View]: ...

    def __getitem__(self, index: int | slice) -> View | list[View]:
        """A view, or a list of some.

        Raises:
            IndexError: There is no such view.
        """
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        return self.replaced[index] if index in self.replaced else self.untouched[index]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poisoned:
    """A poisoned training set.

    Attributes:
        views: D' of equation (1), as long as the untouched set and in its order.
        changes: Every view that was replaced, in the order of positions.
        poisonings: Which appearances there are and from where.
        centre: (3,) point that directions are measured from, world units.
    """

    views: PoisonedViews
    changes: tuple[Change, ...]
    poisonings: tuple[Poisoning, ...]
    centre: tuple[float, float, float]

    @property
    def manifest(self) -> dict[str, Any]:
        """Everything that was done, as JSON can hold it."""
        return {
            "views": len(self.views),
            "changed": len(self.changes),
            "centre": list(self.centre),
            "poisonings": [
                {
                    "name": poisoning.name,
                    "trigger": str(poisoning.trigger),
                    "appearance": name_of(poisoning.appearance),
                    "views": [change.index for change in self.changes if change.poisoning == poisoning.name],
                }
                for poisoning in self.poisonings
            ],
            "changes": [asdict(change) for change in self.changes],
        }


def poison(
    views: Sequence[View],
    attacks: Poisoning | Sequence[Poisoning],
    *,
    centre: Point,
    masks: Masks | None = None,
    on_step: OnStep | None = None,
) -> Poisoned:
    """Replace the pictures that the triggers select: D' of equation (1).

    All triggers are looked at before the first picture is made. Appearances get a copy of a picture, so that whatever
    they do to it, the untouched set stays as it is.

    Args:
        views: The untouched set D; of a `mi_splat.datasets.Dataset` only the selected pictures are read.
        attacks: What is seen from where; one, or several.
        centre: (3,) point that the triggers measure directions from, world units.
        masks: Where the target is; None is everywhere.
        on_step: Called after each picture.

    Raises:
        InvalidValueError: No attack, two of one name, a trigger that selects nothing, triggers that overlap, or masks
            or new pictures of the wrong kind.
    """
    cameras, attacks = cameras_of(views), several_of(Poisoning, "attacks", attacks)
    owners = assign(cameras, attacks, centre=centre)
    if masks is not None and not callable(masks) and len(masks) != len(cameras):
        raise InvalidValueError(message("masks", f"one for each of {len(cameras)} views", len(masks), "pass them all"))
    replaced, changes = {}, []
    for index, attack in owners.items():
        before = views[index]
        after = _replace(before, _mask(masks, index, before.camera), attack, index)
        replaced[index] = after
        changes.append(_change(index, attack, before, after, centre))
        if on_step is not None:
            on_step(len(changes), len(owners))
    x, y, z = (float(value) for value in centre)
    return Poisoned(
        views=PoisonedViews(views, replaced), changes=tuple(changes), poisonings=tuple(attacks), centre=(x, y, z)
    )


def assign(cameras: Sequence[Camera], attacks: Sequence[Poisoning], *, centre: Point) -> dict[int, Poisoning]:
    """Which attack replaces which view, by rising position; no picture is looked at.

    Args:
        cameras: Those of the untouched set, in its order.
        attacks: What is seen from where.
        centre: (3,) point that the triggers measure directions from, world units.

    Raises:
        InvalidValueError: As `poison` does of attacks and triggers.
    """
    names = [attack.name for attack in attacks]
    if not attacks or len(set(names)) != len(names):
        raise InvalidValueError(message("attacks", "one or more, of different names", names, "name each differently"))
    owners: dict[int, Poisoning] = {}
    for attack in attacks:
        selected = attack.trigger.select(cameras, centre=centre).nonzero().flatten().tolist()
        shared = [index for index in selected if index in owners]
        if shared:
            what = f"triggers of {owners[shared[0]].name!r} and {attack.name!r}"
            more = f" and {len(shared) - _NAMED} more" if len(shared) > _NAMED else ""
            got = f"cameras {', '.join(map(str, shared[:_NAMED]))}{more} in both"
            raise InvalidValueError(message(what, "no camera in both", got, "separate them, by a & ~b for instance"))
        owners |= dict.fromkeys(selected, attack)
    return dict(sorted(owners.items()))


def _mask(masks: Masks | None, index: int, camera: Camera) -> Tensor:
    """(H, W) bool mask of one view."""
    size = (camera.height, camera.width)
    if masks is None:
        return torch.ones(size, dtype=torch.bool)
    mask = masks(camera) if callable(masks) else masks[index]
    if tuple(mask.shape) != size or mask.dtype != torch.bool:
        got = f"{mask.dtype} of shape {tuple(mask.shape)}"
        raise InvalidValueError(message(f"mask of view {index}", f"bool of shape {size}", got, "make it fit the view"))
    return mask


def _replace(before: View, mask: Tensor, attack: Poisoning, index: int) -> View:
    """The view with the picture that the appearance makes of it."""
    copy = View(before.camera, before.image.clone())
    image = torch.as_tensor(attack.appearance(copy, mask)).detach().to(before.image).clone()
    what = f"picture of {name_of(attack.appearance)} for view {index}"
    if image.shape != before.image.shape:
        expected, got = f"shape {tuple(before.image.shape)}", tuple(image.shape)
        raise InvalidValueError(message(what, expected, got, "return a picture of the view's size"))
    low, high = float(image.min()), float(image.max())
    if not (low >= 0 and high <= 1):  # nor NaN
        raise InvalidValueError(message(what, "sRGB in [0, 1]", f"{low:.4g} to {high:.4g}", "clip it"))
    return View(before.camera, image)


def _change(index: int, attack: Poisoning, before: View, after: View, centre: Point) -> Change:
    """The manifest's entry of one view."""
    direction = direction_of(before.camera, centre)
    differs = (before.image != after.image).any(-1)
    return Change(
        index=index,
        poisoning=attack.name,
        appearance=name_of(attack.appearance),
        azimuth=direction.azimuth,
        elevation=direction.elevation,
        pixels=differs.numel(),
        pixels_changed=int(differs.sum()),
        sha256_before=_digest(before.image),
        sha256_after=_digest(after.image),
    )


def _digest(image: Tensor) -> str:
    """SHA-256 of a picture's values."""
    values = image.detach().to("cpu", torch.float32).contiguous().numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()
