"""The problem that an attack on a distribution of views solves: losses of some views, verdicts of others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.dagger.eot.views import DrawnView
from attacks.dagger.problem import bounded
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective, Target, Verdict
from attacks.pgd import Parameters
from mi_splat.cameras import Camera, RenderFn
from mi_splat.io.images import quantise
from mi_splat.scene import GaussianScene

_LOOKED_AT_ONCE = 4
"""Pictures that a detector gets together when nothing is differentiated."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Estimate:
    """What the views of one step say of a point.

    Attributes:
        loss: Lower is better for the attacker.
        gradients: Of the loss by each parameter.
        error: Mean squared error of the pictures; 0 where nothing asked for it.
    """

    loss: float
    gradients: Parameters
    error: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EotProblem:
    """Everything about an attack that stays the same while it runs.

    Attributes:
        subset: The object in its scene.
        detectors: Those attacked, all at once.
        objective: The aim.
        originals: What each detector calls the clean object in most views, by the detector's name; None for nothing.
        render: The renderer.
        clean: The clean scene's picture from a camera.
    """

    subset: GaussianSubset
    detectors: tuple[Detector, ...]
    objective: Objective
    originals: Mapping[str, str | None]
    render: RenderFn
    clean: Callable[[Camera], Tensor]

    def reference(self, attributes: Sequence[str], sh_degree: int | None) -> Parameters:
        """What may change: the object's rows of the attributes, of SH only the coefficients up to a degree."""
        found = self.subset.parameters(attributes)
        if "sh" in found and sh_degree is not None:
            found["sh"] = found["sh"][:, : (sh_degree + 1) ** 2]
        return found

    def complete(self, parameters: Parameters) -> Parameters:
        """The parameters with the SH coefficients that may not change."""
        sh = parameters.get("sh")
        if sh is None or sh.shape[1] == self.subset.clean["sh"].shape[1]:
            return parameters
        return {**parameters, "sh": torch.cat([sh, self.subset.clean["sh"][:, sh.shape[1] :]], 1)}

    def applied(self, parameters: Parameters) -> GaussianScene:
        """The attacked scene; what did not move keeps the very bits it had."""
        return self.subset.applied(self.complete(parameters))

    def target(self, view: DrawnView, detector: Detector) -> Target:
        """The object in a view, as an objective wants it."""
        return Target(
            box=view.box,
            label=self.objective.label,
            classes=detector.classes,
            original=self.originals[detector.name],
        )

    def loss(self, parameters: Parameters, views: Sequence[DrawnView], weight: float = 0.0) -> Estimate:
        """Mean loss over views and detectors, and its gradients.

        Every picture is rendered once for all detectors, and a detector gets all pictures together.

        Args:
            parameters: A point of the search.
            views: Those of one step, whose pictures have one size.
            weight: Of the mean squared error of the pictures, before anything happens to them, in the loss.
        """
        leaves = {name: value.detach().requires_grad_(True) for name, value in parameters.items()}
        scene = self.subset.scene_with(self.complete(leaves))
        rendered = [bounded(self.render(scene, view.camera)) for view in views]
        pictures = torch.stack([view.changed(picture) for picture, view in zip(rendered, views, strict=True)])
        total = pictures.new_zeros(())
        for detector in self.detectors:
            for view, candidates in zip(views, detector.candidates(pictures), strict=True):
                total = total + self.objective(candidates, self.target(view, detector))
        total = total / (len(views) * len(self.detectors))
        error = 0.0
        if weight:
            squares = torch.stack([self._error(one, view) for one, view in zip(rendered, views, strict=True)]).mean()
            total, error = total + weight * squares, float(squares.detach())
        found = torch.autograd.grad(total, list(leaves.values()), materialize_grads=True)
        return Estimate(loss=float(total.detach()), gradients=dict(zip(leaves, found, strict=True)), error=error)

    def error(self, parameters: Parameters, views: Sequence[DrawnView]) -> float:
        """Mean squared error of the views' pictures, values in [0, 1], before anything random happens to them."""
        with torch.no_grad():
            scene = self.subset.scene_with(self.complete(parameters))
            errors = [self._error(self.render(scene, view.camera).clamp(0, 1), view) for view in views]
            return float(torch.stack(errors).mean())

    def _error(self, picture: Tensor, view: DrawnView) -> Tensor:
        return (picture - self.clean(view.camera)).square().mean()

    def verdicts(self, parameters: Parameters, views: Sequence[DrawnView]) -> list[list[Verdict]]:
        """For each view the verdict of every detector, on 8-bit pictures."""
        rows: list[list[Verdict]] = []
        with torch.no_grad():
            scene = self.subset.scene_with(self.complete(parameters))
            for first in range(0, len(views), _LOOKED_AT_ONCE):
                some = views[first : first + _LOOKED_AT_ONCE]
                pictures = torch.stack([self._picture(scene, view) for view in some])
                found = [detector.detect(pictures) for detector in self.detectors]
                rows += [
                    [
                        self.objective.verdict(reports[place], self.target(view, detector))
                        for detector, reports in zip(self.detectors, found, strict=True)
                    ]
                    for place, view in enumerate(some)
                ]
        return rows

    def _picture(self, scene: GaussianScene, view: DrawnView) -> Tensor:
        return quantise(view.changed(self.render(scene, view.camera).clamp(0, 1)))


def joined(rows: Sequence[Sequence[Verdict]]) -> tuple[int, float]:
    """Number of views in which every detector is deceived, and a score in [0, 1].

    The score orders by that number, and between equals by the mean of the verdicts' scores.
    """
    successes = sum(all(verdict.success for verdict in row) for row in rows)
    mean = sum(min(verdict.score for verdict in row) for row in rows) / len(rows)
    return successes, (successes + mean) / (len(rows) + 1)
