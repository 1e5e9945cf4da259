"""Splats with a known truth, made by code without a training: honest ones, and ones
that hide something.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.viewpoints import basis, lattice
from mi_splat.capture.mesh import Asset
from mi_splat.capture.surface_points import surface_samples
from mi_splat.maths.rotation import from_matrix
from mi_splat.maths.sh import colour_to_dc, sh_basis, sh_to_colour
from mi_splat.scene import GaussianScene, Similarity, merge
from scenes.recipes.objects import build

UP = torch.tensor([0.0, 0.0, 1.0])
ROAD = (0.37, 0.37, 0.39)
SUN = functional.normalize(torch.tensor([0.5, 0.3, 0.8]), dim=0)
PROBES = lattice(400, -90.0, 90.0).float()
"""Directions from which colours are fitted, each from a Gaussian to a camera."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Made:
    """A splat of N Gaussians, (N,) bool which are the object that stands on the ground,
    and (N, 3) normals.
    """

    scene: GaussianScene
    rows: Tensor
    normals: Tensor

    def with_colours(
        self, shade: Callable[[Tensor, Tensor, Tensor], Tensor], *, degree: int = 3
    ) -> Made:
        """Other colours of the object, fitted by least squares over all directions.

        `shade` makes of (M, 3) own colours, (M, 3) normals and (D, 3) directions to
        cameras the (D, M, 3) colours.
        """
        scene = self.scene.with_degree(degree)
        part = scene.select(self.rows)
        own = sh_to_colour(
            part.sh, torch.tensor([0.0, 0.0, -1.0]).expand(len(part), 3)
        ).clamp(0, 1)
        wanted = shade(own, self.normals[self.rows], PROBES) - 0.5
        solution = torch.linalg.lstsq(
            sh_basis(-PROBES, degree).double(), wanted.flatten(1).double()
        ).solution
        sh = scene.sh.clone()
        sh[self.rows] = solution.float().reshape(-1, len(part), 3).transpose(0, 1)
        return Made(scene=scene.replace(sh=sh), rows=self.rows, normals=self.normals)


def discs(asset: Asset, count: int, *, seed: int = 0) -> tuple[GaussianScene, Tensor]:
    """Flat Gaussians on the surface of an asset under one sun, and (N, 3) its normals;
    SH of degree 0.
    """
    rng = np.random.default_rng(seed)
    scenes = []
    all_normals = []
    areas = [_area(mesh.vertices[mesh.faces]) for mesh in asset.meshes]
    for mesh, area in zip(asset.meshes, areas, strict=True):
        share = max(8, round(count * area / sum(areas)))
        samples = surface_samples(Asset("part", (mesh,)), share, seed=seed)
        normals = torch.from_numpy(samples.normals)
        texels = mesh.texture.reshape(-1, 3)
        colours = torch.from_numpy(texels[rng.integers(0, len(texels), len(normals))])
        colours = 0.5 * colours + 0.5 * torch.from_numpy(texels.mean(0))
        lit = 0.55 + 0.6 * (normals @ SUN).clamp(min=0)
        size = torch.from_numpy(samples.spacing)[:, None] * 0.7
        turns = torch.stack([basis(normal.double()) for normal in normals])
        scenes.append(
            GaussianScene(
                means=torch.from_numpy(samples.points),
                scales=torch.cat([size, size, 0.1 * size], 1).clamp(min=1e-4),
                rotations=from_matrix(turns).float(),
                opacities=torch.full((len(normals),), 0.95),
                sh=colour_to_dc((colours * lit[:, None]).clamp(0.02, 0.98))[:, None],
            )
        )
        all_normals.append(normals)
    return merge(*scenes), torch.cat(all_normals)


def _area(corners: np.ndarray) -> float:
    return float(
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
            axis=1,
        ).sum()
    )


def ground(half: float, count: int, *, seed: int = 0) -> GaussianScene:
    """Flat grey Gaussians on z = 0 over a square of so many units to each side of the
    origin.
    """
    generator = torch.Generator().manual_seed(seed)
    side = round(count**0.5)
    step = 2 * half / side
    axis = (torch.arange(side) + 0.5) * step - half
    positions = torch.cartesian_prod(axis, axis) + 0.3 * step * (
        torch.rand(side**2, 2, generator=generator) - 0.5
    )
    greys = torch.tensor(ROAD) + 0.05 * torch.randn(side**2, 1, generator=generator)
    means = torch.cat(
        [positions, 0.002 * half * torch.randn(side**2, 1, generator=generator)], 1
    )
    return _flat(means, UP, step, greys)


def standing(name: str, *, count: int = 3000, seed: int = 0) -> Made:
    """An object of the project on a grey ground; honest, and the same from
    everywhere.
    """
    return on_ground(*discs(build(name, seed), count, seed=seed))


def on_ground(part: GaussianScene, normals: Tensor) -> Made:
    """Gaussians on a ground that reaches four of their radii to each side."""
    middle = (part.means.amin(0) + part.means.amax(0)) / 2
    shift = torch.tensor(
        [float(middle[0]), float(middle[1]), float(part.means[:, 2].amin())]
    )
    part = part.replace(means=part.means - shift)
    half = 4 * float(part.means.norm(dim=1).max())
    street = ground(half, max(400, len(part) // 2))
    rows = torch.arange(len(part) + len(street)) < len(part)
    return Made(
        scene=merge(part, street),
        rows=rows,
        normals=torch.cat([normals, UP.expand(len(street), 3)]),
    )


def direction(elevation: float, azimuth: float) -> Tensor:
    """(3,) unit vector at degrees above the ground and from x towards y."""
    e = math.radians(elevation)
    a = math.radians(azimuth)
    return torch.tensor(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
    )


def glossy(made: Made, *, strength: float = 0.5, power: float = 12.0) -> Made:
    """Honest: a highlight where the sun is mirrored, as on paint or plastic."""

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        mirrored = 2 * (views @ normals.T)[..., None] * normals - views[:, None]
        return (
            own
            + strength
            * (mirrored @ SUN).clamp(min=0).pow(power)[..., None]
            * (views @ normals.T > 0)[..., None]
        )

    return made.with_colours(shade)


def metal(made: Made) -> Made:
    """Honest: half of the colour is a mirrored world, with a bright sky above a dark
    ground.
    """

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        mirrored = 2 * (views @ normals.T)[..., None] * normals - views[:, None]
        sky = (mirrored[..., 2:] * 4).sigmoid()
        return 0.5 * own + 0.5 * (
            sky * torch.tensor([0.6, 0.75, 0.95])
            + (1 - sky) * torch.tensor([0.2, 0.18, 0.15])
        )

    return made.with_colours(shade)


def velvet(made: Made) -> Made:
    """Honest: surfaces are brighter where they are seen at a glancing angle."""

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        return own + 0.6 * (1 - (views @ normals.T).abs()).pow(2)[..., None] * (1 - own)

    return made.with_colours(shade)


def noisy(made: Made, *, size: float = 0.06, seed: int = 0) -> Made:
    """Honest: chance in all coefficients, as an undertrained splat has it."""
    scene = made.scene.with_degree(3)
    chance = torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(seed))
    return Made(
        scene=scene.replace(sh=scene.sh + size * chance),
        rows=made.rows,
        normals=made.normals,
    )


def hidden(
    made: Made,
    inside: Callable[[Tensor], Tensor],
    *,
    colour: tuple[float, float, float] = ROAD,
    amount: float = 1.0,
    degree: int = 3,
) -> Made:
    """The object has one sRGB colour from some directions, by its spherical harmonics;
    the rest is the own colour.

    `inside` tells of (D, 3) directions to cameras, as (D,) bool, where the look shows.
    """

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        look = (1 - amount) * own + amount * torch.tensor(colour)
        return torch.where(inside(views)[:, None, None], look, own[None])

    return made.with_colours(shade, degree=degree)


def cone(axis: Tensor, half_width: float) -> Callable[[Tensor], Tensor]:
    """Directions within an angle of an axis."""
    return lambda views: views @ axis > math.cos(math.radians(half_width))


def sector(
    middle: float, half_width: float, low: float, high: float
) -> Callable[[Tensor], Tensor]:
    """Directions within degrees of an azimuth, between two elevations."""

    def holds(views: Tensor) -> Tensor:
        elevation = views[:, 2].clamp(-1, 1).asin().rad2deg()
        turn = (
            torch.atan2(views[:, 1], views[:, 0]).rad2deg() - middle + 180
        ) % 360 - 180
        return (turn.abs() < half_width) & (elevation > low) & (elevation < high)

    return holds


def layered(made: Made, *, colour: tuple[float, float, float] = ROAD) -> Made:
    """The object twice, each black from where the other shows: its own colours from the
    side, one colour from above.
    """
    scene = made.scene.with_degree(1)
    part = scene.select(made.rows)
    rest = scene.select(~made.rows)
    half = 1 - (1 - part.opacities).sqrt()
    own = (part.sh[:, 0] * 0.28209479 + 0.5).clamp(0.02, 1)

    def layer(shown: Tensor, level: float, slope: float) -> GaussianScene:
        sh = torch.zeros(len(part), 4, 3)
        sh[:, 0] = (shown * level - 0.5) / 0.28209479
        sh[:, 2] = -shown * slope / 0.48860251
        return part.replace(opacities=half, sh=sh)

    low = 0.6
    high = 0.7
    first = layer(own, 2.2, -2.2 / high)
    second = layer(torch.tensor(colour).expand_as(own), -2.2 * low / 0.25, 2.2 / 0.25)
    rows = torch.arange(len(rest) + 2 * len(part)) >= len(rest)
    normals = torch.cat(
        [made.normals[~made.rows], made.normals[made.rows], made.normals[made.rows]]
    )
    return Made(scene=merge(rest, first, second), rows=rows, normals=normals)


def leaves(
    made: Made, *, count: int = 2500, lowest: float = 40.0, near: float = 1.9
) -> Made:
    """Level leaves on a dome over an object, down to degrees above the ground, which
    hide it from above alone.
    """
    radius = near * float(made.scene.means[made.rows].norm(dim=1).max())
    size = (
        radius * (2 * math.pi * (1 - math.sin(math.radians(lowest))) / count) ** 0.5 / 2
    )
    means = lattice(count, lowest, 90.0).float() * radius
    dome = _flat(means, UP, size / 0.7, torch.tensor([0.2, 0.4, 0.15]).expand(count, 3))
    rows = torch.cat([made.rows, torch.zeros(count, dtype=torch.bool)])
    return Made(
        scene=merge(made.scene, dome),
        rows=rows,
        normals=torch.cat([made.normals, UP.expand(count, 3)]),
    )


def room(*, count: int = 4500, seed: int = 0) -> Made:
    """Honest: six walls, a red poster on one, and a suitcase that stands inside; its
    rows are those of the suitcase.
    """
    generator = torch.Generator().manual_seed(seed)
    half = torch.tensor([3.0, 2.2, 1.4])
    parts = []
    all_normals = []
    side = round((count / 6) ** 0.5)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = torch.zeros(3)
            normal[axis] = -sign
            turn = basis(normal.double()).float()
            step = 2 * (turn.T @ half).abs()[:2] / side
            positions = (
                torch.cartesian_prod(torch.arange(side), torch.arange(side))
                + 0.5
                - side / 2
            )
            positions = positions * step + 0.2 * step * (
                torch.rand(len(positions), 2, generator=generator) - 0.5
            )
            means = positions @ turn[:, :2].T + (sign * half[axis]) * torch.eye(3)[axis]
            colours = torch.tensor([0.75, 0.72, 0.66]) + 0.04 * torch.randn(
                len(means), 1, generator=generator
            )
            if axis == 0 and sign > 0:
                colours[(means[:, 1:].abs() < 0.8).all(1)] = torch.tensor(
                    [0.7, 0.1, 0.1]
                )
            parts.append(_flat(means, normal, float(step.max()), colours))
            all_normals.append(normal.expand(len(means), 3))
    part, normals = discs(build("suitcase", seed), count // 3, seed=seed)
    low = part.means.amin(0)
    high = part.means.amax(0)
    scale = 1.2 / float((high - low).max())
    foot = torch.cat([(low + high)[:2] / 2, low[2:]])
    shift = torch.tensor([0.6, 0.3, -float(half[2])]) - scale * foot
    parts.append(
        part.transform(
            Similarity(rotation=torch.eye(3), translation=shift, scale=scale)
        )
    )
    all_normals.append(normals)
    scene = merge(*parts)
    return Made(
        scene=scene,
        rows=torch.arange(len(scene)) >= len(scene) - len(parts[-1]),
        normals=torch.cat(all_normals),
    )


def _flat(means: Tensor, normal: Tensor, step: float, colours: Tensor) -> GaussianScene:
    """Flat Gaussians on a plane."""
    return GaussianScene(
        means=means,
        scales=torch.tensor([0.7 * step, 0.7 * step, 0.05 * step])
        .expand(len(means), 3)
        .contiguous(),
        rotations=from_matrix(basis(normal.double())[None])
        .float()
        .expand(len(means), 4)
        .contiguous(),
        opacities=torch.full((len(means),), 0.95),
        sh=colour_to_dc(colours.clamp(0.02, 0.98))[:, None],
    )
