"""Scenes for the tests of file formats, and how far two of them are apart."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mi_splat.rotation import multiply
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc, dc_to_colour
from tests.gaussians import random_scene


def tame_scene(count: int, degree: int, *, seed: int = 0) -> GaussianScene:
    """Random Gaussians without any symmetry, whose values lie in the ranges of every format."""
    scene = random_scene(count, degree, seed=seed)
    generator = torch.Generator().manual_seed(seed + 1)
    sh = torch.rand(count, (degree + 1) ** 2, 3, generator=generator) * 1.8 - 0.9
    sh[:, 0] = colour_to_dc(torch.rand(count, 3, generator=generator))
    return scene.replace(sh=sh, opacities=scene.opacities.clamp(0.01, 0.99))


def degrees(one: Tensor, two: Tensor) -> Tensor:
    """(N,) angles between rotations of ellipsoids, which half turns about their own axes leave as they are."""
    first, second = one.double(), two.double()
    half_turns = torch.cat([torch.eye(4, dtype=torch.float64), -torch.eye(4, dtype=torch.float64)])
    chords = torch.stack([(first - multiply(second, turn)).norm(dim=1) for turn in half_turns])
    return (chords.amin(dim=0) / 2).clamp(max=1).asin() * 4 * 180 / math.pi


def differences(one: GaussianScene, two: GaussianScene) -> dict[str, Tensor]:
    """Absolute differences by name, row by row: of logarithms for scales, degrees for rotations, colours for dc."""
    return {
        "means": (one.means.double() - two.means.double()).abs(),
        "scales": (one.scales.double().log() - two.scales.double().log()).abs(),
        "rotations": degrees(one.rotations, two.rotations),
        "opacities": (one.opacities.double() - two.opacities.double()).abs(),
        "colours": (dc_to_colour(one.sh[:, 0].double()) - dc_to_colour(two.sh[:, 0].double())).abs(),
        "sh": (one.sh[:, 1:].double() - two.sh[:, 1:].double()).abs(),
    }


def assert_close(one: GaussianScene, two: GaussianScene, **tolerances: float) -> None:
    """Raise unless all differences are within their tolerances, 2e-5 where none is given (0.05 degrees)."""
    assert len(one) == len(two)
    assert one.degree == two.degree
    limits = {"rotations": 0.05, **tolerances}
    worst = {name: float(value.max()) for name, value in differences(one, two).items() if value.numel()}
    wrong = {name: value for name, value in worst.items() if value > limits.get(name, 2e-5)}
    assert not wrong, f"too far apart: {wrong}, all: {worst}"
