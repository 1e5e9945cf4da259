"""What detectors report of a trained splat from cameras that no training used, and how true its pictures are there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import polars as pl
import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.appearances import grown
from attacks.cloak.config import StudyConfig
from attacks.cloak.study import dependencies
from attacks.cloak.study.kept_pictures import TruePictures
from attacks.cloak.study.pipeline import CLEAN, CLOAKED, StudyPipeline
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.cloak.transition import differ, transition_fraction
from attacks.detectors.base import Detector
from attacks.observe.views import ViewDetections, detect_views
from mi_splat.cameras import Camera
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json
from mi_splat.io.fields import Fields
from mi_splat.io.images import through_png
from mi_splat.io.noted_tensors import read_line
from mi_splat.io.parsing import read_json
from mi_splat.metrics import psnr, ssim

MARGIN = 10
"""Pixels around the object, in pictures of 256 x 256, that count as the object's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """A splat from one held-out camera, as one detector sees it.

    Attributes:
        detector: Its name.
        view: Number of the camera.
        azimuth: Of the camera, degrees.
        elevation: Of the camera, degrees.
        depths: For each attack, degrees inside its trigger; outside < 0.
        scores: For the object's own class and for each target class, the highest confidence with which it is reported
            on the object: 0 without such a detection that overlaps its box by half.
        any_overlap: The same for the object's own class and a tenth of the box: whether it is found at all.
        any_class: The highest confidence with which anything is reported on the object, whatever its class.
    """

    detector: str
    view: int
    azimuth: float
    elevation: float
    depths: Mapping[str, float]
    scores: Mapping[str, float]
    any_overlap: float
    any_class: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fidelity:
    """How near a splat's picture is to the true one of the scene as it is.

    Attributes:
        view: Number of the camera.
        elevation: Of the camera, degrees.
        psnr: Of the whole picture, dB.
        ssim: Of the whole picture.
    """

    view: int
    elevation: float
    psnr: float
    ssim: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Blend:
    """How far a splat's picture is on the way from the benign to the hidden appearance, and how true it is.

    Attributes:
        meridian: Number of the meridian.
        elevation: Of the camera, degrees.
        depth: Degrees inside the trigger; outside < 0.
        fraction: See `attacks.cloak.transition.transition_fraction`.
        surroundings_psnr: Beside the object (its mask and `MARGIN`), against the true picture of the scene, dB.
        appearance_psnr: On the object's mask, against what the attacker wants to be seen, dB.
    """

    meridian: int
    elevation: float
    depth: float
    fraction: float
    surroundings_psnr: float
    appearance_psnr: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservedSplat:
    """Everything that was observed of one splat.

    Attributes:
        trained: The splat.
        observations: One for each held-out camera and detector.
        fidelities: One for each camera far outside of all triggers.
        blends: One for each camera of a meridian.
    """

    trained: TrainedSplat
    observations: tuple[Observation, ...]
    fidelities: tuple[Fidelity, ...]
    blends: tuple[Blend, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _References:
    """True pictures that splats are compared with, and where they were taken."""

    views: list[tuple[int, Camera]]
    true: TruePictures
    arc: list[tuple[int, Camera]]
    benign: TruePictures
    hidden: TruePictures

    @property
    def content(self) -> list[str]:
        return [pictures.content for pictures in (self.true, self.benign, self.hidden)]


def observe(
    pipeline: StudyPipeline, splats: Sequence[TrainedSplat], detectors: Sequence[Detector]
) -> list[ObservedSplat]:
    """Look at trained splats from everywhere, or read what was seen of them before."""
    references = _references(pipeline)
    return [_observe(pipeline, splat, detectors, references) for splat in splats]


def _observe(
    pipeline: StudyPipeline, splat: TrainedSplat, detectors: Sequence[Detector], references: _References
) -> ObservedSplat:
    def make(path: Path) -> None:
        save_json(_seen(pipeline, splat, detectors, references), path / "observations.json", indent=0)

    depends_on = dependencies.of_observations(
        pipeline.study,
        pipeline.source.digest,
        splat.content,
        references.content,
        {detector.name: detector.fingerprint for detector in detectors},
    )
    stage = pipeline.cache.finished("observations", depends_on, make)
    file = stage.folder / "observations.json"
    values = Fields(read_json(file), str(file), InvalidValueError, "delete its folder, so that it is made again")
    return ObservedSplat(
        trained=splat,
        observations=tuple(read_line(Observation, one) for one in values.objects("observations")),
        fidelities=tuple(read_line(Fidelity, one) for one in values.objects("fidelities")),
        blends=tuple(read_line(Blend, one) for one in values.objects("blends")),
    )


def _seen(
    pipeline: StudyPipeline, splat: TrainedSplat, detectors: Sequence[Detector], references: _References
) -> dict[str, list[dict[str, Any]]]:
    """Everything that is seen of a splat, as JSON can hold it."""
    scene, render, study = splat.load(), pipeline.renderer(), pipeline.study

    def picture(camera: Camera) -> Tensor:
        with torch.no_grad():
            return through_png(render(scene, camera))

    def elevation(camera: Camera) -> float:
        return direction_of(camera, setup.centre_of(study)).elevation

    target, text = pipeline.mesh_scene.target, f"observing the {splat.splat} splat, seed {splat.seed}"
    cameras = setup.held_out_cameras(study, target)
    boxes = [setup.box_of(target, camera) for camera in cameras]
    observations: list[Observation] = []
    for one in detect_views(scene, cameras, detectors, render=render, boxes=boxes):
        observations.append(observation_of(study, one))
        pipeline.on_step(text, len(observations), len(cameras) * len(detectors))
    fidelities = [
        Fidelity(view=view, elevation=elevation(camera), psnr=float(psnr(image, true)), ssim=float(ssim(image, true)))
        for (view, camera), true in zip(references.views, references.true.images, strict=True)
        for image in [picture(camera)]
    ]
    arc = zip(references.arc, references.benign.images, references.hidden.images, references.benign.masks, strict=True)
    blends = [
        _blend(study, place, picture(place[1]), benign, hidden, mask)
        for place, benign, hidden, mask in arc
        if bool(mask.any()) and differ(benign, hidden, mask)
    ]
    return {
        "observations": [asdict(one) for one in observations],
        "fidelities": [asdict(one) for one in fidelities],
        "blends": [asdict(one) for one in blends],
    }


def _blend(
    study: StudyConfig, place: tuple[int, Camera], seen: Tensor, benign: Tensor, hidden: Tensor, mask: Tensor
) -> Blend:
    """What one picture of a meridian says."""
    (arc, camera), attack, centre = place, setup.hiding(study), setup.centre_of(study)
    assert attack is not None  # there are no arcs without
    beside = ~grown(mask, max(1, round(MARGIN * study.cameras.size / 256)))
    return Blend(
        meridian=arc,
        elevation=direction_of(camera, centre).elevation,
        depth=attack.cone.angle_to_edge(camera, centre=centre),
        fraction=transition_fraction(seen, benign, hidden, mask),
        surroundings_psnr=float(psnr(seen[beside], benign[beside])),
        appearance_psnr=float(psnr(seen[mask], hidden[mask])),
    )


def observation_of(study: StudyConfig, seen: ViewDetections) -> Observation:
    """What a detector's report of one picture says of the object."""
    centre = setup.centre_of(study)
    direction = seen.direction(centre)
    return Observation(
        detector=seen.detector,
        view=seen.view,
        azimuth=direction.azimuth,
        elevation=direction.elevation,
        depths={attack.name: attack.cone.angle_to_edge(seen.camera, centre=centre) for attack in study.attack},
        **scored(study, seen.confidence),
    )


def scored(study: StudyConfig, confidence: Callable[..., float]) -> dict[str, Any]:
    """The part of an `Observation` that detections decide.

    Args:
        study: The study.
        confidence: As `attacks.observe.views.ViewDetections.confidence`.
    """
    own = study.scene.class_name
    return {
        "scores": {label: confidence(label) for label in classes_of(study)},
        "any_overlap": confidence(own, iou=0.1),
        "any_class": confidence(),
    }


def classes_of(study: StudyConfig) -> list[str]:
    """The object's own class and those that attacks want, each once."""
    wanted = [attack.target_class for attack in study.attack if attack.target_class]
    return list(dict.fromkeys([study.scene.class_name, *wanted]))


def _references(pipeline: StudyPipeline) -> _References:
    """True pictures of the scene far outside of all triggers, and of both appearances along the arcs."""
    views, arc, attack = _reference_cameras(pipeline), _arc_cameras(pipeline), setup.hiding(pipeline.study)
    cameras = [camera for _, camera in arc]
    benign = pipeline.true_pictures(cameras)
    return _References(
        views=views,
        true=pipeline.true_pictures([camera for _, camera in views]),
        arc=arc,
        benign=benign,
        hidden=benign if attack is None else pipeline.true_pictures(cameras, attack),
    )


def _reference_cameras(pipeline: StudyPipeline) -> list[tuple[int, Camera]]:
    """Number and camera of held-out cameras far outside of all triggers, spread evenly."""
    study, centre = pipeline.study, setup.centre_of(pipeline.study)
    far = study.evaluation.far_outside
    outside = [
        (view, camera)
        for view, camera in enumerate(setup.held_out_cameras(study, pipeline.mesh_scene.target))
        if all(attack.cone.angle_to_edge(camera, centre=centre) <= -far for attack in study.attack)
    ]
    count = min(study.evaluation.reference_views, len(outside))
    return [outside[(2 * i + 1) * len(outside) // (2 * count)] for i in range(count)]


def _arc_cameras(pipeline: StudyPipeline) -> list[tuple[int, Camera]]:
    """Number of the arc and camera, away from the triggers of other attacks; none without a transition."""
    study, centre, attack = pipeline.study, setup.centre_of(pipeline.study), setup.hiding(pipeline.study)
    others = [other for other in study.attack if other is not attack]
    return [
        (number, camera)
        for number, arc in enumerate(setup.arcs(study, pipeline.mesh_scene.target))
        for camera in arc
        if all(other.cone.angle_to_edge(camera, centre=centre) < -study.evaluation.well_inside for other in others)
    ]


DEPTH, SCORE = "depth: ", "score: "
"""What stands before the name of an attack in the column of depths in its trigger, and before a class in its scores."""

_TYPES = {"int": pl.Int64, "float": pl.Float64}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRows:
    """What was seen of the splats of a study.

    Attributes:
        rows: A row for each splat, seed, detector and held-out camera, as `row_of` makes it.
        fidelity: A row for each splat, seed and camera far outside of all triggers, with the values of `Fidelity`.
        transition: A row for each splat, seed and camera of an arc, with the values of `Blend`.
        gaussians: Number of Gaussians of the clean and of the cloaked splats, by seed in the order of the study.
    """

    rows: pl.DataFrame
    fidelity: pl.DataFrame
    transition: pl.DataFrame
    gaussians: Mapping[str, Sequence[int]]

    @classmethod
    def of(cls, observed: Sequence[ObservedSplat]) -> StudyRows:
        """The rows of everything that was observed."""
        whose = [{"splat": item.trained.splat, "seed": item.trained.seed} for item in observed]
        pairs = list(zip(whose, observed, strict=True))
        return cls(
            rows=frame({**own, **row_of(one)} for own, item in pairs for one in item.observations),
            fidelity=frame(({**own, **asdict(one)} for own, item in pairs for one in item.fidelities), Fidelity),
            transition=frame(({**own, **asdict(one)} for own, item in pairs for one in item.blends), Blend),
            gaussians=gaussians_of(
                {"splat": one.trained.splat, "gaussians": one.trained.gaussians} for one in observed
            ),
        )


def frame(rows: Iterable[Mapping[str, Any]], kind: type[Any] | None = None) -> pl.DataFrame:
    """Rows as a table; with a dataclass whose fields they have, it has these columns even without a row."""
    schema = None
    if kind is not None:
        own = {field.name: _TYPES[str(field.type)] for field in fields(kind)}
        schema = {"splat": pl.String, "seed": pl.Int64, **own}
    return pl.DataFrame(list(rows), schema=schema, infer_schema_length=None)


def row_of(one: Observation) -> dict[str, Any]:
    """An observation as a row."""
    return {
        "detector": one.detector,
        "view": one.view,
        "azimuth": one.azimuth,
        "elevation": one.elevation,
        **{f"{DEPTH}{name}": depth for name, depth in one.depths.items()},
        **score_cells({"scores": one.scores, "any_overlap": one.any_overlap, "any_class": one.any_class}),
    }


def score_cells(scored: Mapping[str, Any]) -> dict[str, float]:
    """The part of a row that detections decide, from `attacks.cloak.observations.scored`."""
    scores = {f"{SCORE}{label}": score for label, score in scored["scores"].items()}
    return {**scores, "any_overlap": scored["any_overlap"], "any_class": scored["any_class"]}


def gaussians_of(splats: Iterable[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Numbers of Gaussians of the clean and of the cloaked splats, in their order."""
    found: dict[str, list[int]] = {CLEAN: [], CLOAKED: []}
    for splat in splats:
        found[splat["splat"]].append(int(splat["gaussians"]))
    return found
