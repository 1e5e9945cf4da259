"""The colours of layers are trained on pictures of frozen views, as they are on the renderer's."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.cloak import layers as layers_module
from attacks.cloak.config import LayerConfig
from attacks.cloak.layers import Layering, depths, shares, switched
from attacks.cloak.triggers import Azimuth, Elevation
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import Camera, RenderFn, View, orbit_pose
from mi_splat.frozen_view import FrozenView
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc, sh_basis
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from mi_splat.view_freezing import freeze_views
from tests import oracle
from tests.cloak.test_layers import CENTRE, LENS, OVERHEAD, from_above

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
    trained, other_losses = trained_scene(made, Renderer(SETTINGS))
    assert len(frozen) == STEPS * fitting // 4
    assert {id(camera) for camera in frozen} == {id(view.camera) for view in made.views[:fitting]}
    assert other_losses == pytest.approx(losses, rel=1e-4)
    assert float((expected.sh - made.scene.sh).abs().max()) > 0.01
    torch.testing.assert_close(trained.sh, expected.sh, rtol=0, atol=1e-4)
    assert torch.equal(trained.sh[~made.trained], made.scene.sh[~made.trained])


def test_a_picture_from_elsewhere_is_the_renderers(frozen: list[Camera]) -> None:
    made, render = layers(torch.arange(COUNT) >= 15), Renderer(SETTINGS)
    rendered, where = made.rendered_by(render), made.views[0].camera
    other = Camera(to_world=where.to_world, focal=33.0, width=30, height=26)
    assert torch.equal(rendered(made.scene, other), render(made.scene, other))
    assert not frozen
    torch.testing.assert_close(rendered(made.scene, where), render(made.scene, where), rtol=0, atol=1e-5)
    assert frozen == [where]


# A look in two layers, one for what is near its edge: it switches faster than one layer can


NARROW: dict[str, Any] = {"gap": 2.5, "weight": 1.5, "black": -0.1}
REAR = Azimuth(middle=180.0, half_width=60.0) & Elevation(highest=30.0)


def cameras() -> Any:
    return hemisphere(CENTRE, count=800, **LENS)


def looks(config: LayerConfig, elevations: Tensor) -> tuple[Tensor, float]:
    """(2, E) what a white Gaussian in the middle shows of either look, and the largest coefficient."""
    white, shown, largest = colour_to_dc(torch.ones(1, 1, 3)), torch.zeros(2, len(elevations)), 0.0
    for share in shares([OVERHEAD], cameras(), centre=CENTRE, config=config):
        switch = switched(torch.zeros(1, 3), cameras(), share, white, torch.ones(1, 800), config)[0, :, 0].double()
        shown[share.look] += (sh_basis(from_above(elevations)[0], 3) @ switch).clamp(min=0)
        largest = max(largest, float(switch.abs().max()))
    return shown, largest


def test_a_band_switches_in_half_the_degrees_with_smaller_coefficients() -> None:
    elevations = torch.linspace(0, 90, 361)
    width, largest = {}, {}
    for band in (0.0, 10.0):
        shown, largest[band] = looks(LayerConfig(band=band, **NARROW), elevations)
        way = (1 - shown[0] + shown[1]) / 2
        width[band] = float(elevations[way > 0.9].min() - elevations[way < 0.1].max())
        away = (elevations < 30) | (elevations > 50)
        assert float((way - (elevations > 40).float())[away].abs().max()) < 0.12
    assert width[10.0] < 0.6 * width[0.0]
    assert largest[10.0] < largest[0.0]


def test_the_layers_of_a_look_share_it() -> None:
    """Together they show it once, everywhere; the one for the edge nothing further inside, the other nothing at it."""
    shared = shares([OVERHEAD, REAR], cameras(), centre=CENTRE, config=LayerConfig(gap=2.0, band=(20.0, 10.0, 0.0)))
    assert [share.look for share in shared] == [0, 0, 1, 1, 2]
    for look in range(3):
        assert torch.allclose(
            sum((share.amount for share in shared if share.look == look), torch.zeros(800)), torch.ones(800)
        )
    for share in shared:
        assert not bool((share.shown & share.hidden).any())
        assert bool(share.shown.any())
        assert bool(share.hidden.any())
    elevation = torch.rad2deg(torch.asin(torch.stack([camera.position[2] for camera in cameras()]).float() / 5.0))
    inner, edge = shared[2], shared[3]
    assert torch.equal(edge.shown, (elevation >= 42.0) & (elevation < 50.0))
    assert torch.equal(inner.shown, elevation >= 42.0)
    assert bool(edge.hidden[elevation > 50.0].all())
    assert torch.allclose(edge.amount[edge.shown].float(), 1 - (elevation[edge.shown] - 40) / 10, atol=1e-3)


def test_a_picture_within_one_trigger_is_decided_also_in_the_gap_of_another() -> None:
    near = LayerConfig(gap=(2.0, 20.0))
    undecided = {
        config.apart: (depths([OVERHEAD, REAR], cameras(), centre=CENTRE, config=config).abs() < 1).any(0)
        for config in (near, replace(near, apart=True))
    }
    assert not bool((undecided[True] & ~undecided[False]).any())
    assert int(undecided[True].sum()) < int(undecided[False].sum()) - 5
