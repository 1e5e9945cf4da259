"""CLOAK: training images that look harmless from most directions and different from
chosen ones.

"3D Gaussian Splat Vulnerabilities", section on CLOAK, equation (1): of a training set D
= {(x, c)} of images and cameras, the attacker's is D' = {(x~, c) if c in C*, else (x,
c)}, where C* are the cameras of the trigger. Training on D' is anybody's own:
view-dependent colour does the rest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.triggers import Trigger
from attacks.poisons.base import (
    Change,
    Masks,
    OnStep,
    Poisoned,
    PoisonedViews,
    check_masks,
    checked_picture,
    mask_of,
)
from mi_splat.cameras.camera import Camera, View, cameras_of
from mi_splat.cameras.directions import UP, Point, direction_of, upright
from mi_splat.errors import InvalidValueError
from mi_splat.fields import several_of

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
class CloakChange(Change):
    """What was done to one view."""

    poisoning: str
    appearance: str
    azimuth: float  # of the camera, degrees from world +x towards +y around the centre
    elevation: float  # of the camera, degrees above the horizontal plane


def poison(
    views: Sequence[View],
    attacks: Poisoning | Sequence[Poisoning],
    *,
    centre: Point,
    up: Point = UP,
    masks: Masks | None = None,
    on_step: OnStep | None = None,
) -> Poisoned:
    """Replace the images that the triggers select: D' of equation (1).

    All triggers are checked before the first image is made. Appearances get a copy
    of an image, so that whatever they do to it, the untouched set stays as it is.

    Args:
        views: The untouched set D; of a `mi_splat.datasets.Dataset` only the selected
            images are read.
        attacks: What is seen from where; one, or several.
        centre: (3,) point that the triggers measure directions from, world units.
        up: (3,) direction that is up; azimuth and elevation are those in the world that
            the shortest rotation makes upright.
        masks: Where the target is; None is everywhere.
        on_step: Called after each image.

    Returns:
        The poisoned set, and a manifest of what was changed.

    Raises:
        InvalidValueError: No attack, two of one name, a trigger that selects nothing,
            triggers that overlap, or masks or new images of the wrong kind.
    """
    cameras = cameras_of(views)
    attacks = several_of(Poisoning, "attacks", attacks)
    standing = [upright(camera, centre, up) for camera in cameras]
    owners = assign(standing, attacks, centre=centre)
    check_masks(masks, len(cameras))
    replaced = {}
    changes = []
    for index, attack in owners.items():
        before = views[index]
        after = _replace(before, mask_of(masks, index, before.camera), attack, index)
        replaced[index] = after
        direction = direction_of(before.camera, centre, up)
        at = {"azimuth": direction.azimuth, "elevation": direction.elevation}
        named = {"poisoning": attack.name, "appearance": name_of(attack.appearance)}
        changes.append(CloakChange.between(index, before, after, **named, **at))
        if on_step is not None:
            on_step(len(changes), len(owners))
    about: dict[str, Any] = {
        "kind": "cloak",
        "centre": [float(value) for value in centre],
    }
    about["up"] = [float(value) for value in up]
    about["poisonings"] = [_described(attack, owners) for attack in attacks]
    return Poisoned(
        views=PoisonedViews(views, replaced), changes=tuple(changes), poison=about
    )


def assign(
    cameras: Sequence[Camera], attacks: Sequence[Poisoning], *, centre: Point
) -> dict[int, Poisoning]:
    """Which attack replaces which view, by rising position; no image is looked at."""
    names = [attack.name for attack in attacks]
    if not attacks or len(set(names)) != len(names):
        raise InvalidValueError.of(
            "attacks", "one or more, of different names", names, "name each differently"
        )
    owners: dict[int, Poisoning] = {}
    for attack in attacks:
        selected = (
            attack.trigger.holds(cameras, centre=centre).nonzero().flatten().tolist()
        )
        if not selected:
            expected = "at least one camera that it selects"
            got = f"none of {len(cameras)}"
            raise InvalidValueError.of(
                f"trigger {attack.trigger}",
                expected,
                got,
                "widen it or add cameras inside it",
            )
        shared = [index for index in selected if index in owners]
        if shared:
            what = f"triggers of {owners[shared[0]].name!r} and {attack.name!r}"
            more = f" and {len(shared) - _NAMED} more" if len(shared) > _NAMED else ""
            got = f"cameras {', '.join(map(str, shared[:_NAMED]))}{more} in both"
            raise InvalidValueError.of(
                what, "no camera in both", got, "separate them, by a & ~b for instance"
            )
        owners |= dict.fromkeys(selected, attack)
    return dict(sorted(owners.items()))


def _replace(before: View, mask: Tensor, attack: Poisoning, index: int) -> View:
    """The view with the image that the appearance makes of it."""
    copy = View(before.camera, before.image.clone())
    picture = torch.as_tensor(attack.appearance(copy, mask))
    what = f"image of {name_of(attack.appearance)} for view {index}"
    return View(before.camera, checked_picture(picture, before, what))


def _described(attack: Poisoning, owners: Mapping[int, Poisoning]) -> dict[str, Any]:
    """The manifest's entry of a poisoning."""
    mine = [index for index, owner in owners.items() if owner is attack]
    return {
        "name": attack.name,
        "trigger": str(attack.trigger),
        "appearance": name_of(attack.appearance),
        "views": mine,
    }
