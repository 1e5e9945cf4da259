"""The stage of an attack: one object, its views, the victim, the aim; seen as the attacker and as the judge.

The attacker differentiates candidates in the float picture. The judge looks at detections in pictures of 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from attacks.budgets import Parameters
from attacks.detectors.base import Detections, Detector
from attacks.evaluation.visibility import visible_box, visible_weight
from attacks.gaussian_subset import Part
from attacks.objectives import Objective, Target, Verdict, confidence, overlap
from attacks.pgd import Evaluation
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import quantise, through_png
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Shot:
    """One view before the attack.

    Attributes:
        camera: Where from.
        target: The object's box and classes in this view.
        weight: (H, W) share of each pixel that the object makes up.
        before: (H, W, 3) clean picture, 8 bits in [0, 1].
        clean: Detections in it.
    """

    camera: Camera
    target: Target
    weight: Tensor
    before: Tensor
    clean: Detections


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ViewResult:
    """One view before and after an attack.

    Attributes:
        shot: The view before.
        after: (H, W, 3) attacked picture, 8 bits in [0, 1].
        attacked: Detections in it.
        verdict: Success and score.
    """

    shot: Shot
    after: Tensor
    attacked: Detections
    verdict: Verdict

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        """Highest score with which `label` (any class if None) is detected on the object, clean or attacked."""
        detections = self.attacked if attacked else self.shot.clean
        return confidence(detections, self.shot.target.box, labels=None if label is None else [label])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Stage:
    """Everything about an attack that stays the same while it runs.

    Attributes:
        part: The object in its scene.
        detector: The victim.
        objective: The aim.
        render: The renderer.
        share: Share of the views in which the aim has to be reached.
    """

    part: Part
    detector: Detector
    objective: Objective
    render: RenderFn
    share: float = 1.0

    def shot(self, camera: Camera) -> Shot:
        """Look at the clean scene from `camera`.

        Raises:
            InvalidValueError: The object is not visible from there.
        """
        weight = visible_weight(self.part, camera, self.render)
        box = visible_box(weight)
        if box is None:
            raise InvalidValueError(
                message(
                    "camera", "a view in which the object is visible", "none of it", "turn the camera or choose another"
                )
            )
        picture, detections = self._judge(self.part.scene, camera)
        target = Target(
            box=box,
            label=self.objective.label,
            classes=self.detector.classes,
            original=_seen(detections, box),
        )
        return Shot(camera=camera, target=target, weight=weight, before=picture, clean=detections)

    def look(self, scene: GaussianScene, shots: Sequence[Shot]) -> tuple[ViewResult, ...]:
        """Judge a scene from every camera, on 8-bit pictures that went through PNG."""
        views = []
        for shot in shots:
            picture, detections = self._judge(scene, shot.camera)
            verdict = self.objective.verdict(detections, shot.target)
            views.append(ViewResult(shot=shot, after=picture, attacked=detections, verdict=verdict))
        return tuple(views)

    def evaluate(self, parameters: Parameters, shots: Sequence[Shot]) -> Evaluation:
        """Loss and gradients (mean over the views), success and score at one point of the search.

        Views are differentiated one after the other, so that memory does not grow with their number.
        """
        loss, verdicts = 0.0, []
        gradients = {name: torch.zeros_like(value) for name, value in parameters.items()}
        for shot in shots:
            leaves = {name: value.detach().requires_grad_(True) for name, value in parameters.items()}
            picture = _bounded(self.render(self.part.scene_with(leaves), shot.camera))
            candidates = self.detector.candidates(picture[None])[0]
            here = self.objective(candidates, shot.target) / len(shots)
            found = torch.autograd.grad(here, list(leaves.values()), materialize_grads=True)
            for name, gradient in zip(leaves, found, strict=True):
                gradients[name] += gradient
            loss += float(here.detach())
            detections = self._detect(quantise(picture))
            verdicts.append(self.objective.verdict(detections, shot.target))
        whole = together(verdicts, self.share)
        return Evaluation(loss=loss, gradients=gradients, success=whole.success, score=whole.score, clear=whole.clear)

    def _judge(self, scene: GaussianScene, camera: Camera) -> tuple[Tensor, Detections]:
        with torch.no_grad():
            picture = through_png(self.render(scene, camera))
        return picture, self._detect(picture)

    def _detect(self, picture: Tensor) -> Detections:
        with torch.no_grad():
            return self.detector.detect(picture[None])[0]


def together(verdicts: Sequence[Verdict], share: float) -> Verdict:
    """Success in at least `share` of the views, and the score that so many views reach."""
    needed = math.ceil(share * len(verdicts) - 1e-9)
    return Verdict(
        success=sum(verdict.success for verdict in verdicts) >= needed,
        score=reached([verdict.score for verdict in verdicts], share),
        clear=sum(verdict.clear for verdict in verdicts) >= needed,
    )


def reached(values: Sequence[float], share: float) -> float:
    """The largest value that at least `share` of all values reach."""
    return sorted(values, reverse=True)[math.ceil(share * len(values) - 1e-9) - 1]


def _seen(detections: Detections, box: Tensor) -> str | None:
    """What the detector calls the object: the most confident detection on it."""
    if not len(detections):
        return None
    scores = torch.where(overlap(detections.boxes, box) >= 0.5, detections.scores, -1.0)
    best = int(scores.argmax())
    return detections.labels[best] if float(scores[best]) > 0 else None


class _Bounded(torch.autograd.Function):
    """Clamp to [0, 1] with the derivative of a projection.

    A pixel at the clamp keeps its derivative when descent would bring it back inside, so a bright pixel can become
    darker.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.save_for_backward(image)
        return image.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (image,), (gradient,) = ctx.saved_tensors, gradients
        stuck = ((image > 1) & (gradient < 0)) | ((image < 0) & (gradient > 0))
        return torch.where(stuck, 0.0, gradient)


def _bounded(image: Tensor) -> Tensor:
    bounded: Tensor = _Bounded.apply(image)
    return bounded
