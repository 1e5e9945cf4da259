"""The trainer: its loss, its densification, its schedule, and resuming to the bit, mostly on a ten-line renderer."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from mi_splat.cameras import Camera, View, look_at
from mi_splat.errors import InvalidValueError
from mi_splat.metrics import ssim as reported_ssim
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, merge, scene_hash
from mi_splat.training import strategies
from mi_splat.training.checkpoints import CheckpointError, from_json, load_state, save_state, to_json
from mi_splat.training.loop import FitConfig, Progress, TrainingError, TrainState, advance, extent_of, fit
from mi_splat.training.losses import blur, photometric_loss, ssim
from mi_splat.training.strategies import ClassicConfig, MCMCConfig
from tests import oracle


def pictures(seed: int, height: int = 24, width: int = 30) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return first, (first + 0.2 * torch.rand(first.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)


def test_ssim_has_its_derivative() -> None:
    image, reference = pictures(0, 13, 17)
    assert torch.autograd.gradcheck(lambda x: ssim(x, reference), image.requires_grad_(True))


def test_ssim_is_that_of_the_library_away_from_the_rim() -> None:
    image, reference = (p.float() for p in pictures(1, 200, 200))
    assert float(ssim(image, reference)) == pytest.approx(float(reported_ssim(image, reference)), abs=5e-3)
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-6)


def test_blur_is_its_own_adjoint() -> None:
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.randn(2, 14, 19, generator=generator, dtype=torch.float64) for _ in range(2))
    assert float((blur(a) * b).sum()) == pytest.approx(float((a * blur(b)).sum()), rel=1e-12)
    flat = torch.ones(1, 30, 30, dtype=torch.float64)
    assert float(blur(flat)[0, 15, 15]) == pytest.approx(1.0)


def test_photometric_weighs_its_two_terms() -> None:
    image, reference = pictures(2)
    plain = (image - reference).abs().mean()
    assert torch.equal(photometric_loss(image, reference, lambda_dssim=0), plain)
    both = photometric_loss(image, reference, lambda_dssim=0.25)
    assert float(both) == pytest.approx(float(0.75 * plain + 0.25 * (1 - ssim(image, reference))))


@pytest.mark.parametrize("shape", [(8, 8), (8, 9, 3)])
def test_ssim_of_unlike_pictures_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidValueError, match="image: expected shape"):
        ssim(torch.zeros(shape), torch.zeros(8, 8, 3))


def values(count: int, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(count, 3, generator=generator),
        "scales": torch.randn(count, 3, generator=generator) * 0.5 - 3,
        "rotations": torch.randn(count, 4, generator=generator),
        "opacities": torch.randn(count, generator=generator) + 1,
        "dc": torch.randn(count, 1, 3, generator=generator),
        "rest": torch.randn(count, 3, 3, generator=generator),
    }


def test_classic_round_keeps_clones_and_splits() -> None:
    before = values(6)
    before["scales"][:3] = -1.0  # 0.37, large
    before["scales"][3:] = -6.0
    before["opacities"][5] = -9.0  # dead
    gradient = torch.tensor([1.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    edit = strategies.classic(
        before,
        gradient,
        extent=1.0,
        config=ClassicConfig(densify_grad_threshold=0.5, percent_dense=0.1),
        was_reset=False,
        generator=torch.Generator().manual_seed(0),
    )
    assert edit.source.tolist() == [1, 3, 4, 3, 0, 0, 2, 2]  # 5 is pruned, 0 and 2 are split, 3 is cloned
    assert edit.fresh.tolist() == [False] * 3 + [True] * 5
    after = edit.parameters
    for name, tensor in after.items():
        assert torch.equal(tensor[:4], before[name][[1, 3, 4, 3]])
    assert torch.allclose(after["scales"][4:], before["scales"][[0, 0, 2, 2]] - torch.tensor(1.6).log(), atol=1e-6)
    assert (after["means"][4] - after["means"][5]).norm() > 0
    assert ((after["means"][4:] - before["means"][[0, 0, 2, 2]]).norm(dim=1) < 4 * 0.37).all()


def test_classic_round_respects_its_limit() -> None:
    before = values(20, seed=1)
    edit = strategies.classic(
        before,
        torch.arange(20.0),
        extent=1.0,
        config=ClassicConfig(densify_grad_threshold=0.5, max_gaussians=23, prune_opacity=0.0),
        was_reset=False,
        generator=torch.Generator().manual_seed(0),
    )
    assert len(edit.source) == 23
    assert set(edit.source[edit.fresh].tolist()) <= {17, 18, 19}


def test_large_gaussians_go_once_opacities_were_reset() -> None:
    before = values(4, seed=2)
    before["scales"][1] = 0.0
    for was_reset, left in ((False, [0, 1, 2, 3]), (True, [0, 2, 3])):
        edit = strategies.classic(
            before,
            torch.zeros(4),
            extent=1.0,
            config=ClassicConfig(prune_opacity=0.0, prune_scale=0.5),
            was_reset=was_reset,
            generator=torch.Generator(),
        )
        assert edit.source.tolist() == left


def test_reset_lowers_opacities_only() -> None:
    logits = torch.tensor([-9.0, -4.0, 3.0])
    after = strategies.reset_opacities(logits).sigmoid()
    assert torch.equal(after[0], logits[0].sigmoid())
    assert after.max() <= 0.01 + 1e-6


def test_relocated_gaussians_look_like_the_one_they_came_from() -> None:
    """The line integral of opacity through n coinciding Gaussians is that of the one they replace."""
    before = values(5, seed=4)
    before["opacities"][:] = 2.0
    before["opacities"][4] = -9.0
    edit = strategies.relocate(before, config=MCMCConfig(growth=0.0), generator=torch.Generator().manual_seed(1))
    assert len(edit.source) == 5
    (parent,) = set(edit.source.tolist()) & {int(edit.source[4])}
    assert edit.fresh.nonzero().flatten().tolist() == sorted({parent, 4})
    after = edit.parameters
    assert torch.equal(after["means"][4], before["means"][parent])
    x = torch.linspace(-6, 6, 4001, dtype=torch.float64)

    def line(logit: Tensor, log_scale: Tensor, count: int) -> float:
        alpha = logit.double().sigmoid() * torch.exp(-0.5 * (x / log_scale.double().exp()) ** 2)
        return float(torch.trapezoid(1 - (1 - alpha) ** count, x))

    old = line(before["opacities"][parent], before["scales"][parent, 0] * 0, 1)
    relative = after["scales"][4, 0] - before["scales"][parent, 0]
    assert line(after["opacities"][4], relative, 2) == pytest.approx(old, rel=1e-3)
    untouched = [i for i in range(4) if i != parent]
    for name, tensor in after.items():
        assert torch.equal(tensor[untouched], before[name][untouched])


def test_mcmc_grows_to_its_limit() -> None:
    state = values(40, seed=5)
    for _ in range(20):
        edit = strategies.relocate(
            state, config=MCMCConfig(max_gaussians=61), generator=torch.Generator().manual_seed(2)
        )
        state = edit.parameters
    assert len(state["means"]) == 61


def test_noise_spares_opaque_gaussians() -> None:
    state = values(30, seed=6)
    state["opacities"][:15], state["opacities"][15:] = 5.0, -9.0
    moved = strategies.explore(state, rate=1e-3, config=MCMCConfig(), generator=torch.Generator().manual_seed(0))
    far = (moved - state["means"]).norm(dim=1)
    assert float(far[:15].max()) < 1e-6
    assert float(far[15:].min()) > 0


def scene_and_views(count: int = 60) -> tuple[GaussianScene, list[View], GaussianScene]:
    """A small splat, pictures of it, and a start that is not far from it."""
    truth = oracle.random_scene(count, degree=1, seed=9)
    render = Renderer()
    cameras = [
        Camera(to_world=look_at((4 * x, 4 * y, 1.0), (0, 0, 0)), focal=40.0, width=36, height=32)
        for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1), (0.7, 0.7))
    ]
    with torch.no_grad():
        views = [View(camera, render(truth, camera).clamp(0, 1)) for camera in cameras]
    generator = torch.Generator().manual_seed(1)
    start = truth.replace(
        means=truth.means + 0.05 * torch.randn(truth.means.shape, generator=generator), sh=torch.zeros_like(truth.sh)
    )
    return truth, views, start


SHORT = FitConfig(
    iterations=60,
    sh_degree=1,
    sh_degree_interval=20,
    eval_interval=30,
    densification=ClassicConfig(
        densify_from=10, densify_interval=20, densify_grad_threshold=1e-5, opacity_reset_interval=50, max_gaussians=90
    ),
)


def watching() -> Renderer:
    return Renderer(RenderSettings(), screen_gradients=ScreenGradients())


def test_training_comes_nearer() -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(SHORT, iterations=250, sh_degree_interval=0, densification=None, eval_interval=0)
    losses: list[float] = []
    found = fit(views, start, render=Renderer(), config=config, held_out=views, on_step=lambda p: losses.append(p.loss))
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    (last,) = found.history
    assert last.held_out is not None
    assert last.held_out.psnr > 20
    assert 0.5 < last.held_out.ssim <= 1
    assert len(found.scene) == len(start)
    assert found.scene.degree == 1


def test_the_last_step_is_no_reset() -> None:
    _, views, start = scene_and_views()
    adding = ClassicConfig(
        densify_from=1, densify_interval=2, densify_grad_threshold=1e-9, opacity_reset_interval=4, max_gaussians=90
    )
    config = FitConfig(iterations=4, sh_degree=1, densification=adding)
    counts: list[int] = []
    found = fit(views, start, render=watching(), config=config, on_step=lambda line: counts.append(line.count))
    assert float(found.scene.opacities.max()) > 0.05
    assert counts[1] > counts[0]
    assert counts[3] == counts[2]


def test_texture_training_freezes_geometry() -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(SHORT, trainable=("sh",), densification=None, iterations=8)
    found = fit(views, start, render=Renderer(), config=config)
    for name in ("means", "rotations"):
        assert torch.equal(getattr(found.scene, name), getattr(start, name))
    for name in ("scales", "opacities"):
        assert torch.allclose(getattr(found.scene, name), getattr(start, name), rtol=1e-6)
    assert not torch.equal(found.scene.sh, start.sh)


@pytest.mark.parametrize(
    "densification",
    [SHORT.densification, MCMCConfig(densify_from=10, densify_interval=20, max_gaussians=80, dead_opacity=0.05), None],
    ids=["classic", "mcmc", "fixed"],
)
@pytest.mark.parametrize("at", [1, 20, 37])
def test_a_resumed_run_makes_the_same_bits(
    densification: ClassicConfig | MCMCConfig | None, at: int, tmp_path: Path
) -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(SHORT, densification=densification)
    whole = fit(views, start, render=watching(), config=config, seed=5)
    path = tmp_path / "state.safetensors"

    class Stop(Exception):  # noqa: N818
        pass

    state = TrainState(start, config, extent=extent_of(views), seed=5)

    def stop(line: Progress) -> None:
        if line.iteration == at:
            save_state(state, path)
            raise Stop

    with pytest.raises(Stop):
        advance(state, views, render=watching(), on_step=stop)
    again, threads = load_state(path)
    assert threads == torch.get_num_threads()
    assert again.iteration == at
    resumed = advance(again, views, render=watching())
    assert scene_hash(resumed.scene) == scene_hash(whole.scene)
    assert scene_hash(fit(views, start, render=watching(), config=config, seed=6).scene) != scene_hash(whole.scene)


def test_configuration_makes_the_round_trip() -> None:
    for densification in (ClassicConfig(densify_interval=7), MCMCConfig(max_gaussians=3), None):
        config = FitConfig(densification=densification, iterations=9)
        assert from_json(to_json(config)) == config


def test_bad_checkpoints_say_why(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="nothing there"):
        load_state(tmp_path / "none.safetensors")
    path = tmp_path / "bad.safetensors"
    path.write_bytes(b"\x05" * 100)
    with pytest.raises(CheckpointError, match="a checkpoint of this version"):
        load_state(path)


def test_nan_stops_with_the_cause() -> None:
    _, views, start = scene_and_views()
    spoilt = View(views[0].camera, torch.full_like(views[0].image, float("nan")))
    with pytest.raises(TrainingError, match="the picture or the view is not"):
        fit([spoilt], start, render=watching(), config=SHORT)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"trainable": ("colour",)}, "trainable"),
        ({"trainable": ("sh",)}, "densification"),
        ({"iterations": 0}, "iterations"),
        ({"sh_degree": 4}, "sh_degree"),
    ],
)
def test_bad_configurations_say_why(given: dict[str, object], says: str) -> None:
    with pytest.raises(InvalidValueError, match=says):
        FitConfig(**given)  # type: ignore[arg-type]


def test_a_plain_renderer_cannot_densify() -> None:
    _, views, start = scene_and_views()
    with pytest.raises(InvalidValueError, match="a renderer that watches"):
        fit(views, start, render=lambda scene, camera: Renderer()(scene, camera), config=SHORT)
    with pytest.raises(InvalidValueError, match="at least one of each"):
        fit([], start, render=watching(), config=SHORT)


def test_watch_is_the_gradient_of_the_centre() -> None:
    """Weights that rise by (1, 2) a pixel: moving the only centre changes the weighted sum by the picture's sum."""
    scene = GaussianScene(
        torch.tensor([[0.1, 0.2, 0.0]]),
        torch.tensor([[0.3, 0.2, 0.25]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([0.7]),
        torch.full((1, 1, 3), 0.8),
    )
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    screen_gradients, camera = (
        ScreenGradients(),
        Camera(to_world=look_at((4, 0, 1), (0, 0, 0)), focal=50.0, width=40, height=40),
    )
    leaves = GaussianScene.unchecked(*(t.clone().requires_grad_(True) for t in scene.tensors()))
    image = Renderer(RenderSettings(), screen_gradients=screen_gradients)(leaves, camera)
    (image * (x + 2 * y)[..., None]).sum().backward()  # type: ignore[no-untyped-call]
    expected = float(image.detach().sum()) * 5**0.5
    # In half pictures of 20 pixels; the jump of alpha at 1/255 has no gradient, 3 % of this sum.
    assert float(screen_gradients.lengths[0]) == pytest.approx(20 * expected, rel=0.04)
    assert screen_gradients.visible.tolist() == [1.0]


def test_watch_knows_what_is_out_of_sight() -> None:
    scene = oracle.random_scene(30, degree=0, seed=3)
    behind = scene.replace(means=scene.means + torch.tensor([20.0, 0.0, 0.0]))
    screen_gradients, camera = (
        ScreenGradients(),
        Camera(to_world=look_at((4, 0, 1), (0, 0, 0)), focal=50.0, width=40, height=40),
    )
    leaves = GaussianScene.unchecked(*(t.clone().requires_grad_(True) for t in merge(scene, behind).tensors()))
    Renderer(RenderSettings(), screen_gradients=screen_gradients)(leaves, camera).sum().backward()  # type: ignore[no-untyped-call]
    assert screen_gradients.visible[30:].sum() == screen_gradients.lengths[30:].sum() == 0
    assert float(screen_gradients.visible[:30].sum()) > 10
