"""The numbers of the specification one by one, with scenes so small that the right
value follows by hand.
"""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import Lens
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

VIEW = Camera(
    to_world=torch.eye(4, dtype=torch.float64),
    lens=Lens(focal=8.0, size=(8, 8), principal=(4.5, 4.5)),
)
"""Looks along +z; the axis meets the centre of pixel (4, 4)."""

WHITE = 0.5 / 0.28209479177387814
"""SH coefficient of degree 0 that adds 0.5 to a colour."""


def blobs(
    depths: list[float], opacities: list[float], *, scale: float = 0.5
) -> GaussianScene:
    """White balls on the axis of the camera."""
    count = len(depths)
    return GaussianScene(
        means=torch.tensor([[0.0, 0.0, depth] for depth in depths]),
        scales=torch.full((count, 3), scale),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        opacities=torch.tensor(opacities),
        sh=torch.full((count, 1, 3), WHITE),
    )


def centre(scene: GaussianScene, *, near: float = 0.2) -> float:
    """Value of the pixel on the axis in front of black."""
    return float(Renderer(RenderSettings(near=near))(scene, VIEW)[4, 4, 0])


def test_what_lies_behind_the_stop_has_no_gradient() -> None:
    values = [0.98, 0.97, 0.98, 0.5]  # the third would leave 1.2e-5
    opacities = torch.tensor(values, requires_grad=True)
    scene = blobs([1.0, 2.0, 3.0, 4.0], values, scale=100.0).replace(
        opacities=opacities
    )
    Renderer(RenderSettings(background=(0.25, 0.25, 0.25)))(
        scene, VIEW
    ).sum().backward()  # type: ignore[no-untyped-call]
    assert opacities.grad is not None
    # In each of 64 pixels of three channels white takes the place of what is behind it.
    first = 1 - (0.97 + 0.03 * 0.25)
    second = 0.02 * (1 - 0.25)
    assert opacities.grad.tolist() == pytest.approx(
        [192 * first, 192 * second, 0.0, 0.0], rel=2e-3
    )


def test_a_gaussian_beyond_the_range_of_floats_is_left_out() -> None:
    scene = blobs([1.0, 2.0], [0.5, 0.5])
    scales = scene.scales.clone()
    scales[0] = 1e30  # its covariance is infinite
    opacities = scene.opacities.clone().requires_grad_(True)
    means, _, rotations, _, sh = scene.tensors()
    picture = Renderer()(
        GaussianScene.unchecked(means, scales, rotations, opacities, sh), VIEW
    )
    assert torch.equal(picture.detach(), Renderer()(blobs([2.0], [0.5]), VIEW))
    picture.sum().backward()  # type: ignore[no-untyped-call]
    assert opacities.grad is not None
    assert opacities.grad[0] == 0
    assert torch.isfinite(opacities.grad).all()


@pytest.mark.parametrize("value", [0.03, 0.04, 0.042, 0.06, 0.5])
def test_linear_values_are_those_of_iec_61966(value: float) -> None:
    opacities = torch.tensor([value], requires_grad=True)
    # every pixel has this value
    scene = blobs([1.0], [value], scale=1000.0).replace(opacities=opacities)
    picture = Renderer(RenderSettings(linear=True))(scene, VIEW)
    dark = value <= 0.04045
    linear = value / 12.92 if dark else ((value + 0.055) / 1.055) ** 2.4
    derivative = 1 / 12.92 if dark else 2.4 / 1.055 * ((value + 0.055) / 1.055) ** 1.4
    assert picture.flatten().tolist() == pytest.approx([linear] * 192, rel=1e-4)
    picture.sum().backward()  # type: ignore[no-untyped-call]
    assert opacities.grad is not None
    assert float(opacities.grad) == pytest.approx(192 * derivative, rel=1e-4)


# The rasteriser's own sorts, against NumPy's


variant.use()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mi_splat.render.tile import binning  # noqa: E402


def uints(values: NDArray[np.int64]) -> mi.UInt32:
    array = mi.UInt32(values.astype(np.uint32))
    dr.make_opaque(array)
    return array


@pytest.mark.parametrize("tiles", [1, 2, 3, 255, 256, 4096, 25_600, 230_400])
def test_pairs_are_sorted_by_tile_and_keep_their_order(tiles: int) -> None:
    keys = np.random.default_rng(tiles).integers(0, tiles, 3000)
    keys[:2] = 0, tiles - 1
    assert np.array_equal(
        binning.order_below(uints(keys), tiles).numpy(), np.argsort(keys, kind="stable")
    )
