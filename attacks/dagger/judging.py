"""Judging an attack on held-out views: the saved file, 8-bit pictures, the real JPEG, and random noise beside it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from attacks.dagger.eot.problem import EotProblem
from attacks.dagger.eot.views import DrawnView, ViewDistribution
from attacks.detectors.base import Detections, Detector
from attacks.objectives import Verdict, confidence
from attacks.observe.views import ImageChange, ViewDetections, as_saved, detect_views, image_change
from attacks.transformations.pictures import PictureChange, changing
from mi_splat.cameras import RenderFn
from mi_splat.io.camera_records import values_of
from mi_splat.io.images import through_png
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class JudgedView:
    """One held-out view as one detector sees it.

    Attributes:
        view: The view.
        detector: Name of the detector.
        images: (H, W, 3) clean and attacked picture, as the detector got them.
        clean: What is reported in the clean picture.
        attacked: What is reported in the attacked picture.
        verdict: Of the attacked picture.
        clean_verdict: Of the clean picture: the aim reached without any attack.
        noise: Of each draw of random noise.
    """

    view: DrawnView
    detector: str
    images: tuple[Tensor, Tensor]
    clean: Detections
    attacked: Detections
    verdict: Verdict
    clean_verdict: Verdict
    noise: tuple[Verdict, ...]

    def row(self, original: str | None, label: str | None) -> dict[str, Any]:
        """What was seen, as JSON can hold it; see `Judgement.rows`."""
        direction = self.view.direction
        return {
            "index": self.view.index,
            "detector": self.detector,
            "azimuth": direction.azimuth,
            "elevation": direction.elevation,
            "position": self.view.camera.position.tolist(),
            "camera": values_of(self.view.camera),
            "change": dataclasses.asdict(self.view.change),
            "success": self.verdict.success,
            "unambiguous": self.verdict.unambiguous,
            "score": self.verdict.score,
            "clean_success": self.clean_verdict.success,
            "clean_score": self.clean_verdict.score,
            "noise_successes": [verdict.success for verdict in self.noise],
            "noise_scores": [verdict.score for verdict in self.noise],
            "target_confidence": self.confidence(label, attacked=True) if label else None,
            "clean_confidence": self.confidence(original, attacked=False) if original else 0.0,
            "original_confidence": self.confidence(original, attacked=True) if original else 0.0,
            "box": self.view.box.tolist(),
        }

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        """Highest score with which `label` (any class if None) is reported on the object."""
        found = self.attacked if attacked else self.clean
        return confidence(found, self.view.box, labels=None if label is None else [label])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Judgement:
    """What held-out views say of an attack.

    Attributes:
        views: View by view, and in a view detector by detector.
        image: Change of the pictures before anything random happens to them; its PSNR is of the mean squared error over
            all pixels of all views.
        noise_images: The same for each draw of random noise.
    """

    views: tuple[JudgedView, ...]
    image: ImageChange
    noise_images: tuple[ImageChange, ...]

    def rows(self, originals: Mapping[str, str | None], label: str | None) -> list[dict[str, Any]]:
        """What was seen, one row for each view and detector, as JSON can hold it.

        Args:
            originals: What each detector calls the clean object in most views.
            label: The class that the object should become; None if no particular one.
        """
        return [one.row(originals[one.detector], label) for one in self.views]


def judge(
    problem: EotProblem,
    attacked: GaussianScene,
    noisy: Sequence[GaussianScene],
    distribution: ViewDistribution,
    *,
    seed: int,
    count: int,
) -> Judgement:
    """Judge an attacked scene, the clean one and noisy ones on the same views, each as its file holds it.

    Args:
        problem: The detectors, the aim and the renderer.
        attacked: The attacked scene.
        noisy: Scenes with random noise in the place of the attack.
        distribution: Where the held-out views are drawn from.
        seed: Of the held-out views.
        count: Their number.
    """
    views = distribution.views(seed, count)
    scenes = [as_saved(scene) for scene in (distribution.scene, attacked, *noisy)]
    benign = clean_detections(distribution, problem.detectors, seed=seed, count=count)
    seen = [benign, *(_detections(problem.detectors, scene, problem.render, views) for scene in scenes[1:])]
    plain = [_plain_pictures(problem, scene, views, found) for scene, found in zip(scenes, seen, strict=True)]
    weights = [view.weight for view in views]
    detectors = {detector.name: detector for detector in problem.detectors}
    rows = []
    for view in views:
        for name, detector in detectors.items():
            clean, after, *rest = (found[view.index, name] for found in seen)
            target = problem.target(view, detector)
            verdicts = [problem.objective.verdict(one.detections, target) for one in (clean, after, *rest)]
            rows.append(
                JudgedView(
                    view=view,
                    detector=name,
                    images=(clean.image, after.image),
                    clean=clean.detections,
                    attacked=after.detections,
                    clean_verdict=verdicts[0],
                    verdict=verdicts[1],
                    noise=tuple(verdicts[2:]),
                )
            )
    changes = [image_change(plain[0], pictures, weights) for pictures in plain[1:]]
    return Judgement(views=tuple(rows), image=changes[0], noise_images=tuple(changes[1:]))


def clean_detections(
    distribution: ViewDistribution, detectors: Sequence[Detector], *, seed: int, count: int
) -> dict[tuple[int, str], ViewDetections]:
    """What detectors report on the clean scene, by the view's number and the detector's name; looked at once.

    Args:
        distribution: The scene and its views.
        detectors: Those asked.
        seed: Of the views.
        count: Their number.
    """

    def look(detector: Detector) -> dict[tuple[int, str], ViewDetections]:
        views = distribution.views(seed, count)
        return _detections([detector], as_saved(distribution.scene), distribution.render, views)

    found: dict[tuple[int, str], ViewDetections] = {}
    for detector in detectors:
        key = ("clean", detector.name, detector.fingerprint, seed, count)
        found |= distribution.remembered(key, functools.partial(look, detector))
    return found


def _detections(
    detectors: Sequence[Detector], scene: GaussianScene, render: RenderFn, views: Sequence[DrawnView]
) -> dict[tuple[int, str], ViewDetections]:
    """What detectors report on the changed pictures, by the view's number and the detector's name."""
    cameras, boxes = [view.camera for view in views], [view.box for view in views]
    changed = changing(render, {view.camera: view.change for view in views})
    # One picture at a time: the same bits whatever the number of views.
    found = detect_views(scene, cameras, detectors, render=changed, boxes=boxes, batch=1)
    return {(views[one.view].index, one.detector): one for one in found}


def _plain_pictures(
    problem: EotProblem,
    scene: GaussianScene,
    views: Sequence[DrawnView],
    found: Mapping[tuple[int, str], ViewDetections],
) -> list[Tensor]:
    """8-bit pictures before anything random happens to them; those of the detections where nothing does."""
    if all(view.change == PictureChange(noise_seed=view.change.noise_seed) for view in views):
        name = problem.detectors[0].name
        return [found[view.index, name].image for view in views]
    with torch.no_grad():
        return [through_png(problem.render(scene, view.camera)) for view in views]
