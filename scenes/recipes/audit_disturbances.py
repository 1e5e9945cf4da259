"""Sets of images that something harmless disturbs, to measure the audit of images on:
`python -m scenes.recipes.audit_disturbances FOLDER FILE.csv [FIRST [COUNT]]`.

Sets are drawn as those of `scenes.recipes.audit_images` are. The lens darkens the
corners (*vignette*); exposure changes from the first row of an image to the last, in
each image in another way (*rolling*); the sun moves while images are taken one after
the other (*moving sun*); or another object stands somewhere in some of the images, each
time elsewhere (*passers-by*). The first four of eight sets are honest, and in the
others an attacker who removes the object from above hides behind the disturbance.
"""

import dataclasses
import json
import random
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.setup import Setup
from attacks.poisons.base import poisoned
from attacks.poisons.writing import write_poisoned
from mi_splat.audit.images import audit_images
from mi_splat.cameras.camera import View
from mi_splat.capture.mesh import Asset, rotation, scaling, translation
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import Dataset, load_dataset
from scenes.recipes.audit_images import (
    HONEST,
    OBJECTS,
    SKY,
    VISIBLE,
    Drawn,
    add,
    captured,
    drawn,
    read,
    row_of,
)
from scenes.recipes.objects import build

DISTURBANCES = ("vignette", "rolling", "moving sun", "passers-by")
FIRST_NUMBER = 100_000  # of the draws, so that no set is one of the other recipe
CHOSEN_ON = 16  # sets, the first, that were looked at
CORNER = (0.2, 0.5)  # share of light that a corner loses
ROLLING = 0.2  # share by which the first and the last row are brighter or darker
ARC = (60.0, 120.0)  # degrees of azimuth by which the sun moves
MOMENTS = 8  # places of the sun
PASSING = 0.3  # share of images with another object
SIZE = (0.7, 1.3)  # of this object, in the size of the one that is captured
AWAY = (0.9, 1.6)  # its distance, in the diagonal of that one


@dataclass(frozen=True, kw_only=True, eq=False)
class Crowded(Setup):
    """A setup with another object on the ground."""

    passer: Asset

    @cached_property
    def mesh_scene(self) -> MeshScene:
        """The attacker's copy of the scene, with the other object."""
        scene = super().mesh_scene
        meshes = (*scene.surroundings.meshes, *self.passer.meshes)
        return dataclasses.replace(scene, surroundings=Asset("surroundings", meshes))


def disturbed(number: int, folder: Path) -> tuple[Drawn, str]:
    """A set by its number, and what disturbs it."""
    is_poisoned = number % (2 * len(DISTURBANCES)) >= len(DISTURBANCES)
    kind = "overhead" if is_poisoned else HONEST
    one = drawn(FIRST_NUMBER + number, folder, kind)
    how = DISTURBANCES[number % len(DISTURBANCES)]
    return dataclasses.replace(one, name=f"disturbed-{number:03d}"), how


def setups(one: Drawn, how: str, count: int, chance: random.Random) -> list[Setup]:
    """The scene of each image as it is when the image is taken."""
    plain = one.setup
    if how == "moving sun":
        arc = chance.uniform(*ARC)
        moved = []
        for moment in range(MOMENTS):
            moved_by = arc * moment / (MOMENTS - 1)
            azimuth = (plain.scene.sun_azimuth + moved_by) % 360
            scene = dataclasses.replace(plain.scene, sun_azimuth=azimuth)
            moved.append(dataclasses.replace(plain, scene=scene))
        return [moved[number * MOMENTS // count] for number in range(count)]
    if how != "passers-by":
        return [plain] * count
    other = chance.choice([name for name in OBJECTS if name != one.thing])
    passer = build(other, one.seed).body
    result = []
    for _ in range(count):
        if chance.random() > PASSING:
            result.append(plain)
            continue
        result.append(_crowded(plain, passer, chance))
    return result


def _crowded(plain: Setup, passer: Asset, chance: random.Random) -> Setup:
    """A setup with a passer-by somewhere beside the object."""
    diagonal = _diagonal(plain.target)
    factor = chance.uniform(*SIZE) * diagonal / _diagonal(passer)
    towards = chance.uniform(0.0, 2 * np.pi)
    away = chance.uniform(*AWAY) * diagonal
    place = (away * np.cos(towards), away * np.sin(towards), 0.0)
    turned = rotation("z", chance.uniform(0.0, 360.0))
    matrix = translation(*place) @ turned @ scaling(factor, factor, factor)
    fields = {
        field.name: getattr(plain, field.name) for field in dataclasses.fields(plain)
    }
    return Crowded(**fields, passer=passer.transformed(matrix))


def _diagonal(asset: Asset) -> float:
    low, high = asset.bounds.astype(float)
    return float(np.linalg.norm(high - low))


def exposed(image: Tensor, how: str, strength: float) -> Tensor:
    """An image as a lens or a shutter leaves it; (H, W, 3) sRGB."""
    height, width = image.shape[:2]
    down = torch.linspace(-1, 1, height)[:, None, None]
    if how == "rolling":
        return (image * (1 + strength * down)).clamp(0, 1)
    across = torch.linspace(-1, 1, width)[None, :, None]
    return image * (1 - strength * (down.square() + across.square()) / 2)


def made(one: Drawn, how: str, folder: Path) -> tuple[Dataset, Tensor]:
    """A set, and (V,) which of its images show a poison; it is made if it is not
    there.
    """
    target = folder / one.name
    truth = folder / f"{one.name}.json"
    if not truth.exists():
        views = captured(one, folder)
        with tracing_variant():
            images, changed = _images(one, how, views)
        write_poisoned(target, views, poisoned(views, dict(enumerate(images)), {}))
        truth.write_text(json.dumps(changed) + "\n")
    changed = json.loads(truth.read_text())
    return load_dataset(target, background=SKY), torch.tensor(changed)


def _images(one: Drawn, how: str, views: Dataset) -> tuple[list[Tensor], list[bool]]:
    """The images of a set, and whether each shows a poison."""
    chance = random.Random(one.seed)
    scenes = setups(one, how, len(views), chance)
    attacks = {setup: setup.poisonings() for setup in scenes}
    corner = chance.uniform(*CORNER)
    images = []
    changed = []
    for view, setup in zip(views, scenes, strict=True):
        image = view.image
        if setup is not one.setup:
            image = setup.mesh_scene.picture(view.camera)
        shown = _poisoned(setup, attacks[setup], View(view.camera, image))
        changed.append(float((shown != image).any(-1).double().mean()) > VISIBLE)
        if how == "vignette":
            shown = exposed(shown, how, corner)
        if how == "rolling":
            shown = exposed(shown, how, chance.uniform(-ROLLING, ROLLING))
        images.append(shown)
    return images, changed


def _poisoned(setup: Setup, attacks: list[Poisoning], view: View) -> Tensor:
    """An image after the attack, if there is one that changes it."""
    cameras = [view.camera]
    holds = [attack.trigger.holds(cameras, centre=setup.centre) for attack in attacks]
    if not any(bool(selected) for selected in holds):
        return view.image
    masks = setup.mesh_scene.mask
    done = poison([view], attacks, centre=setup.centre, masks=masks)
    return done.views[0].image


def measure(folder: Path, file: Path, numbers: Iterable[int]) -> None:
    """Make and audit the sets that have no row."""
    folder.mkdir(parents=True, exist_ok=True)
    known = {row["set"] for row in read(file)}
    for number in numbers:
        one, how = disturbed(number, folder)
        if one.name in known:
            continue
        views, changed = made(one, how, folder)
        start = time.process_time()
        audit = audit_images(views)
        seconds = round(time.process_time() - start, 1)
        kind = f"{one.kind}, {how}"
        about = {"set": one.name, "kind": kind, "object": one.thing}
        add(file, row_of(audit, changed, **about, seconds=seconds))


def main(folder: str, file: str, first: str = "0", count: str = "48") -> None:
    """Measure sets."""
    numbers = range(int(first), int(first) + int(count))
    measure(Path(folder), Path(file), numbers)


if __name__ == "__main__":
    main(*sys.argv[1:])
