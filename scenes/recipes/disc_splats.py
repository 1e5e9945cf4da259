"""Splats from meshes: flat Gaussians on the surface, coloured from path-traced images
and refined against them.

`disc_splat` lays a disc on each of some points of a surface and fits its colour to the
images in which it is visible; `refine` improves all attributes through a renderer.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import RenderFn, View
from mi_splat.capture.surface_points import SurfaceSamples, fit_colours
from mi_splat.errors import InvalidValueError
from mi_splat.io.parameters import activate, to_raw_parameters
from mi_splat.maths.rotation import from_matrix
from mi_splat.scene import GaussianScene

OnStep = Callable[[int, float], None]
"""Called after each step of `refine` with its number and its loss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscConfig:
    """How discs are laid and coloured.

    Attributes:
        degree: SH degree of the colours, 0 or 1.
        overlap: Standard deviation along the surface in units of the distance between
            samples.
        thickness: Standard deviation across the surface in the same unit.
        opacity: Opacity of every disc.
        damping: Ridge weight on the SH coefficients above degree 0, in units of fully
            visible pixels.
        tolerance: Relative difference to the depth map up to which a sample counts as
            visible.
    """

    degree: int = 1
    overlap: float = 0.62
    thickness: float = 0.06
    opacity: float = 0.96
    damping: float = 2.0
    tolerance: float = 0.015


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """Adam on the tensors of a splat file; one random view a step.

    Attributes:
        steps: Number of steps.
        means: Step size of the means in units of each Gaussian's largest standard
            deviation.
        scales: Step size of log-scales.
        rotations: Step size of quaternions.
        opacities: Step size of logits.
        sh: Step size of SH coefficients.
        smallest: Lower limit of the standard deviations, world units.
    """

    steps: int = 800
    means: float = 0.02
    scales: float = 0.01
    rotations: float = 0.004
    opacities: float = 0.02
    sh: float = 0.006
    smallest: float = 1e-3


def _frames(normals: Tensor) -> Tensor:
    """(N, 3, 3) rotations whose third column is the normal."""
    helper = torch.where(
        normals[:, 2:].abs() < 0.9,
        normals.new_tensor([0.0, 0, 1]),
        normals.new_tensor([1.0, 0, 0]),
    )
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    return torch.stack([first, torch.linalg.cross(normals, first), normals], dim=2)


def disc_splat(
    samples: SurfaceSamples,
    views: Sequence[View],
    depths: Sequence[Tensor],
    *,
    config: DiscConfig | None = None,
) -> GaussianScene:
    """A splat of flat discs on the samples that at least one view sees; the others are
    left out.
    """
    config = config or DiscConfig()
    sh, seen = fit_colours(
        samples,
        views,
        depths,
        degree=config.degree,
        damping=config.damping,
        tolerance=config.tolerance,
    )
    keep = seen > 0
    if not keep.any():
        raise InvalidValueError.of(
            "views", "images that show the surface", "none that does", "move cameras"
        )
    spacing = torch.from_numpy(samples.spacing)[keep]
    scales = torch.stack(
        [config.overlap * spacing] * 2 + [config.thickness * spacing], dim=1
    ).clamp(min=1e-3)
    return GaussianScene(
        torch.from_numpy(samples.points)[keep],
        scales,
        from_matrix(_frames(torch.from_numpy(samples.normals)[keep])),
        torch.full((int(keep.sum()),), config.opacity),
        sh[keep],
    )


def refine(
    scene: GaussianScene,
    views: Sequence[View],
    *,
    render: RenderFn,
    config: RefineConfig | None = None,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> GaussianScene:
    """Fit a splat to views by Adam; the number and order of the Gaussians stay as they
    are.

    Adam is that of Kingma and Ba (2015). The loss is the mean absolute difference plus
    half of the mean squared one; steps shrink along a cosine (Loshchilov and Hutter
    2017) to a tenth.
    """
    config = config or RefineConfig()
    start = {
        name: value.detach().clone() for name, value in to_raw_parameters(scene).items()
    }
    unit = scene.scales.max(dim=1, keepdim=True).values.detach()
    offset = torch.zeros_like(start["means"])
    values = {name: value for name, value in start.items() if name != "means"} | {
        "offset": offset
    }
    rates = {
        "offset": config.means,
        **{name: float(getattr(config, name)) for name in values if name != "offset"},
    }
    for value in values.values():
        value.requires_grad_(True)
    optimiser = torch.optim.Adam(
        [{"params": [values[name]], "lr": rates[name]} for name in values], eps=1e-12
    )
    rates_now = [group["lr"] for group in optimiser.param_groups]
    rng = np.random.default_rng([seed, 0xF17])
    order: list[int] = []

    def current() -> GaussianScene:
        parts = {name: value for name, value in values.items() if name != "offset"}
        return GaussianScene.unchecked(
            *activate({**parts, "means": start["means"] + values["offset"] * unit})
        )

    for step in range(config.steps):
        if not order:
            order = [int(i) for i in rng.permutation(len(views))]
        view = views[order.pop()]
        for group, rate in zip(optimiser.param_groups, rates_now, strict=True):
            group["lr"] = rate * (
                0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / config.steps))
            )
        optimiser.zero_grad(set_to_none=True)
        error = render(current(), view.camera) - view.image
        loss = error.abs().mean() + 0.5 * error.square().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        with torch.no_grad():
            values["scales"].clamp_(min=math.log(config.smallest))
            values["opacities"].clamp_(-6.0, 9.0)
        if on_step is not None:
            on_step(step + 1, float(loss.detach()))
    with torch.no_grad():
        result = current()
    return GaussianScene(*(value.detach() for value in result.tensors()))
