"""How true a splat's images are far from all triggers, and how far they change on the
way into the hiding one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from attacks.cloak.appearances import grown
from attacks.cloak.config import AttackConfig, switching
from attacks.cloak.kinds.pictures import read_pictures
from attacks.cloak.setup import Setup
from attacks.observe.rows import (
    DEPTH,
    FIDELITY,
    SUFFIX,
    TRANSITION,
    Row,
    frame_with,
    write_rows,
)
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import direction_of
from mi_splat.io import load_splat
from mi_splat.io.images import through_png
from mi_splat.maths.metrics import psnr, ssim

if TYPE_CHECKING:
    from mi_splat.ledger import Out

LEAST_DIFFERENCE = 1 / 255
"""Root mean square difference of the two appearances on the target under which a
fraction has no meaning.
"""
MARGIN = 10
"""Pixels around the object, in images of 256 x 256, that count as the object's."""
FIDELITY_COLUMNS = ("view", "elevation", "psnr", "ssim", "object_psnr")
TRANSITION_COLUMNS = (
    *(
        "meridian",
        "elevation",
        "surroundings_psnr",
        "intended_surroundings_psnr",
        "appearance_psnr",
        "fraction",
    ),
)


def run(config: Setup, inputs: Mapping[str, Path], out: Out) -> None:
    """Compare the `splat` with true images, and on arcs with `benign` and `hidden`
    ones; write two tables.

    Of the true images, `far` are far outside of all triggers. Those of `edge` are
    outside beside one, and give a PSNR on the object, too.
    """
    setup = config.given(inputs)
    scene = load_splat(inputs["splat"])
    render = setup.renderer()

    def picture(camera: Camera) -> Tensor:
        with torch.no_grad():
            return through_png(render(scene, camera))

    def compared(
        view: int, camera: Camera, true: Tensor, mask: Tensor | None = None
    ) -> Row:
        image = picture(camera)
        return {
            "view": view,
            "elevation": direction_of(camera, setup.centre).elevation,
            "psnr": float(psnr(image, true)),
            "ssim": float(ssim(image, true)),
            "object_psnr": (
                None if mask is None else float(psnr(image[mask], true[mask]))
            ),
        }

    far, edge = (read_pictures(inputs[name]) for name in ("far", "edge"))
    fidelity = [
        compared(*at, true)
        for at, true in zip(setup.reference_cameras, far.images, strict=True)
    ]
    beside = zip(setup.edge_cameras, edge.images, edge.masks, strict=True)
    fidelity += [
        compared(*at, true, mask) for at, true, mask in beside if bool(mask.any())
    ]
    write_rows(frame_with(fidelity, FIDELITY_COLUMNS), out / f"{FIDELITY}{SUFFIX}")
    attack = switching(config.attacks)
    transition = list[Row]()
    if attack is not None:
        benign, hidden = (read_pictures(inputs[name]) for name in ("benign", "hidden"))
        arc = zip(
            setup.arc_cameras, benign.images, hidden.images, benign.masks, strict=True
        )
        transition = [
            _blend(setup, attack, on_arc, picture(on_arc[1]), *others)
            for on_arc, *others in arc
            if bool(others[2].any()) and differ(*others)
        ]
    columns: tuple[str, ...] = TRANSITION_COLUMNS
    if attack is not None:
        columns += (f"{DEPTH}{attack.name}",)
    write_rows(frame_with(transition, columns), out / f"{TRANSITION}{SUFFIX}")


def _blend(
    setup: Setup,
    attack: AttackConfig,
    on_arc: tuple[int, Camera],
    seen: Tensor,
    benign: Tensor,
    hidden: Tensor,
    mask: Tensor,
) -> Row:
    """What one image of an arc says."""
    (meridian, camera), centre = on_arc, setup.centre
    beside = ~grown(mask, max(1, round(MARGIN * setup.cameras.size / 256)))
    return {
        "meridian": meridian,
        "elevation": direction_of(camera, centre).elevation,
        f"{DEPTH}{attack.name}": attack.cone.angle_to_edge(camera, centre=centre),
        "fraction": transition_fraction(seen, benign, hidden, mask),
        "surroundings_psnr": float(psnr(seen[beside], benign[beside])),
        "intended_surroundings_psnr": float(psnr(seen[beside], hidden[beside])),
        "appearance_psnr": float(psnr(seen[mask], hidden[mask])),
    }


def transition_fraction(
    picture: Tensor, benign: Tensor, hidden: Tensor, mask: Tensor
) -> float:
    """Fraction of the way from one appearance to another, by least squares over a mask;
    not clipped to [0, 1].
    """
    seen, low, high = (
        part.detach().to(torch.float64)[mask] for part in (picture, benign, hidden)
    )
    change = high - low
    return float((seen - low).mul(change).sum() / change.square().sum())


def differ(benign: Tensor, hidden: Tensor, mask: Tensor) -> bool:
    """Whether two (H, W, 3) appearances differ enough on an (H, W) bool mask for a
    transition to mean anything.
    """
    change = (hidden - benign).detach().to(torch.float64)[mask]
    return float(change.square().mean().sqrt()) >= LEAST_DIFFERENCE
