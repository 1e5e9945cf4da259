"""Judging an attack on held-out views: the saved file, 8-bit pictures, the real JPEG, and random noise beside it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.dagger.eot.problem import EotProblem
from attacks.dagger.eot.views import DrawnView, ViewDistribution
from attacks.detectors.base import Detections, Detector
from attacks.evaluation.rates import Rate
from attacks.evaluation.views import ViewDetections, as_saved, detect_views
from attacks.evaluation.visibility import ImageChange, image_change
from attacks.objectives import Verdict, confidence
from attacks.transformations.pictures import PictureChange, changing
from mi_splat.cameras import RenderFn
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

    def success(self, detector: str | None = None) -> Rate:
        """Views in which the aim is reached: by one detector, or by all of them at once if None."""
        return self._rate(lambda one: (one.verdict,), detector)

    def clean(self, detector: str | None = None) -> Rate:
        """The same without any attack."""
        return self._rate(lambda one: (one.clean_verdict,), detector)

    def noise(self, detector: str | None = None) -> Rate:
        """The same with random noise; a view counts once for each draw."""
        return self._rate(lambda one: one.noise, detector)

    def unambiguous(self, detector: str | None = None) -> Rate:
        """Views in which the aim is reached and no other class is reported on the object with more confidence."""
        return self._rate(lambda one: (dataclasses.replace(one.verdict, success=one.verdict.unambiguous),), detector)

    def _rate(self, verdicts: Callable[[JudgedView], Sequence[Verdict]], detector: str | None) -> Rate:
        return joint_rate(
            (one.view.index, [verdict.success for verdict in verdicts(one)])
            for one in self.views
            if detector in (None, one.detector)
        )


def joint_rate(outcomes: Iterable[tuple[int, Sequence[bool]]]) -> Rate:
    """Views in which every detector is deceived.

    Args:
        outcomes: Number of the view, and whether one detector is deceived in it: once, or once for each draw of noise.
    """
    rows: dict[int, list[Sequence[bool]]] = {}
    for index, draws in outcomes:
        rows.setdefault(index, []).append(draws)
    found = [all(draw) for row in rows.values() for draw in zip(*row, strict=True)]
    return Rate(successes=sum(found), total=len(found))


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
