"""Splats from meshes: flat Gaussians on the surface, coloured from path-traced pictures and refined against them.

`surface_samples` spreads points over an asset, denser where cameras are near; `disc_splat` lays a disc on each and fits
its colour to the pictures in which it is visible; `refine` improves all attributes through a renderer.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras import RenderFn, View, project_points
from mi_splat.capture.surface_sampling import SurfaceSamples
from mi_splat.errors import InvalidValueError
from mi_splat.io.parameters import activate, to_raw_parameters
from mi_splat.rotation import from_matrix
from mi_splat.scene import GaussianScene
from mi_splat.sh import sh_basis

OnStep = Callable[[int, float], None]
"""Called after each step of `refine` with its number and its loss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscConfig:
    """How discs are laid and coloured.

    Attributes:
        degree: SH degree of the colours, 0 or 1.
        overlap: Standard deviation along the surface in units of the distance between samples.
        thickness: Standard deviation across the surface in the same unit.
        opacity: Opacity of every disc.
        damping: Ridge weight on the SH coefficients above degree 0, in units of fully visible pixels.
        tolerance: Relative difference to the depth map up to which a sample counts as visible.
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
        means: Step size of the means in units of each Gaussian's largest standard deviation.
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
    helper = torch.where(normals[:, 2:].abs() < 0.9, normals.new_tensor([0.0, 0, 1]), normals.new_tensor([1.0, 0, 0]))
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    return torch.stack([first, torch.linalg.cross(normals, first), normals], dim=2)


def _observe(samples: SurfaceSamples, view: View, depth: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Samples in one view: (N,) weight of each (0 where hidden), (N, 3) its colour, (N, 3) direction to it."""
    points, normals = torch.from_numpy(samples.points), torch.from_numpy(samples.normals)
    camera = view.camera
    pixels, forward = project_points(points, camera)
    offset = points - camera.position.to(points)
    distance = offset.norm(dim=1)
    direction = offset / distance[:, None]
    column, row = pixels[:, 0].floor().long(), pixels[:, 1].floor().long()
    inside = (forward > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface = depth[row, column]
    facing = (direction * normals).sum(1).abs()
    slack = tolerance * distance + 0.02 + 0.5 * distance / camera.fx / facing.clamp(min=0.08)
    sky = surface <= 0  # nothing else there: only what lies beyond every surface, the dome, can be seen
    visible = inside & torch.where(sky, distance > 60, (distance - surface).abs() < slack)
    return visible * facing.clamp(min=0.05), view.image[row, column], direction


def fit_colours(
    samples: SurfaceSamples, views: Sequence[View], depths: Sequence[Tensor], config: DiscConfig
) -> tuple[Tensor, Tensor]:
    """Least-squares SH of each sample over the views that see it, by ridge regression (Hoerl and Kennard 1970)."""
    count, size = len(samples.points), (config.degree + 1) ** 2
    left = torch.zeros(count, size, size)
    right = torch.zeros(count, size, 3)
    seen = torch.zeros(count)
    for view, depth in zip(views, depths, strict=True):
        weight, colour, direction = _observe(samples, view, depth, config.tolerance)
        basis = sh_basis(direction, config.degree)
        left += (weight[:, None] * basis)[:, :, None] * basis[:, None]
        right += (weight[:, None] * basis)[:, :, None] * (colour - 0.5)[:, None]
        seen += weight > 0
    ridge = torch.full((size,), config.damping)
    ridge[0] = 1e-4
    return torch.linalg.solve(left + torch.diag(ridge), right), seen


def disc_splat(
    samples: SurfaceSamples, views: Sequence[View], depths: Sequence[Tensor], *, config: DiscConfig | None = None
) -> GaussianScene:
    """A splat of flat discs on the samples that at least one view sees; the others are left out."""
    config = config or DiscConfig()
    sh, seen = fit_colours(samples, views, depths, config)
    keep = seen > 0
    if not keep.any():
        raise InvalidValueError.of("views", "pictures that show the surface", "none that does", "move cameras")
    spacing = torch.from_numpy(samples.spacing)[keep]
    scales = torch.stack([config.overlap * spacing] * 2 + [config.thickness * spacing], dim=1).clamp(min=1e-3)
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
    """Fit a splat to views by Adam; the number and order of the Gaussians stay as they are.

    Adam is that of Kingma and Ba (2015). The loss is the mean absolute difference plus half of the mean squared one;
    steps shrink along a cosine (Loshchilov and Hutter 2017) to a tenth.
    """
    config = config or RefineConfig()
    start = {name: value.detach().clone() for name, value in to_raw_parameters(scene).items()}
    unit = scene.scales.max(dim=1, keepdim=True).values.detach()
    offset = torch.zeros_like(start["means"])
    values = {name: value for name, value in start.items() if name != "means"} | {"offset": offset}
    rates = {"offset": config.means, **{name: float(getattr(config, name)) for name in values if name != "offset"}}
    for value in values.values():
        value.requires_grad_(True)
    optimiser = torch.optim.Adam([{"params": [values[name]], "lr": rates[name]} for name in values], eps=1e-12)
    rates_now = [group["lr"] for group in optimiser.param_groups]
    rng = np.random.default_rng([seed, 0xF17])
    order: list[int] = []

    def current() -> GaussianScene:
        parts = {name: value for name, value in values.items() if name != "offset"}
        return GaussianScene.unchecked(*activate({**parts, "means": start["means"] + values["offset"] * unit}))

    for step in range(config.steps):
        if not order:
            order = [int(i) for i in rng.permutation(len(views))]
        view = views[order.pop()]
        for group, rate in zip(optimiser.param_groups, rates_now, strict=True):
            group["lr"] = rate * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / config.steps)))
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
