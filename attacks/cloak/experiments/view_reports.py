"""From which held-out cameras detectors report a study's object, in true pictures, on clean and on cloaked splats.

The pictures of the scene as it is are the control of the splats; the clean splat is that of the cloaked one. What is
seen is kept as stages beside those of the study, one for each series of pictures and detector, so that a detector that
is added, or comes with other weights, is the only one that looks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.plots import TRUE
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import content_of
from attacks.cloak.study.pipeline import StudyPipeline
from attacks.cloak.study.run import STUDY, SUMMARY, differences
from attacks.cloak.study.trained_splats import SPLAT_STAGES, TrainedSplat
from attacks.detectors.base import Detector
from attacks.objectives import confidence
from mi_splat.cameras import Camera
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_json
from mi_splat.io.fields import Fields
from mi_splat.io.images import through_png
from mi_splat.io.noted_tensors import read_line
from mi_splat.io.parsing import DocumentReader, read_json
from mi_splat.training.resume import SPLAT

VEHICLES = ("car", "truck", "bus")
"""Classes of COCO of which any counts for any."""
OVERLAP, LEAST_OVERLAP = 0.5, 0.1
"""Overlap with the object's box from which a detection is of the object, and from which it is at all near it."""
_BATCH = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReport:
    """What a detector reports on the object from one camera: highest confidences, 0 where there is no such detection.

    Attributes:
        view: Number of the camera.
        azimuth: Of the camera, degrees.
        elevation: Of the camera, degrees.
        depths: For each attack, degrees inside its trigger; outside < 0.
        own: Of the object's class, or of any vehicle if it is one.
        target: Of the classes that attacks want it to be taken for.
        own_near: As `own`, of detections that overlap the object's box by a tenth.
        target_near: As `target`, of such detections.
    """

    view: int
    azimuth: float
    elevation: float
    depths: Mapping[str, float]
    own: float
    target: float
    own_near: float
    target_near: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReports:
    """One series of pictures as one detector sees it.

    Attributes:
        pictures: "path traced", "clean" or "cloaked".
        seed: Of the splat; None of true pictures.
        detector: Its name.
        view_reports: One for each camera.
    """

    pictures: str
    seed: int | None
    detector: str
    view_reports: tuple[ViewReport, ...]


def finished_splats(study: StudyConfig, results: Path, stages: Path) -> list[TrainedSplat]:
    """The splats of a finished study, found by their content.

    Args:
        study: The study.
        results: Folder that `mi-splat cloak` has written for it.
        stages: Folder of its stages.

    Raises:
        InvalidValueError: The results are not there or another study's, or a splat is not among the stages.
    """
    if not (results / SUMMARY).is_file():
        expected, do = f"a folder with {SUMMARY}, which a finished study has", "run `mi-splat cloak` first"
        raise InvalidValueError(message("--results", expected, str(results), do))
    if others := differences(results / STUDY, study):
        raise InvalidValueError(message("--results", f"a study with {others[0]}", "another", "pass its own results"))
    files = [path for stage in SPLAT_STAGES for path in sorted(stages.glob(f"{stage}-*/{SPLAT}"))]
    there = {content_of(path.parent, (SPLAT,)): path for path in files}
    listed = read_json(results / SUMMARY)["splats"]
    if missing := [one for one in listed if one["content"] not in there]:
        got = f"none of the {missing[0]['splat']} splat of seed {missing[0]['seed']}"
        do = "pass the folder that the study was done with"
        raise InvalidValueError(message(f"stages {stages}", "every splat of the study", got, do)).hinted("--stages")
    return [TrainedSplat(file=there[one["content"]], **one) for one in listed]


def watch(
    pipeline: StudyPipeline, splats: Sequence[TrainedSplat], detectors: Sequence[Detector], *, every: int = 1
) -> list[ViewReports]:
    """Look at the scene and at all splats from held-out cameras, or read what was seen before.

    Args:
        pipeline: The study.
        splats: Its splats.
        detectors: Those that look.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: `every` is not positive.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    cameras = setup.held_out_cameras(pipeline.study, pipeline.mesh_scene.target)[::every]
    return [
        _look(pipeline, one, detector, cameras, every)
        for one in _all_series(pipeline, splats, cameras)
        for detector in detectors
    ]


@dataclass(frozen=True, slots=True)
class _Series:
    """(H, W, 3) uint8 pictures from all cameras, which are made when they are first needed."""

    pictures: str
    seed: int | None
    content: str
    images: Callable[[], list[Tensor]]


def _all_series(
    pipeline: StudyPipeline, splats: Sequence[TrainedSplat], cameras: Sequence[Camera]
) -> Iterator[_Series]:
    """One after the other, so that the pictures of one only are in memory."""
    true = pipeline.true_pictures(cameras)
    yield _Series(TRUE, None, true.content, partial(_bytes, true.images))
    for one in splats:
        yield _Series(one.splat, one.seed, one.content, cache(partial(_rendered, pipeline, one, cameras)))


def _bytes(images: Sequence[Tensor]) -> list[Tensor]:
    return [(image * 255).round().to(torch.uint8) for image in images]


def _rendered(pipeline: StudyPipeline, splat: TrainedSplat, cameras: Sequence[Camera]) -> list[Tensor]:
    """Pictures of a splat."""
    scene, render, images = splat.load(), pipeline.renderer(), []
    for number, camera in enumerate(cameras):
        with torch.no_grad():
            images += _bytes([through_png(render(scene, camera))])
        pipeline.on_step(f"rendering the {splat.splat} splat, seed {splat.seed}", number + 1, len(cameras))
    return images


def _look(
    pipeline: StudyPipeline, series: _Series, detector: Detector, cameras: Sequence[Camera], every: int
) -> ViewReports:
    """One detector's look at one series."""

    def make(path: Path) -> None:
        text = f"{detector.name} looks at {series.pictures} pictures, seed {series.seed}"
        seen: list[dict[str, Any]] = []
        images = series.images()
        for start in range(0, len(images), _BATCH):
            with torch.no_grad():
                reports = detector.detect(torch.stack(images[start : start + _BATCH]).to(torch.float32) / 255)
            for view, report in enumerate(reports, start):
                seen.append(asdict(_view_report(pipeline, report, view, cameras[view])))
            pipeline.on_step(text, len(seen), len(images))
        save_json(seen, path / "view_reports.json", indent=0)

    depends_on = dependencies.of_view_reports(
        pipeline.study,
        pipeline.source.digest,
        f"{series.content}, one in {every}",
        (detector.name, detector.fingerprint),
    )
    stage = pipeline.cache.finished("view_reports", depends_on, make)
    file = stage.folder / "view_reports.json"
    values = {"reports": DocumentReader().read_json_value(file)}
    reports = Fields(values, str(file), InvalidValueError, "delete its folder, so that it is made again")
    return ViewReports(
        pictures=series.pictures,
        seed=series.seed,
        detector=detector.name,
        view_reports=tuple(read_line(ViewReport, one) for one in reports.objects("reports")),
    )


def _view_report(pipeline: StudyPipeline, report: Any, view: int, camera: Camera) -> ViewReport:
    """What a report says of the object."""
    study, centre = pipeline.study, setup.centre_of(pipeline.study)
    box = setup.box_of(pipeline.mesh_scene.target, camera)
    own = VEHICLES if study.scene.class_name in VEHICLES else (study.scene.class_name,)
    target = [attack.target_class for attack in study.attack if attack.target_class is not None]
    direction = direction_of(camera, centre)

    def highest(labels: Sequence[str], iou: float) -> float:
        return 0.0 if box is None else confidence(report, box, labels=labels, iou=iou)

    return ViewReport(
        view=view,
        azimuth=direction.azimuth,
        elevation=direction.elevation,
        depths={attack.name: attack.cone.angle_to_edge(camera, centre=centre) for attack in study.attack},
        own=highest(own, OVERLAP),
        target=highest(target, OVERLAP),
        own_near=highest(own, LEAST_OVERLAP),
        target_near=highest(target, LEAST_OVERLAP),
    )
