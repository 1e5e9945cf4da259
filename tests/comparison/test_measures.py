"""Distances of images and of gradients: known values, equal inputs, and what cannot
be measured.
"""

import itertools
import math

import pytest
import torch
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.comparison.compare import (
    CompareConfig,
    GradientAgreement,
    compare,
    costs_of,
    gradients,
    picture_distance,
    pooled,
    weighting,
)
from mi_splat.comparison.methods import Method
from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import normalise
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.volprim import Volprim
from mi_splat.scene import GaussianScene
from tests.fakes import blobs, camera, toy_scene

GREY = torch.full((16, 20, 3), 0.5)


def test_a_known_difference() -> None:
    assert picture_distance(GREY, GREY + 0.1).psnr == pytest.approx(20.0, abs=1e-4)
    # both are white on a screen
    assert picture_distance(GREY + 0.7, GREY + 0.9).psnr is None
    assert picture_distance(GREY[:8], GREY[:8]).ssim is None  # too small


def test_several_pictures_count_by_their_pixels() -> None:
    near = picture_distance(GREY, GREY)
    far = picture_distance(GREY[:8], GREY[:8] + 0.3)
    both = pooled([near, far])
    assert (near.mse, near.psnr) == (0.0, None)
    assert near.ssim == pytest.approx(1.0, abs=1e-5)
    assert both.mse == pytest.approx(0.09 / 3, rel=1e-5)
    assert both.ssim is None  # one of them has none


def agreement(
    first: list[float], second: list[float]
) -> tuple[float | None, float | None]:
    agreed = GradientAgreement()
    agreed.add(torch.tensor(first[:1]), torch.tensor(second[:1]))
    agreed.add(torch.tensor(first[1:]), torch.tensor(second[1:]))
    return agreed.cosine, agreed.relative_error


def test_agreement_of_gradients() -> None:
    assert agreement([3.0, 4.0], [3.0, 4.0]) == (1.0, 0.0)
    assert agreement([3.0, 4.0], [-3.0, -4.0]) == (-1.0, 2.0)
    cosine, error = agreement([1.0, 0.0], [0.0, 1.0])
    assert (cosine, error) == (0.0, math.sqrt(2))
    assert agreement([0.0, 0.0], [0.0, 1.0]) == (None, None)
    assert agreement([1.0, 1.0], [math.nan, 1.0]) == (None, None)


def test_the_length_of_a_quaternion_has_no_gradient() -> None:
    """Two renderers that differ in whether they normalise quaternions agree."""

    def normalising(scene: GaussianScene, camera: Camera) -> Tensor:
        unit = scene.rotations / scene.rotations.norm(dim=1, keepdim=True)
        return blobs(
            GaussianScene(scene.means, scene.scales, unit, scene.opacities, scene.sh),
            camera,
        )

    scene = toy_scene()[0]
    view = camera(12)
    plain, other = (
        gradients(render, scene, view, weighting(view, 3))
        for render in (blobs, normalising)
    )
    for name, gradient in plain.items():
        assert gradient.abs().max() > 0
        torch.testing.assert_close(
            gradient, other[name], rtol=1e-3, atol=1e-5, msg=name
        )


def test_costs_take_turns_and_are_ratios() -> None:
    calls: list[str] = []

    def slow() -> None:
        calls.append("b")
        torch.rand(400, 400) @ torch.rand(400, 400)

    costs = costs_of(
        {"a": lambda: calls.append("a"), "b": slow}, rounds=3, on_step=lambda text: None
    )
    assert calls == [*"ab", *"ababab"]
    assert costs["b"]["ratio"] > 1


# Mitsuba's own integrator beside ours, where they have to agree: on Gaussians that lie
# apart from each other


METHODS = {
    "tile": Method(render=Renderer()),
    "ray": Method(render=Renderer(RenderSettings(method="ray"))),
    "volprim": Method(render=Volprim()),
}


def apart() -> GaussianScene:
    """Nine Gaussians of different shapes, some 4 pixels wide, that do not touch in the
    image.
    """
    generator = torch.Generator().manual_seed(0)
    grid = torch.tensor(list(itertools.product((-0.9, 0.0, 0.9), repeat=2)))
    return GaussianScene(
        means=torch.cat(
            [grid[:, :1], torch.linspace(-0.2, 0.2, 9)[:, None], grid[:, 1:]], 1
        ),
        scales=0.08 + 0.06 * torch.rand(9, 3, generator=generator),
        rotations=normalise(torch.randn(9, 4, generator=generator)),
        opacities=torch.linspace(0.5, 0.95, 9),
        sh=0.3 * torch.randn(9, 4, 3, generator=generator),
    )


def view(*, focal: float | tuple[float, float] = 120.0) -> Camera:
    pose = look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    return Camera(
        to_world=pose, lens=Lens(focal=focal, size=(96, 88), principal=(46.5, 45.25))
    )


def test_gaussians_that_lie_apart_look_the_same() -> None:
    comparison = compare(
        apart(), {"front": view()}, METHODS, config=CompareConfig(rounds=0)
    )
    assert float(comparison.pictures["front"]["tile"].std()) > 0.05
    for names, least in (
        (("tile", "ray"), 35),
        (("tile", "volprim"), 35),
        (("ray", "volprim"), 45),
    ):
        pair = comparison.pairs[names]
        assert (pair.whole.psnr or 0) > least, names
        assert pair.agreement is not None
        for attribute in ATTRIBUTES:
            assert (pair.agreement[attribute].cosine or 0) > 0.97, (names, attribute)


@pytest.mark.parametrize("attribute", ["sh", "opacities"])
def test_gradients_of_volprim_are_its_finite_differences(attribute: str) -> None:
    scene = apart()
    camera = view()
    render = METHODS["volprim"].render
    weights = weighting(camera, 1)
    gradient = gradients(render, scene, camera, weights)[attribute]
    direction = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(2))
    values: dict[str, Tensor] = dict(zip(ATTRIBUTES, scene.tensors(), strict=True))
    step = 1e-2
    sums = []
    for sign in (1, -1):
        moved = {**values, attribute: values[attribute] + sign * step * direction}
        moved["opacities"] = moved["opacities"].clamp(0, 1)
        sums.append(
            float((render(GaussianScene(**moved), camera).double() * weights).sum())
        )
    expected = (sums[0] - sums[1]) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=0.02)


def test_what_volprim_cannot_do_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="three channels in sRGB"):
        Volprim(RenderSettings(alpha=True))
    with pytest.raises(InvalidValueError, match="square pixels"):
        Volprim()(apart(), view(focal=(120.0, 100.0)))
