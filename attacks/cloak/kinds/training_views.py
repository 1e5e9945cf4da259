"""What one detector reports from the victim's training cameras: on a splat, or in the pictures that are poisoned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from attacks.cloak.kinds.parts import SET
from attacks.cloak.kinds.poisoned import KeptAppearance
from attacks.cloak.kinds.rendering import renderer_of
from attacks.cloak.kinds.seen import NO_ATTACK, SeenConfig, checked_detector, observation_cells
from attacks.cloak.setup import Setup
from attacks.observe.look import camera_cells
from attacks.observe.rows import SUFFIX, TRAINING, Cell, frame_of, write_rows
from attacks.observe.views import detect_pictures
from mi_splat.cameras import Camera, View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.metrics import psnr

if TYPE_CHECKING:
    from mi_splat.ledger import Out

LOOK = "look of "
"""What stands before an attack's name in the name of the input with the pictures that it wants to be seen."""


def run(config: SeenConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write a row for each camera; its condition is the attack that poisons the picture, empty for a benign one.

    Inputs are a `splat`, which is looked at from all training cameras, or `pictures`, a set of which those of poisoned
    cameras are, or all where there is no attack. With `look of NAME` for each attack, rows have the PSNR on the object
    against that look, which is what a camera could take of what the attack wants to be seen; None where the two are the
    same.
    """
    setup = Setup(config.study(inputs))
    detector, cameras = checked_detector(config, inputs), setup.training_cameras
    owners = {} if config.asked.attack == NO_ATTACK else setup.owners(config.asked.seeds[0])
    chosen, errors = list(range(len(cameras))), dict[int, float | None]()
    if "splat" in inputs:
        scene, render = load_splat(inputs["splat"]), renderer_of(setup.study)
        pictures = [lambda camera=camera: render(scene, camera) for camera in cameras]
    else:
        views = load_dataset(inputs["pictures"] / SET, split="train", background=setup.study.scene.background)
        pictures = [lambda view=view: views[view].image for view in chosen]
        chosen = sorted(owners) or chosen
        looks = {name: inputs[LOOK + name] for name in owners.values() if LOOK + name in inputs}
        with tracing_variant():
            errors = {view: _psnr(setup, views[view], looks[owners[view]]) for view in chosen if looks}
    by_camera: dict[Camera, Callable[[], Tensor]] = {cameras[view]: pictures[view] for view in chosen}
    looking, rows = list(by_camera), list[dict[str, Cell]]()
    boxes = [setup.box(camera) for camera in looking]
    for seen in detect_pictures(lambda camera: by_camera[camera](), looking, [detector], boxes=boxes):
        out.progress(f"{detector.name} looks", len(rows) + 1, len(looking))
        view = chosen[seen.view]
        ids: dict[str, Cell] = {"detector": seen.detector, "view": view, "condition": owners.get(view)}
        cells = {**camera_cells(seen.camera, seen.box), **observation_cells(setup.study, seen, detector.classes)}
        rows.append({**ids, **cells, **({"appearance_psnr": errors[view]} if errors else {})})
    write_rows(frame_of(rows), out / f"{TRAINING}{SUFFIX}")


def _psnr(setup: Setup, view: View, look: Path) -> float | None:
    """PSNR of a picture on the object against an attack's look, dB; None where they are the same."""
    mask = setup.mesh_scene.mask(view.camera)
    wanted = KeptAppearance(name="", folder=look)(view, mask)
    value = float(psnr(view.image[mask], wanted[mask])) if bool(mask.any()) else math.inf
    return value if math.isfinite(value) else None
