"""What detectors report of a splat from cameras that no training used, and how true its pictures are there."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks.cloak.study import setup
from attacks.cloak.study.config import Attack, Study, essentials
from attacks.cloak.study.pipeline import DONE, Workshop
from attacks.cloak.transition import differ, share_between
from attacks.detectors.base import Detections, Detector
from attacks.objectives import confidence
from mi_splat.cameras import Camera
from mi_splat.directions import bearing
from mi_splat.io.documents import save_json
from mi_splat.io.images import through_png
from mi_splat.metrics import psnr, ssim
from mi_splat.scene import scene_hash

BATCH = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """One splat from one camera, as one detector sees it.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        detector: Its name.
        view: Number of the camera.
        azimuth: Of the camera, degrees.
        elevation: Of the camera, degrees.
        depths: For each attack, degrees inside its trigger; outside < 0.
        scores: For the object's own class and for each class that is wanted, the highest confidence with which it is
            reported on the object: 0 without such a detection that overlaps its box by half.
        loose: The same for the object's own class and a tenth of the box: whether it is found at all.
    """

    splat: str
    seed: int
    detector: str
    view: int
    azimuth: float
    elevation: float
    depths: Mapping[str, float]
    scores: Mapping[str, float]
    loose: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Likeness:
    """How near a splat's picture is to the true one of the scene as it is.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        view: Number of the camera.
        elevation: Of the camera, degrees.
        psnr: Of the whole picture, dB.
        ssim: Of the whole picture.
    """

    splat: str
    seed: int
    view: int
    elevation: float
    psnr: float
    ssim: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Shade:
    """How far a splat's picture is on the way from the benign to the hidden look.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        arc: Number of the meridian.
        elevation: Of the camera, degrees.
        share: See `attacks.cloak.transition.share_between`.
    """

    splat: str
    seed: int
    arc: int
    elevation: float
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """A trained splat.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        gaussians: Their number.
        file: Where it is.
        hash: See `mi_splat.scene.scene_hash`.
        commit: Of the checkout that trained it, which may be an earlier one than that of the summary; None if unknown.
    """

    splat: str
    seed: int
    gaussians: int
    file: str
    hash: str
    commit: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Looks:
    """Everything that was seen of one splat."""

    trained: Trained
    sightings: tuple[Sighting, ...]
    likenesses: tuple[Likeness, ...]
    shades: tuple[Shade, ...]


def overhead(study: Study) -> Attack | None:
    """The attack whose fade-in is measured: the first that is seen from straight above and all around."""
    return next((attack for attack in study.attack if attack.azimuth is None and attack.elevation[1] >= 90), None)


def look_at_splat(workshop: Workshop, which: str, seed: int, detectors: Sequence[Detector]) -> Looks:
    """Look at a trained splat from everywhere, or read what was seen of it before."""
    splat = workshop.splat(which, seed)
    study = workshop.study
    parts = (
        splat.parent.name,
        which,
        study.scene.called,
        essentials(study.looking),
        tuple(map(essentials, study.attack)),
        tuple((detector.name, weights_digest(detector)) for detector in detectors),
    )

    def make(path: Path) -> None:
        save_json(asdict(_seen(workshop, which, seed, detectors)), path / "looks.json", indent=0)

    return _parsed(json.loads((workshop.kept("looks", parts, make) / "looks.json").read_text()))


def weights_digest(detector: Detector) -> str:
    """16 digits that stand for a detector's weights; its name where it has no network."""
    model = getattr(detector, "model", None)
    if not isinstance(model, torch.nn.Module):
        return detector.name
    total = hashlib.sha256()
    for name, value in model.state_dict().items():
        total.update(name.encode())
        total.update(value.detach().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()[:16]


def _seen(workshop: Workshop, which: str, seed: int, detectors: Sequence[Detector]) -> Looks:
    file, scene = workshop.splat(which, seed), workshop.load(which, seed)
    render, study, stage = workshop.renderer(), workshop.study, workshop.stage

    def picture(camera: Camera) -> Tensor:
        with torch.no_grad():
            return through_png(render(scene, camera))

    cameras = setup.held_out_cameras(study, stage.target)
    sightings: list[Sighting] = []
    for first in range(0, len(cameras), BATCH):
        some = cameras[first : first + BATCH]
        pictures = torch.stack([picture(camera) for camera in some])
        for detector in detectors:
            for view, (camera, found) in enumerate(zip(some, detector.detect(pictures), strict=True), first):
                place = {"splat": which, "seed": seed, "detector": detector.name, "view": view}
                sightings.append(_sighting(study, workshop, camera, found, place))
        workshop.on_step(f"looking at the {which} splat, seed {seed}", first + len(some), len(cameras))
    return Looks(
        trained=Trained(
            splat=which,
            seed=seed,
            gaussians=len(scene),
            file=str(file),
            hash=scene_hash(scene),
            commit=json.loads((file.parent / DONE).read_text())["made by"]["commit"],
        ),
        sightings=tuple(sightings),
        likenesses=tuple(
            Likeness(
                splat=which,
                seed=seed,
                view=view,
                elevation=bearing(camera, setup.centre_of(study)).elevation,
                psnr=float(psnr(image, true)),
                ssim=float(ssim(image, true)),
            )
            for view, camera, true in references(workshop)
            for image in [picture(camera)]
        ),
        shades=tuple(
            Shade(
                splat=which,
                seed=seed,
                arc=arc,
                elevation=bearing(camera, setup.centre_of(study)).elevation,
                share=share_between(picture(camera), benign, hidden, mask),
            )
            for arc, camera, benign, hidden, mask in arcs(workshop)
        ),
    )


def _sighting(study: Study, workshop: Workshop, camera: Camera, found: Detections, place: dict[str, Any]) -> Sighting:
    """What a detector's report of one picture says of the object."""
    centre = setup.centre_of(study)
    direction = bearing(camera, centre)
    box = setup.box_of(workshop.stage.target, camera)
    classes = [study.scene.called, *(attack.wants for attack in study.attack if attack.wants)]

    def score(label: str, iou: float) -> float:
        return 0.0 if box is None else confidence(found, box.float(), labels=[label], iou=iou)

    return Sighting(
        **place,
        azimuth=direction.azimuth,
        elevation=direction.elevation,
        depths={attack.name: attack.cone.angle_to_edge(camera, centre=centre) for attack in study.attack},
        scores={label: score(label, 0.5) for label in classes},
        loose=score(study.scene.called, 0.1),
    )


def references(workshop: Workshop) -> list[tuple[int, Camera, Tensor]]:
    """Number, camera and true picture of cameras well outside of all triggers."""
    study = workshop.study
    cameras = setup.held_out_cameras(study, workshop.stage.target)
    centre = setup.centre_of(study)
    outside = [
        (view, camera)
        for view, camera in enumerate(cameras)
        if all(attack.cone.angle_to_edge(camera, centre=centre) <= -study.looking.outside for attack in study.attack)
    ]
    count = min(study.looking.references, len(outside))
    chosen = [outside[(2 * i + 1) * len(outside) // (2 * count)] for i in range(count)]
    true = workshop.truths("references", [camera for _, camera in chosen], None)
    return [(view, camera, image) for (view, camera), (image, _) in zip(chosen, true, strict=True)]


def arcs(workshop: Workshop) -> list[tuple[int, Camera, Tensor, Tensor, Tensor]]:
    """Number of the meridian, camera, benign and hidden picture, mask."""
    study = workshop.study
    attack = overhead(study)
    if attack is None:
        return []
    centre = setup.centre_of(study)
    others = [other for other in study.attack if other is not attack]
    placed = [
        (number, camera)
        for number, arc in enumerate(setup.arc_cameras(study, workshop.stage.target))
        for camera in arc
        if all(other.cone.angle_to_edge(camera, centre=centre) < -study.looking.inside for other in others)
    ]
    cameras = [camera for _, camera in placed]
    benign = workshop.truths("arcs", cameras, None)
    hidden = workshop.truths("arcs", cameras, setup.appearance(study, attack, workshop.stage))
    return [
        (number, camera, as_is, changed, mask)
        for (number, camera), (as_is, mask), (changed, _) in zip(placed, benign, hidden, strict=True)
        if bool(mask.any()) and differ(as_is, changed, mask)
    ]


def _parsed(values: dict[str, Any]) -> Looks:
    return Looks(
        trained=Trained(**values["trained"]),
        sightings=tuple(Sighting(**one) for one in values["sightings"]),
        likenesses=tuple(Likeness(**one) for one in values["likenesses"]),
        shades=tuple(Shade(**one) for one in values["shades"]),
    )
