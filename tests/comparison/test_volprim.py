"""Mitsuba's own integrator beside ours, where they have to agree: on Gaussians that lie apart from each other."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from mi_splat.cameras import Camera, look_at
from mi_splat.comparison.compare import CompareConfig, compare
from mi_splat.comparison.measures import gradients, weighting
from mi_splat.comparison.methods import Method
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.rotation import normalise
from mi_splat.scene import ATTRIBUTES, GaussianScene
from mi_splat.volprim import Volprim

METHODS = {
    "tile": Method(render=Renderer()),
    "ray": Method(render=Renderer(RenderSettings(method="ray"))),
    "volprim": Method(render=Volprim()),
}


def apart() -> GaussianScene:
    """Nine Gaussians of different shapes, some 4 pixels wide, that do not touch in the picture."""
    generator = torch.Generator().manual_seed(0)
    grid = torch.tensor(list(itertools.product((-0.9, 0.0, 0.9), repeat=2)))
    return GaussianScene(
        means=torch.cat([grid[:, :1], torch.linspace(-0.2, 0.2, 9)[:, None], grid[:, 1:]], 1),
        scales=0.08 + 0.06 * torch.rand(9, 3, generator=generator),
        rotations=normalise(torch.randn(9, 4, generator=generator)),
        opacities=torch.linspace(0.5, 0.95, 9),
        sh=0.3 * torch.randn(9, 4, 3, generator=generator),
    )


def view(*, focal: float | tuple[float, float] = 120.0) -> Camera:
    pose = look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    return Camera(to_world=pose, focal=focal, width=96, height=88, principal=(46.5, 45.25))


def test_gaussians_that_lie_apart_look_the_same() -> None:
    found = compare(apart(), {"front": view()}, METHODS, config=CompareConfig(rounds=0))
    assert float(found.pictures["front"]["tile"].std()) > 0.05
    for names, least in ((("tile", "ray"), 35), (("tile", "volprim"), 35), (("ray", "volprim"), 45)):
        pair = found.pairs[names]
        assert (pair.whole.psnr or 0) > least, names
        assert pair.agreement is not None
        for attribute in ATTRIBUTES:
            assert (pair.agreement[attribute].cosine or 0) > 0.97, (names, attribute)


@pytest.mark.parametrize("attribute", ["sh", "opacities"])
def test_gradients_of_volprim_are_its_finite_differences(attribute: str) -> None:
    scene, camera, render = apart(), view(), METHODS["volprim"].render
    weights = weighting(camera, 1)
    gradient = gradients(render, scene, camera, weights)[attribute]
    direction = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(2))
    values: dict[str, Tensor] = dict(zip(ATTRIBUTES, scene.tensors(), strict=True))
    step = 1e-2
    sums = []
    for sign in (1, -1):
        moved = {**values, attribute: values[attribute] + sign * step * direction}
        moved["opacities"] = moved["opacities"].clamp(0, 1)
        sums.append(float((render(GaussianScene(**moved), camera).double() * weights).sum()))
    expected = (sums[0] - sums[1]) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=0.02)


def test_what_volprim_cannot_do_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="three channels in sRGB"):
        Volprim(RenderSettings(alpha=True))
    with pytest.raises(InvalidValueError, match="fx equal to fy"):
        Volprim()(apart(), view(focal=(120.0, 100.0)))


def test_volprim_of_nothing_is_black() -> None:
    empty = apart().select(torch.zeros(9, dtype=torch.bool))
    assert torch.equal(Volprim()(empty, view()), torch.zeros(88, 96, 3))
