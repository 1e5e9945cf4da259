"""The problem that an attack solves: one object, the detectors, the aim; as the
attacker sees it.

The attacker differentiates what detectors consider in the image as it is rendered.
What they report, in images of 8 bits, decides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.views import View
from attacks.detectors.base import Detector
from attacks.detectors.registry import operating_threshold
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives.base import Objective, Target
from attacks.objectives.relabel import Relabel
from attacks.objectives.verdicts import overall_verdict
from attacks.observe.rates import REPORTED
from attacks.observe.views import visible_box, visible_weight
from attacks.search.loop import Evaluation, Verdict
from attacks.search.parameters import Parameters
from attacks.threats import THREATS
from mi_splat.cameras.camera import Camera, RenderFn, project_box
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.io.images import quantise
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.render.frozen_view import FrozenView
    from mi_splat.render.view_freezing import RecentViews


_PARTS = 6
"""Windows across the longer side of an object's box, in which its error is looked
at.
"""
_POWER = 8
_TINY = 1e-12
"""Power of the norm over these windows, and what is added where a root has no
derivative.
"""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Problem:
    """Everything about an attack that stays the same while it runs.

    Attributes:
        subset: The object in its scene.
        detectors: Those attacked, all at once.
        objective: The aim.
        originals: What a detector calls the clean object in a view, by the detector's
            name; None for nothing.
        render: The renderer.
        clean: The clean scene's image from a camera.
        frozen: The search's images from these cameras, while SH alone changes; from
            all others they are `render`'s, as all of which detectors' reports count.
        on_object: Whether errors of images are those of the object's pixels alone.
        local_gap: How far below the PSNR of the object a part of it may be, dB; None
            sets no limit.
    """

    subset: GaussianSubset
    detectors: tuple[Detector, ...]
    objective: Objective
    originals: Callable[[View, str], str | None]
    render: RenderFn
    clean: Callable[[Camera], Tensor]
    frozen: dict[Camera, FrozenView] | RecentViews = field(default_factory=dict)
    on_object: bool = False
    local_gap: float | None = None

    def target(
        self, view: View, detector: Detector, box: Tensor | None = None
    ) -> Target:
        """The object in a view, as an objective wants it; in another box where it has
        moved.
        """
        original = self.originals(view, detector.name)
        return Target(
            box=view.box if box is None else box,
            label=self.objective.label,
            classes=detector.classes,
            original=original,
            threshold=counted_from(self.objective, detector),
        )

    def box(self, view: View, parameters: Parameters) -> Tensor | None:
        """Where an object shows that a threat has moved, by how far the outermost means
        have moved in the image; None where no threat moves it.
        """
        if not any(name in THREATS for name in parameters):
            return None
        means = self.subset.moved(parameters).get("means")
        if means is None:
            return None
        before = project_box(self.subset.clean["means"], view.camera)
        after = project_box(means.detach(), view.camera)
        if before is None or after is None:
            return None
        return view.box + (after - before).to(view.box)

    def shown_box(self, view: View, scene: GaussianScene) -> Tensor | None:
        """Where the object shows in a scene of its Gaussians; None where it does
        not.
        """
        subset = replace(self.subset, scene=scene)
        return visible_box(visible_weight(subset, view.camera, self.render))

    def evaluate(
        self,
        parameters: Parameters,
        views: Sequence[View],
        config: DaggerConfig,
        *,
        price: float = 0.0,
        judged: bool = True,
    ) -> Evaluation:
        """Loss and gradients over some views, the images' squared error at its price,
        and a verdict if it is wanted.

        Views are differentiated one after the other, so that memory does not grow with
        their number, and each is rendered once for all detectors. The loss is the mean
        of the detectors' losses (Liu et al., "Delving into Transferable Adversarial
        Examples and Black-box Attacks", ICLR 2017). Nothing is differentiated for an
        optimiser that knows the loss alone.
        """
        with torch.set_grad_enabled(config.spec.gradient):
            evaluation, rows = self._evaluate(parameters, views, price, judged)
        return replace(
            evaluation,
            verdict=overall_verdict(rows, config.required_views) if judged else None,
        )

    def _evaluate(
        self, parameters: Parameters, views: Sequence[View], price: float, judged: bool
    ) -> tuple[Evaluation, list[list[Verdict]]]:
        """Mean loss of the detectors over the views, its gradients, and the verdicts of
        each view.
        """
        loss = 0.0
        squares = 0.0
        rows = list[list[Verdict]]()
        share = len(views) * len(self.detectors)
        if torch.is_grad_enabled():
            gradients = {
                name: torch.zeros_like(value) for name, value in parameters.items()
            }
        else:
            gradients = {}
        for view in views:
            leaves = _leaves(parameters)
            row = list[Verdict]()
            box = self.box(view, parameters)
            rendered = bounded(self._differentiable(leaves, view.camera))
            shown = view.changed(rendered)
            picture = shown.detach().requires_grad_(torch.is_grad_enabled())
            along = torch.zeros_like(picture)
            for detector in self.detectors:
                target = self.target(view, detector, box)
                candidates = detector.candidates(picture[None])[0]
                here = self.objective(candidates, target) / share
                along += _gradients([here], {"picture": picture}).get("picture", 0.0)
                loss += float(here.detach())
                if judged:
                    if isinstance(self.objective, Relabel):
                        far = self.objective.far(candidates, target)
                    else:
                        far = None
                    row.append(
                        far or self._reported(detector, picture.detach(), target)
                    )
            rows.append(row)
            values = [shown]
            weights = [along]
            if price:
                error = self.image_error(rendered, view) / len(views)
                squares += float(error.detach())
                values = [shown, error]
                weights = [along, torch.full_like(error, price)]
            for name, gradient in _gradients(values, leaves, weights).items():
                gradients[name] += gradient
        return (
            Evaluation(loss=loss + price * squares, gradients=gradients, error=squares),
            rows,
        )

    def _reported(self, detector: Detector, picture: Tensor, target: Target) -> Verdict:
        """What a detector's report on the image at 8 bits says."""
        with torch.no_grad():
            return self.objective.verdict(
                detector.detect(quantise(picture)[None])[0], target
            )

    def _differentiable(self, parameters: Parameters, camera: Camera) -> Tensor:
        """The image of the scene with these parameters of the object."""
        frozen = self.frozen.get(camera) if parameters.keys() == {"sh"} else None
        if frozen is None:
            return self.render(self.subset.scene_with(parameters), camera)
        return frozen(self.subset.complete(parameters)["sh"])

    def image(self, parameters: Parameters, camera: Camera) -> Tensor:
        """The (H, W, 3) image of the scene with these parameters of the object, values
        in [0, 1]; no gradients.
        """
        with torch.no_grad():
            return self._differentiable(parameters, camera).clamp(0, 1)

    def error(self, parameters: Parameters, views: Sequence[View]) -> float:
        """Mean squared error of the views' images, values in [0, 1], before anything
        random happens to them; of the object, over its pixels of all views.
        """
        errors = torch.stack(
            [
                self.image_error(self.image(parameters, view.camera), view)
                for view in views
            ]
        )
        if not self.on_object:
            return float(errors.mean())
        pixels = torch.stack([view.on_object.sum() for view in views])
        return float((errors * pixels).sum() / pixels.sum())

    def image_error(self, picture: Tensor, view: View) -> Tensor:
        """Mean squared error of one (H, W, 3) image against the clean one; of the
        object, if that is limited, and then at least what its worst part allows.
        """
        squares = (picture - self.clean(view.camera)).square()
        if not self.on_object:
            return squares.mean()
        error = squares[view.on_object].mean()
        if self.local_gap is None:
            return error
        worst = _worst_part(squares.mean(dim=2), view)
        return torch.maximum(error, worst / 10 ** (self.local_gap / 10))

    def verdicts(
        self, parameters: Parameters, views: Sequence[View]
    ) -> list[list[Verdict]]:
        """For each view the verdict of every detector, on 8-bit images."""
        rows = list[list[Verdict]]()
        scene = self.subset.scene_with(parameters)
        with torch.no_grad():
            for view in views:
                picture = view.changed(self.render(scene, view.camera).clamp(0, 1))
                box = self.box(view, parameters)
                rows.append(
                    [
                        self._reported(one, picture, self.target(view, one, box))
                        for one in self.detectors
                    ]
                )
        return rows


def _worst_part(squares: Tensor, view: View) -> Tensor:
    """About the largest mean of (H, W) squares over the object's pixels in a window.

    Windows are a sixth of its box; those of which the object is less than half count by
    their part. A norm in the place of a maximum: its gradient reaches every window that
    is near the largest one, and it is never smaller.
    """
    left, top, right, bottom = view.box.tolist()
    side = max(1, round(max(right - left, bottom - top) / _PARTS))
    on_object = view.on_object.to(squares)
    planes = torch.stack([squares * on_object, on_object])[None]
    sums, shares = torch.nn.functional.avg_pool2d(
        planes, min(side, *squares.shape), stride=max(1, side // 2)
    )[0]
    means = sums / shares.clamp(min=0.5)
    largest = means.detach().max().clamp(min=_TINY)
    powers = (means / largest).pow(_POWER).sum()
    norm: Tensor = largest * (powers + _TINY).pow(1 / _POWER)
    return norm


def counted_from(objective: Objective, detector: Detector) -> float:
    """Confidence from which a detector's detections count: its operating threshold, or
    0.5 where the objective states a confidence of its own.
    """
    if getattr(objective, "confidence", None) is None:
        return operating_threshold(detector)
    return REPORTED


def _leaves(parameters: Parameters) -> Parameters:
    """The parameters as what is differentiated by, if anything is."""
    return {
        name: value.detach().requires_grad_(torch.is_grad_enabled())
        for name, value in parameters.items()
    }


def _gradients(
    values: Sequence[Tensor],
    leaves: Parameters,
    weights: Sequence[Tensor] | None = None,
) -> Parameters:
    """Derivative of the weighted sum of some values by each parameter; none where
    nobody asks.
    """
    if not torch.is_grad_enabled():
        return {}
    # as scalars, because torch imports sympy for gradients that are tensors
    if weights is not None:
        values = [
            (value * weight).sum()
            for value, weight in zip(values, weights, strict=True)
        ]
    parts = torch.autograd.grad(values, list(leaves.values()), materialize_grads=True)
    return dict(zip(leaves, parts, strict=True))


def check_detectors(detectors: Sequence[Detector], objective: Objective) -> None:
    """Raise unless there are detectors of different names that know the target
    class.
    """
    names = [detector.name for detector in detectors]
    if not names or len(set(names)) < len(names):
        do = "name each one once"
        raise InvalidValueError.of(
            "detector", "one detector, or several with different names", names, do
        )
    for detector in detectors:
        if objective.label is not None and objective.label not in detector.classes:
            of = "" if len(detectors) == 1 else f" of {detector.name}"
            expected = f"one of {', '.join(detector.classes)}"
            do = nearest(objective.label, detector.classes, "choose one of them")
            raise InvalidValueError.of(f"target{of}", expected, objective.label, do)


class _Bounded(torch.autograd.Function):
    """Clamp to [0, 1] with the derivative of a projection.

    A pixel at the clamp keeps its derivative when descent would bring it back inside,
    so a bright pixel can become darker.
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
    """An image clamped to [0, 1], with the derivative of a projection where it was
    outside.
    """
    inside: Tensor = _Bounded.apply(image)
    return inside
