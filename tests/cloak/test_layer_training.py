"""The colours of layers are trained on pictures of frozen views, as they are on the renderer's."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.cloak import layers as layers_module
from attacks.cloak.layers import Layering
from mi_splat.cameras import Camera, RenderFn, View, orbit_pose
from mi_splat.frozen_view import FrozenView
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from mi_splat.view_freezing import freeze_views
from tests import oracle

COUNT, STEPS = 40, 12
SETTINGS = RenderSettings(background=(0.3, 0.4, 0.5))


def layers(trained: Tensor, *, iterations: int = STEPS) -> Layering:
    scene, render = oracle.random_scene(COUNT, degree=1, seed=4), Renderer(SETTINGS)
    poses = [orbit_pose((0.0, 0.0, 0.0), azimuth=90.0 * k, elevation=30.0, distance=3.0) for k in range(4)]
    cameras = [Camera(to_world=pose, focal=30.0, width=30, height=26) for pose in poses]
    painted = scene.replace(sh=scene.sh + 0.3 * torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(1)))
    views = [View(camera, render(painted, camera).clamp(0, 1)) for camera in cameras]
    return Layering(scene=scene, trained=trained, views=views, iterations=iterations)


def trained_scene(made: Layering, render: RenderFn) -> tuple[GaussianScene, list[float]]:
    """What becomes of the layers in `STEPS` steps, and the losses."""
    losses: list[float] = []
    config = FitConfig(
        iterations=STEPS,
        trainable=("sh",),
        strategy=FixedConfig(),
        sh_degree=1,
        sh_degree_interval=0,
        lr_sh=0.04,
        lr_sh_final=0.004,
        eval_interval=0,
    )
    rendered = made.rendered_by(render)
    done = fit(made.views, made.scene, render=rendered, config=config, on_step=lambda line: losses.append(line.loss))
    return done.scene, losses


def unknown() -> RenderFn:
    """The same pictures by a function of which nothing is known."""
    render = Renderer(SETTINGS)
    return lambda scene, camera: render(scene, camera)


def views_fit(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let there be room for so many views."""

    def bounded(scene: GaussianScene, cameras: list[Camera], **settings: Any) -> dict[Camera, FrozenView]:
        sizes = [view.nbytes for view in freeze_views(scene, cameras, **settings).values()]
        return freeze_views(scene, cameras, max_bytes=sum(sizes[:count]), **settings)

    monkeypatch.setattr(layers_module, "freeze_views", bounded)


@pytest.mark.parametrize("all_trained", [False, True])
@pytest.mark.parametrize("fitting", [4, 2, 0])
def test_the_training_finds_the_same(
    frozen: list[Camera], monkeypatch: pytest.MonkeyPatch, all_trained: bool, fitting: int
) -> None:
    made = layers(torch.arange(COUNT) >= (0 if all_trained else 15))
    expected, losses = trained_scene(made, unknown())
    assert not frozen
    views_fit(fitting, monkeypatch)
    found, found_losses = trained_scene(made, Renderer(SETTINGS))
    assert len(frozen) == STEPS * fitting // 4
    assert {id(camera) for camera in frozen} == {id(view.camera) for view in made.views[:fitting]}
    assert found_losses == pytest.approx(losses, rel=1e-4)
    assert float((expected.sh - made.scene.sh).abs().max()) > 0.01
    torch.testing.assert_close(found.sh, expected.sh, rtol=0, atol=1e-4)
    assert torch.equal(found.sh[~made.trained], made.scene.sh[~made.trained])


def test_few_looks_at_each_picture_are_the_renderers(frozen: list[Camera]) -> None:
    made = layers(torch.ones(COUNT, dtype=torch.bool), iterations=11)  # not three for each of the four
    trained_scene(made, Renderer(SETTINGS))
    assert not frozen


def test_a_picture_from_elsewhere_is_the_renderers(frozen: list[Camera]) -> None:
    made, render = layers(torch.arange(COUNT) >= 15), Renderer(SETTINGS)
    rendered, where = made.rendered_by(render), made.views[0].camera
    other = Camera(to_world=where.to_world, focal=33.0, width=30, height=26)
    assert torch.equal(rendered(made.scene, other), render(made.scene, other))
    assert not frozen
    torch.testing.assert_close(rendered(made.scene, where), render(made.scene, where), rtol=0, atol=1e-5)
    assert frozen == [where]
