"""Judging an attack: the saved file, 8-bit pictures, the real JPEG, the clean object and random noise beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.dagger.problem import Problem
from attacks.dagger.views import Reports, View, detected
from attacks.detectors.base import Detections
from attacks.objectives import Target, confidence
from attacks.observe.look import Looked, camera_cells, detection_rows, report_cells, verdict_cells
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, Cell, Row, frame_of
from attacks.observe.views import ImageChange, ViewDetections, image_change
from attacks.search import Verdict
from attacks.transformations.draws import PictureChange
from mi_splat.io.images import through_png
from mi_splat.metrics import psnr
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Seen:
    """What a detector reports on one splat in one view."""

    image: Tensor  # (H, W, 3) the picture as the detector got it, 8 bits in [0, 1]
    detections: Detections  # what it reports
    verdict: Verdict  # whether the attacker has the aim there


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class JudgedView:
    """One view as one detector sees it."""

    view: View  # the view
    detector: str  # name of the detector
    target: Target  # the object's box and classes in this view
    clean: Seen  # of the clean splat: its verdict is the aim reached without any attack
    attacked: Seen  # of the attacked splat
    noise: tuple[Seen, ...]  # of each draw of random noise

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        """Highest score with which `label` (any class if None) is reported on the object, clean or attacked."""
        detections = (self.attacked if attacked else self.clean).detections
        return confidence(detections, self.target.box, labels=None if label is None else [label])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Judgement:
    """What some views say of an attack.

    Attributes:
        views: Detector by detector, and for each view by view.
        image: Change of the pictures before anything random happens to them; its PSNR is of the mean squared error over
            all pixels of all views.
        noise_images: The same for each draw of random noise.
    """

    views: tuple[JudgedView, ...]
    image: ImageChange
    noise_images: tuple[ImageChange, ...]

    def looked(self, **ids: Cell) -> Looked:
        """What was seen as rows, clean, attacked and with noise."""
        rows, detections = list[Row](), list[Row]()
        for judged in self.views:
            view, target, clean = judged.view, judged.target, judged.clean.image
            where = camera_cells(view.camera, target.box, view.direction)
            splats = [(CLEAN, None, judged.clean), (ATTACKED, None, judged.attacked)]
            for splat, draw, seen in (*splats, *((NOISE, draw, seen) for draw, seen in enumerate(judged.noise))):
                of: dict[str, Cell] = {**ids, "splat": splat, "draw": draw}
                of |= {"detector": judged.detector, "view": view.index}
                change = None if torch.equal(clean, seen.image) else float(psnr(clean, seen.image))
                cells = report_cells(seen.detections, target.box, original=target.original, target=target.label)
                rows.append({**of, **where, **cells, **verdict_cells(seen.verdict), "psnr": change})
                detections += detection_rows(of, seen.detections, target.box)
        return Looked(rows=frame_of(rows), detections=frame_of(detections))


def judge(
    problem: Problem,
    views: Sequence[View],
    clean: tuple[GaussianScene, Reports],
    attacked: GaussianScene,
    noisy: Sequence[GaussianScene],
) -> Judgement:
    """Judge splats on the same views.

    Args:
        problem: The detectors, the aim and the renderer.
        views: The views.
        clean: The clean splat and what was reported on it.
        attacked: The attacked splat, as its file holds it.
        noisy: Splats with random noise in the place of the attack.

    Returns:
        Each view as each detector sees it, and how much the pictures change.
    """
    scenes = [clean[0], attacked, *noisy]
    reports = [clean[1], *(detected(problem.detectors, scene, views, problem.render) for scene in scenes[1:])]
    judged = []
    for detector in problem.detectors:
        for view in views:
            target = problem.target(view, detector)
            control, after, *noise = (
                _seen(problem, of_splat[view.index, detector.name], target) for of_splat in reports
            )
            judged.append(
                JudgedView(
                    view=view,
                    detector=detector.name,
                    target=target,
                    clean=control,
                    attacked=after,
                    noise=tuple(noise),
                )
            )
    plain = [_plain_pictures(problem, scene, views, of_splat) for scene, of_splat in zip(scenes, reports, strict=True)]
    changes = [image_change(plain[0], pictures, [view.weight for view in views]) for pictures in plain[1:]]
    return Judgement(views=tuple(judged), image=changes[0], noise_images=tuple(changes[1:]))


def _seen(problem: Problem, report: ViewDetections, target: Target) -> Seen:
    verdict = problem.objective.verdict(report.detections, target)
    return Seen(image=report.image, detections=report.detections, verdict=verdict)


def _plain_pictures(
    problem: Problem, scene: GaussianScene, views: Sequence[View], reports: Mapping[tuple[int, str], ViewDetections]
) -> list[Tensor]:
    """8-bit pictures before anything random happens to them; those of the detections where nothing does."""
    if all(view.change == PictureChange(noise_seed=view.change.noise_seed) for view in views):
        return [reports[view.index, problem.detectors[0].name].image for view in views]
    with torch.no_grad():
        return [through_png(problem.render(scene, view.camera)) for view in views]
