"""Functions that switch on the sphere, and splats whose object has a layer for each
look.
"""

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak import layers as layers_module
from attacks.cloak.config import LayerConfig, LayersConfig
from attacks.cloak.layers import (
    Layering,
    Share,
    depths,
    fit_switches,
    layered,
    seen_colours,
    shares,
    split_opacities,
    switched,
)
from attacks.cloak.triggers import Azimuth, Elevation
from mi_splat.cameras.camera import Camera, RenderFn, View, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere, orbit
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc, sh_basis, sh_to_colour
from mi_splat.render.frozen_view import FrozenView
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.view_freezing import freeze_views
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from tests.gaussians import varied_scene

CENTRE = (0.0, 0.0, 0.0)
LENS: dict[str, Any] = {"distance": 5.0, "lens": Lens(focal=60.0, size=(32, 32))}
OVERHEAD = Elevation(lowest=40.0)


@functools.cache
def all_around(count: int = 300) -> Any:
    return hemisphere(CENTRE, count=count, **LENS)


def from_above(elevations: Tensor) -> Tensor:
    """(1, D, 3) directions in which cameras at some elevations see the centre."""
    angles = torch.deg2rad(elevations.double())
    return -torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], -1)[
        None
    ]


def values(coefficients: Tensor, directions: Tensor) -> Tensor:
    return (sh_basis(directions[0].double(), 3) @ coefficients[0]).clamp(min=0)


@pytest.mark.parametrize("weighted", [False, True])
def test_a_switch_is_the_least_of_its_objective(weighted: bool) -> None:
    """Any small change of the coefficients costs more, also where directions count
    differently and values are given.
    """
    generator = torch.Generator().manual_seed(0)
    directions = functional.normalize(
        torch.randn(1, 400, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    shown = directions[0, :, 2] > 0.5
    hidden = directions[0, :, 2] < 0.2
    basis = sh_basis(directions[0], 3)
    if weighted:
        seen = torch.rand(1, 400, generator=generator).double() ** 3
    else:
        seen = torch.ones(1, 400).double()
    wanted = 1 + 0.3 * directions[..., 0] if weighted else torch.ones(1, 400).double()

    def cost(coefficients: Tensor) -> float:
        value = basis @ coefficients
        errors = torch.where(
            shown, (value - wanted[0]) ** 2, (value + 3.0).clamp(max=0) ** 2
        )
        errors = errors + 2.0 * hidden * value.clamp(min=0).square()
        return float((errors * seen[0]).sum() / seen.sum())

    given: dict[str, Any] = {"wanted": wanted, "seen": seen} if weighted else {}
    fitted = fit_switches(
        directions, shown, hidden, config=LayerConfig(weight=2.0, lowest=-3.0), **given
    )[0]
    for _ in range(50):
        step = 0.02 * torch.randn(16, generator=generator, dtype=torch.float64)
        assert cost(fitted + step) > cost(fitted) - 1e-6
    assert cost(fitted) < cost(torch.zeros(16, dtype=torch.float64))


def test_a_heavy_weight_ends_at_the_least_too_and_darker() -> None:
    """Without halved steps Newton's method goes round in circles here."""
    cameras = all_around(800)
    depth = depths([OVERHEAD], all_around(800), centre=CENTRE)[1]
    directions = functional.normalize(
        -torch.stack([camera.position for camera in cameras]), dim=-1
    )
    shown = depth >= 0.6
    hidden = depth <= -0.6
    basis = sh_basis(directions.double(), 3)
    dark = {}
    for black in (0.0, -0.3):
        config = LayerConfig(weight=1000.0, black=black)
        fitted = fit_switches(directions[None], shown, hidden, config=config)[
            0
        ].requires_grad_()
        value = basis @ fitted
        cost = (value[shown] - 1).square().sum() + 1000 * (value[hidden] - black).clamp(
            min=0
        ).square().sum()
        cost = (
            cost + (value + 100).clamp(max=0)[~shown].square().sum()
        ) / 800 + 1e-7 * fitted.square().sum()
        (gradient,) = torch.autograd.grad(cost, fitted)
        assert float(gradient.abs().max()) < 1e-6
        dark[black] = float(value[hidden].max().detach())
    assert dark[-0.3] < dark[0.0] - 0.1


def switch(depth: Tensor, config: LayerConfig) -> Tensor:
    """(1, K) that of a white Gaussian in the middle."""
    share = Share(
        look=0, amount=torch.ones_like(depth), shown=depth >= 1, hidden=depth <= -1
    )
    white = colour_to_dc(torch.ones(1, 1, 3))
    return switched(
        torch.zeros(1, 3), all_around(800), share, white, torch.ones(1, 800), config
    )[..., 0].double()


def ball(count: int = 40) -> GaussianScene:
    """An opaque grey ball of Gaussians, and one Gaussian far to the side."""
    generator = torch.Generator().manual_seed(1)
    means = functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    means[-1] = torch.tensor([3.0, 0.0, 0.0])
    return GaussianScene(
        means=means,
        scales=torch.full((count, 3), 0.3),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        opacities=torch.full((count,), 0.96),
        sh=torch.zeros(count, 1, 3),
    )


def test_layers_show_one_look_from_below_and_another_from_above() -> None:
    scene = ball()
    rows = torch.arange(39)
    red = torch.tensor([[0.8, 0.1, 0.1]]).repeat(39, 1)
    blue = torch.tensor([[0.1, 0.1, 0.8]]).repeat(39, 1)
    looks = [colour_to_dc(colour)[:, None] for colour in (red, blue)]
    layers = layered(
        scene, rows, [OVERHEAD], looks, cameras=all_around(), centre=CENTRE
    )
    assert len(layers) == 40 + 39
    below, above = (
        orbit(CENTRE, count=1, elevation=elevation, **LENS)[0]
        for elevation in (10.0, 75.0)
    )
    for front in (0, 25, 38):
        behind = 40 + front
        assert (colour(layers, front, below) - 2 * red[0]).abs().max() < 0.35
        assert colour(layers, behind, below).max() == 0
        assert (colour(layers, behind, above) - 2 * blue[0]).abs().max() < 0.35
        assert colour(layers, front, above).max() == 0


def colour(scene: GaussianScene, row: int, camera: Camera) -> Tensor:
    """(3,) what a camera sees of a Gaussian."""
    direction = functional.normalize(scene.means[row] - camera.position.float(), dim=-1)
    return (0.5 + sh_basis(direction[None], 3)[0] @ scene.sh[row]).clamp(min=0)


GREY = torch.zeros(39, 1, 3)


def test_layers_leave_all_else_as_it_is_and_stand_one_behind_the_other() -> None:
    scene = ball()
    layers = layered(
        scene,
        torch.arange(39),
        [OVERHEAD],
        [GREY, GREY],
        cameras=all_around(),
        centre=CENTRE,
    )
    other = scene.with_degree(3)
    assert torch.equal(layers.sh[39], other.sh[39])
    assert torch.equal(layers.opacities[39], scene.opacities[39])
    assert torch.allclose(layers.opacities[:39], torch.tensor(0.48))
    assert torch.allclose(layers.opacities[40:], torch.tensor(0.48 / 0.52))
    assert (layers.means[40:].norm(dim=1) < layers.means[:39].norm(dim=1)).all()
    assert torch.equal(layers.scales[:40], scene.scales)


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.99])
def test_layers_let_through_what_their_gaussian_did(opacity: float) -> None:
    """In the middle and halfway out, three layers each make up a third; nowhere do they
    let through much else.
    """
    opacities, narrower = split_opacities(
        torch.tensor([opacity]), torch.ones(3, 1, dtype=torch.bool)
    )
    radius = torch.linspace(0, 3, 61)
    half = torch.tensor(2 * math.log(2)).sqrt()
    fall = torch.exp(
        -0.5 * (torch.cat([torch.zeros(1), half[None], radius]) / narrower) ** 2
    )
    alpha = opacities * fall
    through = (1 - alpha).cumprod(0)
    wanted = opacity * torch.exp(
        -0.5 * torch.cat([torch.zeros(1), half[None], radius]) ** 2
    )
    parts = alpha * torch.cat([torch.ones(1, alpha.shape[1]), through[:-1]])
    assert torch.allclose(parts[:, :2], (wanted / 3).expand(3, -1)[:, :2], atol=1e-5)
    assert (1 - through[-1] - wanted).abs().max() < 0.05


def test_a_gaussian_that_is_not_seen_has_one_layer() -> None:
    scene = ball()
    seen = torch.ones(39, 300)
    inside = depths([OVERHEAD], all_around(), centre=CENTRE)[1] > -1
    seen[:10, inside] = 0
    layers = layered(
        scene,
        torch.arange(39),
        [OVERHEAD],
        [GREY, GREY],
        cameras=all_around(),
        centre=CENTRE,
        seen=seen,
    )
    assert len(layers) == 40 + 29
    assert torch.equal(layers.opacities[:10], scene.opacities[:10])
    assert torch.allclose(layers.opacities[10:39], scene.opacities[10:39] / 2)


def test_a_look_may_differ_by_direction() -> None:
    """Red to one side and blue to the other stays so on its own side of the edge."""
    scene = ball()
    sided = torch.zeros(39, 4, 3)
    sided[:, 3, 0], sided[:, 3, 2] = 0.5, -0.5
    layers = layered(
        scene,
        torch.arange(39),
        [OVERHEAD],
        [sided, GREY],
        cameras=all_around(),
        centre=CENTRE,
    )
    for camera in orbit(CENTRE, count=6, elevation=10.0, **LENS):
        direction = functional.normalize(
            scene.means[0] - camera.position.float(), dim=-1
        )
        wanted = 2 * sh_to_colour(sided[0], direction)
        assert (colour(layers, 0, camera) - wanted).abs().max() < 0.3


def test_a_shift_moves_where_looks_change_out_of_the_trigger() -> None:
    """A Gaussian in the middle: with the gap as shift the hidden look is whole at the
    trigger's edge.
    """
    shown = []
    for shift in (0.0, 5.0):
        benign, hidden = depths(
            [OVERHEAD], all_around(800), centre=CENTRE, config=LayerConfig(shift=shift)
        )
        assert torch.allclose(hidden, -benign)
        edge = torch.tensor([40.0, 46.0])
        shown.append(values(switch(hidden, LayerConfig()), from_above(edge)))
    at_the_edge, inside = torch.stack(shown).unbind(1)
    assert at_the_edge[0] < 0.65
    assert (at_the_edge[1] - 1).abs() < 0.25
    assert (inside - 1).abs().max() < 0.2


def test_colours_are_those_of_the_pixels_that_points_lie_in() -> None:
    camera = orbit(CENTRE, count=1, elevation=20.0, **LENS)[0]
    image = torch.zeros(32, 32, 3)
    image[16, 16] = torch.tensor([0.2, 0.4, 0.6])
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
    fallback = torch.full((3, 3), 0.9)
    views = [View(camera, image), View(camera, 1 - image)]
    colours = seen_colours(
        points, views, torch.tensor([[3.0, 1.0], [1.0, 1.0], [0.0, 0.0]]), fallback
    )
    assert torch.allclose(colours[0], 0.75 * image[16, 16] + 0.25 * (1 - image[16, 16]))
    assert torch.equal(colours[1:], fallback[1:])


def test_what_makes_no_layers_is_refused() -> None:
    scene = ball()
    every: Any = slice(None)
    around: dict[str, Any] = {"cameras": all_around(), "centre": CENTRE}
    with pytest.raises(InvalidValueError, match=r"rows: expected a tensor.* got slice"):
        layered(scene, every, [OVERHEAD], [GREY], **around)
    with pytest.raises(InvalidValueError, match="looks"):
        layered(
            scene,
            torch.arange(39),
            [OVERHEAD],
            [GREY],
            cameras=all_around(),
            centre=CENTRE,
        )
    with pytest.raises(InvalidValueError, match="widen the trigger"):
        layered(
            scene,
            torch.arange(39),
            [Elevation(lowest=89.9)],
            [GREY, GREY],
            cameras=all_around(50),
            centre=CENTRE,
        )
    for bad in ({"gap": (5.0, 95.0)}, {"lowest": 1.0}, {"black": 0.1}, {"keep": 0.0}):
        with pytest.raises(InvalidValueError):
            LayerConfig(**bad)
    with pytest.raises(InvalidValueError, match="one for each trigger"):
        LayersConfig(attacks=("overhead",), making=LayerConfig(gap=(3.0, 4.0)))


# The colours of layers are trained on images of frozen views, as they are on the
# renderer's


COUNT = 40
STEPS = 12
SETTINGS = RenderSettings(background=(0.3, 0.4, 0.5))


def painted(trained: Tensor) -> Layering:
    scene = varied_scene(COUNT, degree=1, seed=4)
    render = Renderer(SETTINGS)
    poses = [
        orbit_pose((0.0, 0.0, 0.0), azimuth=90.0 * k, elevation=30.0, distance=3.0)
        for k in range(4)
    ]
    cameras = [
        Camera(to_world=pose, lens=Lens(focal=30.0, size=(30, 26))) for pose in poses
    ]
    other = scene.replace(
        sh=scene.sh
        + 0.3 * torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(1))
    )
    views = [View(camera, render(other, camera).clamp(0, 1)) for camera in cameras]
    return Layering(scene=scene, trained=trained, views=views, iterations=STEPS)


def trained_scene(
    made: Layering, render: RenderFn
) -> tuple[GaussianScene, list[float]]:
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
    done = fit(
        made.views,
        made.scene,
        render=rendered,
        config=config,
        on_step=lambda line: losses.append(line.loss),
    )
    return done.scene, losses


def unknown() -> RenderFn:
    """The same images by a function of which nothing is known."""
    render = Renderer(SETTINGS)
    return lambda scene, camera: render(scene, camera)


def views_fit(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let there be room for so many views."""

    def bounded(
        scene: GaussianScene, cameras: list[Camera], **settings: Any
    ) -> dict[Camera, FrozenView]:
        sizes = [
            view.nbytes for view in freeze_views(scene, cameras, **settings).values()
        ]
        return freeze_views(scene, cameras, max_bytes=sum(sizes[:count]), **settings)

    monkeypatch.setattr(layers_module, "freeze_views", bounded)


@pytest.mark.parametrize(
    ("all_trained", "fitting"), [(False, 4), (False, 2), (True, 4), (True, 0)]
)
def test_the_training_finds_the_same(
    frozen: list[Camera],
    monkeypatch: pytest.MonkeyPatch,
    all_trained: bool,
    fitting: int,
) -> None:
    made = painted(torch.arange(COUNT) >= (0 if all_trained else 15))
    expected, losses = trained_scene(made, unknown())
    assert not frozen
    views_fit(fitting, monkeypatch)
    trained, other_losses = trained_scene(made, Renderer(SETTINGS))
    assert len(frozen) == STEPS * fitting // 4
    assert {id(camera) for camera in frozen} == {
        id(view.camera) for view in made.views[:fitting]
    }
    assert other_losses == pytest.approx(losses, rel=1e-4)
    assert float((expected.sh - made.scene.sh).abs().max()) > 0.01
    torch.testing.assert_close(trained.sh, expected.sh, rtol=0, atol=1e-4)
    assert torch.equal(trained.sh[~made.trained], made.scene.sh[~made.trained])


def test_a_picture_from_elsewhere_is_the_renderers(frozen: list[Camera]) -> None:
    made = painted(torch.arange(COUNT) >= 15)
    render = Renderer(SETTINGS)
    rendered = made.rendered_by(render)
    where = made.views[0].camera
    other = Camera(to_world=where.to_world, lens=Lens(focal=33.0, size=(30, 26)))
    assert torch.equal(rendered(made.scene, other), render(made.scene, other))
    assert not frozen
    torch.testing.assert_close(
        rendered(made.scene, where), render(made.scene, where), rtol=0, atol=1e-5
    )
    assert frozen == [where]


# A look in two layers, one for what is near its edge: it switches faster than one layer
# can


NARROW: dict[str, Any] = {"gap": 2.5, "weight": 1.5, "black": -0.1}
REAR = Azimuth(middle=180.0, half_width=60.0) & Elevation(highest=30.0)


def looks(config: LayerConfig, elevations: Tensor) -> tuple[Tensor, float]:
    """(2, E) what a white Gaussian in the middle shows of either look, and the largest
    coefficient.
    """
    white = colour_to_dc(torch.ones(1, 1, 3))
    shown = torch.zeros(2, len(elevations))
    largest = 0.0
    for share in shares([OVERHEAD], all_around(800), centre=CENTRE, config=config):
        switch = switched(
            torch.zeros(1, 3), all_around(800), share, white, torch.ones(1, 800), config
        )[0, :, 0].double()
        shown[share.look] += (sh_basis(from_above(elevations)[0], 3) @ switch).clamp(
            min=0
        )
        largest = max(largest, float(switch.abs().max()))
    return shown, largest


def test_a_band_switches_in_half_the_degrees_with_smaller_coefficients() -> None:
    elevations = torch.linspace(0, 90, 361)
    width = {}
    largest = {}
    for band in (0.0, 10.0):
        shown, largest[band] = looks(LayerConfig(band=band, **NARROW), elevations)
        way = (1 - shown[0] + shown[1]) / 2
        width[band] = float(elevations[way > 0.9].min() - elevations[way < 0.1].max())
        away = (elevations < 30) | (elevations > 50)
        assert float((way - (elevations > 40).float())[away].abs().max()) < 0.12
    assert width[10.0] < 0.6 * width[0.0]
    assert largest[10.0] < largest[0.0]


def test_the_layers_of_a_look_share_it() -> None:
    """Together they show it once, everywhere; the one for the edge nothing further
    inside, the other nothing at it.
    """
    shared = shares(
        [OVERHEAD, REAR],
        all_around(800),
        centre=CENTRE,
        config=LayerConfig(gap=2.0, band=(20.0, 10.0, 0.0)),
    )
    assert [share.look for share in shared] == [0, 0, 1, 1, 2]
    for look in range(3):
        assert torch.allclose(
            sum(
                (share.amount for share in shared if share.look == look),
                torch.zeros(800),
            ),
            torch.ones(800),
        )
    for share in shared:
        assert not bool((share.shown & share.hidden).any())
        assert bool(share.shown.any())
        assert bool(share.hidden.any())
    elevation = torch.rad2deg(
        torch.asin(
            torch.stack([camera.position[2] for camera in all_around(800)]).float()
            / 5.0
        )
    )
    inner = shared[2]
    edge = shared[3]
    assert torch.equal(edge.shown, (elevation >= 42.0) & (elevation < 50.0))
    assert torch.equal(inner.shown, elevation >= 42.0)
    assert bool(edge.hidden[elevation > 50.0].all())
    assert torch.allclose(
        edge.amount[edge.shown].float(),
        1 - (elevation[edge.shown] - 40) / 10,
        atol=1e-3,
    )


def test_a_picture_within_one_trigger_is_decided_also_in_the_gap_of_another() -> None:
    near = LayerConfig(gap=(2.0, 20.0))
    undecided = {
        config.apart: (
            (
                depths(
                    [OVERHEAD, REAR], all_around(800), centre=CENTRE, config=config
                ).abs()
                < 1
            ).any(0)
        )
        for config in (near, replace(near, apart=True))
    }
    assert not bool((undecided[True] & ~undecided[False]).any())
    assert int(undecided[True].sum()) < int(undecided[False].sum()) - 5
