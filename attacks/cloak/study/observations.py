"""What detectors report of a splat from cameras that no training used, and how true its pictures are there."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks.cloak.study import setup
from attacks.cloak.study.config import AttackConfig, StudyConfig, essentials
from attacks.cloak.study.pipeline import DONE, StudyPipeline
from attacks.cloak.transition import differ, transition_fraction
from attacks.detectors.base import Detections, Detector
from attacks.objectives import confidence
from mi_splat.cameras import Camera
from mi_splat.directions import direction_of
from mi_splat.io.documents import save_json
from mi_splat.io.images import through_png
from mi_splat.metrics import psnr, ssim
from mi_splat.scene import scene_hash

BATCH = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
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
class Fidelity:
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
class Blend:
    """How far a splat's picture is on the way from the benign to the hidden item.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        arc: Number of the meridian.
        elevation: Of the camera, degrees.
        fraction: See `attacks.cloak.transition.transition_fraction`.
    """

    splat: str
    seed: int
    arc: int
    elevation: float
    fraction: float


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
class ObservedSplat:
    """Everything that was seen of one splat."""

    trained: Trained
    observations: tuple[Observation, ...]
    fidelities: tuple[Fidelity, ...]
    blends: tuple[Blend, ...]


def overhead(study: StudyConfig) -> AttackConfig | None:
    """The attack whose transition is measured: the first that is seen from straight above and all around."""
    return next((attack for attack in study.attack if attack.azimuth is None and attack.elevation[1] >= 90), None)


def observe_splat(pipeline: StudyPipeline, which: str, seed: int, detectors: Sequence[Detector]) -> ObservedSplat:
    """Look at a trained splat from everywhere, or read what was seen of it before."""
    splat = pipeline.splat(which, seed)
    study = pipeline.study
    parts = (
        splat.parent.name,
        which,
        study.scene.class_name,
        essentials(study.evaluation),
        tuple(map(essentials, study.attack)),
        tuple((detector.name, detector.fingerprint) for detector in detectors),
    )

    def make(path: Path) -> None:
        save_json(asdict(_seen(pipeline, which, seed, detectors)), path / "observed.json", indent=0)

    return _parsed(json.loads((pipeline.cached("observed", parts, make) / "observed.json").read_text()))


def _seen(pipeline: StudyPipeline, which: str, seed: int, detectors: Sequence[Detector]) -> ObservedSplat:
    file, scene = pipeline.splat(which, seed), pipeline.load(which, seed)
    render, study, mesh_scene = pipeline.renderer(), pipeline.study, pipeline.mesh_scene

    def picture(camera: Camera) -> Tensor:
        with torch.no_grad():
            return through_png(render(scene, camera))

    cameras = setup.held_out_cameras(study, mesh_scene.target)
    observations: list[Observation] = []
    for first in range(0, len(cameras), BATCH):
        some = cameras[first : first + BATCH]
        pictures = torch.stack([picture(camera) for camera in some])
        for detector in detectors:
            for view, (camera, found) in enumerate(zip(some, detector.detect(pictures), strict=True), first):
                place = {"splat": which, "seed": seed, "detector": detector.name, "view": view}
                observations.append(_observation(study, pipeline, camera, found, place))
        pipeline.on_step(f"evaluation at the {which} splat, seed {seed}", first + len(some), len(cameras))
    return ObservedSplat(
        trained=Trained(
            splat=which,
            seed=seed,
            gaussians=len(scene),
            file=str(file),
            hash=scene_hash(scene),
            commit=json.loads((file.parent / DONE).read_text())["made by"]["commit"],
        ),
        observations=tuple(observations),
        fidelities=tuple(
            Fidelity(
                splat=which,
                seed=seed,
                view=view,
                elevation=direction_of(camera, setup.centre_of(study)).elevation,
                psnr=float(psnr(image, true)),
                ssim=float(ssim(image, true)),
            )
            for view, camera, true in references(pipeline)
            for image in [picture(camera)]
        ),
        blends=tuple(
            Blend(
                splat=which,
                seed=seed,
                arc=arc,
                elevation=direction_of(camera, setup.centre_of(study)).elevation,
                fraction=transition_fraction(picture(camera), benign, hidden, mask),
            )
            for arc, camera, benign, hidden, mask in arcs(pipeline)
        ),
    )


def _observation(
    study: StudyConfig, pipeline: StudyPipeline, camera: Camera, found: Detections, place: dict[str, Any]
) -> Observation:
    """What a detector's report of one picture says of the object."""
    centre = setup.centre_of(study)
    direction = direction_of(camera, centre)
    box = setup.box_of(pipeline.mesh_scene.target, camera)
    classes = [study.scene.class_name, *(attack.target_class for attack in study.attack if attack.target_class)]

    def score(label: str, iou: float) -> float:
        return 0.0 if box is None else confidence(found, box.float(), labels=[label], iou=iou)

    return Observation(
        **place,
        azimuth=direction.azimuth,
        elevation=direction.elevation,
        depths={attack.name: attack.cone.angle_to_edge(camera, centre=centre) for attack in study.attack},
        scores={label: score(label, 0.5) for label in classes},
        loose=score(study.scene.class_name, 0.1),
    )


def references(pipeline: StudyPipeline) -> list[tuple[int, Camera, Tensor]]:
    """Number, camera and true picture of cameras well outside of all triggers."""
    study = pipeline.study
    cameras = setup.held_out_cameras(study, pipeline.mesh_scene.target)
    centre = setup.centre_of(study)
    outside = [
        (view, camera)
        for view, camera in enumerate(cameras)
        if all(
            attack.cone.angle_to_edge(camera, centre=centre) <= -study.evaluation.far_outside for attack in study.attack
        )
    ]
    count = min(study.evaluation.reference_views, len(outside))
    chosen = [outside[(2 * i + 1) * len(outside) // (2 * count)] for i in range(count)]
    true = pipeline.truths("references", [camera for _, camera in chosen], None)
    return [(view, camera, image) for (view, camera), (image, _) in zip(chosen, true, strict=True)]


def arcs(pipeline: StudyPipeline) -> list[tuple[int, Camera, Tensor, Tensor, Tensor]]:
    """Number of the meridian, camera, benign and hidden picture, mask."""
    study = pipeline.study
    attack = overhead(study)
    if attack is None:
        return []
    centre = setup.centre_of(study)
    others = [other for other in study.attack if other is not attack]
    placed = [
        (number, camera)
        for number, arc in enumerate(setup.arc_cameras(study, pipeline.mesh_scene.target))
        for camera in arc
        if all(other.cone.angle_to_edge(camera, centre=centre) < -study.evaluation.well_inside for other in others)
    ]
    cameras = [camera for _, camera in placed]
    benign = pipeline.truths("arcs", cameras, None)
    hidden = pipeline.truths("arcs", cameras, setup.appearance_of(study, attack, pipeline.mesh_scene))
    return [
        (number, camera, as_is, changed, mask)
        for (number, camera), (as_is, mask), (changed, _) in zip(placed, benign, hidden, strict=True)
        if bool(mask.any()) and differ(as_is, changed, mask)
    ]


def _parsed(values: dict[str, Any]) -> ObservedSplat:
    return ObservedSplat(
        trained=Trained(**values["trained"]),
        observations=tuple(Observation(**one) for one in values["observations"]),
        fidelities=tuple(Fidelity(**one) for one in values["fidelities"]),
        blends=tuple(Blend(**one) for one in values["blends"]),
    )
