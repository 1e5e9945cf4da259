"""Depths and the anti-aliased filter of the rasteriser against the float64 oracle;
numbers that are not finite.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat import oracle
from mi_splat.errors import InvalidValueError
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import SplatScene, read_scene, write_scene
from mi_splat.scene import GaussianScene
from tests.gaussians import varied_scene
from tests.rendering.test_plugins import dict_scene
from tests.rendering.test_rasterization import (
    BACKGROUND,
    PICTURE_ERROR,
    agree,
    camera,
    gradients,
    smooth_scene,
)
from tests.rendering.test_specification import VIEW, blobs

variant.use()

import mitsuba as mi  # noqa: E402

from mi_splat.render.plugins import sensor as sensors  # noqa: E402

DEPTH_ERROR = 4e-6
"""Largest relative difference of an expected depth from the oracle's; 1.4e-6 was the
largest measured.
"""

COMPENSATED = oracle.Convention(compensated=True)
ANTIALIASED = Renderer(RenderSettings(antialiased=True, background=BACKGROUND))


# ------------------------------------------------------------------------------- depths


@pytest.mark.parametrize(
    ("count", "size", "distance"),
    [
        (300, (64, 50), 3.0),
        (400, (61, 43), 0.4),
        (20, (7, 3), 1.3),
        (1, (16, 16), 3.0),
        (300, (1, 1), 3.0),
    ],
)
def test_depths_are_the_oracles(
    count: int, size: tuple[int, int], distance: float
) -> None:
    scene = varied_scene(count, degree=1, seed=count)
    view = camera(*size, distance=distance)
    outputs = Renderer(RenderSettings(background=BACKGROUND)).outputs(scene, view)
    *_, depth, median = oracle.render(scene, view)
    np.testing.assert_allclose(outputs.depth.numpy(), depth, rtol=DEPTH_ERROR, atol=0)
    np.testing.assert_allclose(outputs.median_depth.numpy(), median, rtol=1e-6, atol=0)
    assert not outputs.depth[outputs.alpha == 0].any()
    assert torch.equal(outputs.median_depth > 0, outputs.alpha >= 0.5)


@pytest.mark.parametrize(
    "settings", [{}, {"alpha": True, "linear": True}, {"antialiased": True}]
)
def test_the_image_is_the_picture_to_the_bit(settings: dict[str, Any]) -> None:
    scene = varied_scene(200, degree=2, seed=3)
    view = camera(45, 31)
    render = Renderer(RenderSettings(**settings))
    outputs = render.outputs(scene, view)
    picture = render(scene, view)
    assert torch.equal(outputs.image, picture[..., :3])
    if render.settings.alpha:
        assert torch.equal(outputs.alpha, picture[..., 3])


def test_the_depths_of_two_gaussians_follow_by_hand() -> None:
    outputs = Renderer().outputs(blobs([1.0, 3.0], [0.4, 0.75], scale=50.0), VIEW)
    assert float(outputs.depth[4, 4]) == pytest.approx(
        (0.4 * 1 + 0.6 * 0.75 * 3) / 0.85, rel=1e-5
    )
    assert float(outputs.median_depth[4, 4]) == 3.0  # 0.6 is left behind the first
    assert (
        float(
            Renderer().outputs(blobs([2.0], [0.5], scale=50.0), VIEW).median_depth[4, 4]
        )
        == 2.0
    )
    assert (
        float(Renderer().outputs(blobs([2.0], [0.49]), VIEW).median_depth.max()) == 0.0
    )


def test_nothing_visible_has_no_depth() -> None:
    scene = varied_scene(30, degree=0, seed=0)
    means = (scene.means + 1e4).requires_grad_(True)
    for case in (scene.replace(means=means), scene.select(slice(0, 0))):
        outputs = Renderer().outputs(case, camera(9, 5))
        assert not torch.cat([outputs.alpha, outputs.depth, outputs.median_depth]).any()
        if len(case):
            outputs.depth.sum().backward()  # type: ignore[no-untyped-call]
    assert means.grad is not None
    assert not means.grad.any()


def test_depth_has_its_gradient_beside_those_of_image_and_alpha() -> None:
    scene = smooth_scene(25, 1, seed=11)
    view = camera(37, 29)
    rng = np.random.default_rng(0)
    on_image = rng.normal(size=(29, 37, 3))
    on_alpha = rng.normal(size=(29, 37))
    on_depth = rng.normal(size=(29, 37))
    render = Renderer(RenderSettings(background=BACKGROUND))

    def loss(scene: GaussianScene) -> Tensor:
        outputs = render.outputs(scene, view)
        assert not outputs.median_depth.requires_grad
        pairs = (
            (outputs.image, on_image),
            (outputs.alpha, on_alpha),
            (outputs.depth, on_depth),
        )
        return torch.stack(
            [
                (output * torch.from_numpy(factors).float()).sum()
                for output, factors in pairs
            ]
        ).sum()

    wanted = oracle.gradients(
        scene, view, on_image, on_alpha, on_depth, background=BACKGROUND
    )
    agree(gradients(scene, loss), wanted)


# -------------------------------------------------------------------------- antialiased


@pytest.mark.parametrize(
    ("count", "size", "distance"),
    [(300, (64, 50), 3.0), (300, (12, 9), 6.0), (400, (61, 43), 0.4)],
)
def test_antialiased_picture_is_the_oracles(
    count: int, size: tuple[int, int], distance: float
) -> None:
    scene = varied_scene(count, degree=1, seed=count)
    view = camera(*size, distance=distance)
    reference = oracle.render(
        scene, view, background=BACKGROUND, convention=COMPENSATED
    ).image
    assert np.abs(ANTIALIASED(scene, view).numpy() - reference).max() <= PICTURE_ERROR
    assert (
        np.abs(
            oracle.render(scene, view, background=BACKGROUND).image - reference
        ).max()
        > 0.01
    )


def test_antialiased_gradient_is_the_oracles() -> None:
    scene = smooth_scene(25, 1, seed=11)
    view = camera(25, 19)
    factors = np.random.default_rng(0).normal(size=(19, 25, 3))
    gradient = gradients(
        scene,
        lambda moved: (
            ANTIALIASED(moved, view) * torch.from_numpy(factors).float()
        ).sum(),
    )
    agree(
        gradient,
        oracle.gradients(
            scene, view, factors, convention=COMPENSATED, background=BACKGROUND
        ),
    )


def test_antialiased_in_a_scene_and_its_file(tmp_path: Path) -> None:
    scene = varied_scene(60, degree=1, seed=4)
    loaded = dict_scene(scene, antialiased=True)
    view = sensors.camera(loaded.sensors()[0])
    settings = RenderSettings(antialiased=True)
    np.testing.assert_allclose(
        mi.render(loaded).numpy(), Renderer(settings)(scene, view).numpy(), atol=2e-6
    )
    mi.traverse(loaded).update({"integrator.antialiased": False})
    np.testing.assert_allclose(
        mi.render(loaded).numpy(), Renderer()(scene, view).numpy(), atol=2e-6
    )
    with pytest.raises(InvalidValueError, match="antialiased: expected true or false"):
        loaded.integrator().antialiased = 2
    values = SplatScene(
        scene=scene,
        objects={"car": slice(0, 60)},
        cameras={"front": view},
        settings=settings,
    )
    write_scene(values, scene, tmp_path / "scene.xml")
    assert read_scene(tmp_path / "scene.xml").settings == settings


# --------------------------------------------------------------------------- not finite


@pytest.mark.parametrize(
    ("key", "entry", "value"),
    [
        ("data", 17, float("nan")),
        ("opacities", 2, float("inf")),
        ("sh_coeffs", 40, float("nan")),
    ],
)
def test_numbers_that_are_not_finite_are_refused_by_name(
    key: str, entry: int, value: float
) -> None:
    loaded = dict_scene(varied_scene(60, degree=1, seed=4))
    before = mi.render(loaded).numpy()
    params = mi.traverse(loaded)
    numbers = params[f"splat.{key}"].numpy().copy()
    broken = numbers.copy()
    broken[[entry, entry + 20]] = value
    params.update({f"splat.{key}": mi.Float(broken)})
    with pytest.raises(
        InvalidValueError,
        match=(
            rf"{key}.*: expected finite numbers, got 2 that are not; look at the last"
        ),
    ):
        loaded.integrator().render(loaded)
    with pytest.raises(RuntimeError):  # Dr.Jit's, from ours
        mi.render(loaded, params)
    params.update({f"splat.{key}": mi.Float(numbers)})
    assert np.array_equal(mi.render(loaded).numpy(), before)
