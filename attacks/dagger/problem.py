"""The problem that an attack solves: one object, the detector, the aim; as the attacker sees it and as it is judged.

The attacker differentiates what the detector considers in the picture as it is rendered. Judged are the detections in
pictures of 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from attacks.detectors.base import Detections, Detector
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective, Target, Verdict, confidence, overlap
from attacks.observe.views import ViewDetections, detect_views, visible_box, visible_weight
from attacks.pgd import Evaluation, Parameters
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import quantise
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.frozen_view import FrozenView


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AttackView:
    """One view before the attack.

    Attributes:
        camera: Where from.
        target: The object's box and classes in this view.
        weight: (H, W) fraction of each pixel that the object makes up.
        image: (H, W, 3) clean picture, 8 bits in [0, 1].
        detections: What is reported in it.
    """

    camera: Camera
    target: Target
    weight: Tensor
    image: Tensor
    detections: Detections


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ViewResult:
    """One view before and after an attack.

    Attributes:
        before: The clean scene.
        after: The attacked scene, from the same camera.
        verdict: Success and score.
    """

    before: AttackView
    after: ViewDetections
    verdict: Verdict

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        """Highest score with which `label` (any class if None) is detected on the object, clean or attacked."""
        detections = self.after.detections if attacked else self.before.detections
        return confidence(detections, self.before.target.box, labels=None if label is None else [label])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AttackProblem:
    """Everything about an attack that stays the same while it runs.

    Attributes:
        subset: The object in its scene.
        detector: The one attacked.
        objective: The aim.
        render: The renderer.
        required_views: Fraction of the views in which the aim has to be reached.
        frozen: The search's pictures from these cameras, while SH alone changes; from all others they are `render`'s,
            as all that are judged.
    """

    subset: GaussianSubset
    detector: Detector
    objective: Objective
    render: RenderFn
    required_views: float = 1.0
    frozen: Mapping[Camera, FrozenView] = field(default_factory=dict)

    def view(self, camera: Camera) -> AttackView:
        """The clean scene as seen from `camera`.

        Raises:
            InvalidValueError: The object is not visible from there.
        """
        weight = visible_weight(self.subset, camera, self.render)
        box = visible_box(weight)
        if box is None:
            raise InvalidValueError(
                message(
                    "camera", "a view in which the object is visible", "none of it", "turn the camera or choose another"
                )
            )
        (seen,) = detect_views(self.subset.scene, [camera], [self.detector], render=self.render)
        target = Target(
            box=box,
            label=self.objective.label,
            classes=self.detector.classes,
            original=_label_on(seen.detections, box),
        )
        return AttackView(camera=camera, target=target, weight=weight, image=seen.image, detections=seen.detections)

    def judge(self, scene: GaussianScene, views: Sequence[AttackView]) -> tuple[ViewResult, ...]:
        """Judge a scene from every camera, on 8-bit pictures that went through PNG."""
        # One picture at a time: the same bits whatever the number of views.
        cameras = [view.camera for view in views]
        seen = detect_views(scene, cameras, [self.detector], render=self.render, batch=1)
        return tuple(
            ViewResult(before=view, after=after, verdict=self.objective.verdict(after.detections, view.target))
            for view, after in zip(views, seen, strict=True)
        )

    def evaluate(self, parameters: Parameters, views: Sequence[AttackView]) -> Evaluation:
        """Loss and gradients (mean over the views), success and score at one point of the search.

        Views are differentiated one after the other, so that memory does not grow with their number.
        """
        loss, verdicts = 0.0, []
        gradients = {name: torch.zeros_like(value) for name, value in parameters.items()}
        for view in views:
            leaves = {name: value.detach().requires_grad_(True) for name, value in parameters.items()}
            picture = bounded(self._picture(leaves, view.camera))
            candidates = self.detector.candidates(picture[None])[0]
            here = self.objective(candidates, view.target) / len(views)
            found = torch.autograd.grad(here, list(leaves.values()), materialize_grads=True)
            for name, gradient in zip(leaves, found, strict=True):
                gradients[name] += gradient
            loss += float(here.detach())
            with torch.no_grad():
                detections = self.detector.detect(quantise(picture)[None])[0]
            verdicts.append(self.objective.verdict(detections, view.target))
        whole = joint_verdict(verdicts, self.required_views)
        return Evaluation(
            loss=loss, gradients=gradients, success=whole.success, score=whole.score, unambiguous=whole.unambiguous
        )

    def _picture(self, parameters: Parameters, camera: Camera) -> Tensor:
        """The scene with these parameters of the object, differentiable."""
        frozen = self.frozen.get(camera) if parameters.keys() == {"sh"} else None
        return self.render(self.subset.scene_with(parameters), camera) if frozen is None else frozen(parameters["sh"])


def joint_verdict(verdicts: Sequence[Verdict], required_views: float) -> Verdict:
    """Success in at least a fraction of the views, and the score that so many views reach."""
    needed = _needed(len(verdicts), required_views)
    return Verdict(
        success=sum(verdict.success for verdict in verdicts) >= needed,
        score=reached_by([verdict.score for verdict in verdicts], required_views),
        unambiguous=sum(verdict.unambiguous for verdict in verdicts) >= needed,
    )


def reached_by(values: Sequence[float], required_views: float) -> float:
    """The largest value that at least a fraction of the views reach."""
    return sorted(values, reverse=True)[_needed(len(values), required_views) - 1]


def _needed(views: int, required_views: float) -> int:
    # 0.07 * 100 is a little more than 7: rounding must not ask for one view more.
    return math.ceil(required_views * views - 1e-9)


def _label_on(detections: Detections, box: Tensor) -> str | None:
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


def bounded(image: Tensor) -> Tensor:
    """A picture clamped to [0, 1], with the derivative of a projection where it was outside."""
    inside: Tensor = _Bounded.apply(image)
    return inside
