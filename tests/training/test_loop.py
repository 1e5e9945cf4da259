"""The loop: what it descends, what it leaves alone, and what it refuses."""

import dataclasses

import pytest
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, View
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training import loop
from mi_splat.training.loop import (
    FitConfig,
    TrainingError,
    TrainState,
    advance,
    fit,
    targets_of,
)
from mi_splat.training.state import MOMENTS, Adam
from mi_splat.training.strategies import ClassicConfig, Edit, FixedConfig
from tests.training.sets import SHORT, scene_and_views, watching


def test_training_comes_nearer() -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(
        SHORT,
        iterations=250,
        sh_degree_interval=0,
        strategy=FixedConfig(),
        eval_interval=0,
    )
    losses: list[float] = []
    trained = fit(
        views,
        start,
        render=Renderer(),
        config=config,
        held_out=views,
        on_step=lambda p: losses.append(p.loss),
    )
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    (last,) = trained.history
    assert last.held_out is not None
    assert last.held_out.psnr > 20
    assert 0.5 < last.held_out.ssim <= 1
    assert len(trained.scene) == len(start)
    assert trained.scene.degree == 1


def test_the_last_step_is_no_reset() -> None:
    _, views, start = scene_and_views()
    adding = ClassicConfig(
        densify_from=1,
        densify_until=4,
        densify_interval=2,
        densify_grad_threshold=1e-9,
        opacity_reset_interval=4,
        max_gaussians=90,
    )
    config = FitConfig(iterations=4, sh_degree=1, strategy=adding)
    counts: list[int] = []
    trained = fit(
        views,
        start,
        render=watching(),
        config=config,
        on_step=lambda line: counts.append(line.count),
    )
    assert float(trained.scene.opacities.max()) > 0.05
    assert counts[1] > counts[0]
    assert counts[3] == counts[2]


def test_texture_training_freezes_geometry() -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(
        SHORT, trainable=("sh",), strategy=FixedConfig(), iterations=8
    )
    trained = fit(views, start, render=Renderer(), config=config)
    for name in ("means", "rotations"):
        assert torch.equal(getattr(trained.scene, name), getattr(start, name))
    for name in ("scales", "opacities"):
        assert torch.allclose(
            getattr(trained.scene, name), getattr(start, name), rtol=1e-6
        )
    assert not torch.equal(trained.scene.sh, start.sh)


def test_nan_stops_with_the_cause() -> None:
    _, views, start = scene_and_views()
    spoilt = View(views[0].camera, torch.full_like(views[0].image, float("nan")))
    with pytest.raises(TrainingError, match="the image or the view is not"):
        fit([spoilt], start, render=watching(), config=SHORT)


def test_a_plain_renderer_cannot_densify() -> None:
    _, views, start = scene_and_views()
    with pytest.raises(
        InvalidValueError, match="a renderer that keeps screen gradients"
    ):
        fit(
            views,
            start,
            render=lambda scene, camera: Renderer()(scene, camera),
            config=SHORT,
        )
    with pytest.raises(InvalidValueError, match="views: expected at least one"):
        fit([], start, render=watching(), config=SHORT)
    with pytest.raises(
        InvalidValueError, match="start: expected at least one Gaussian"
    ):
        fit(views, start.select(slice(0, 0)), render=watching(), config=SHORT)


# What a run is made of: the order of its views, the degree that is trained, and what
# Adam keeps for each row


def state_of(
    config: FitConfig, *, start: GaussianScene | None = None, seed: int = 0
) -> TrainState:
    return TrainState(
        start or scene_and_views(8)[2], config, scene_extent=1.0, seed=seed
    )


def test_the_degree_rises_by_one_each_interval() -> None:
    for interval, iterations in ((10, 7000), (None, 300)):  # a thirtieth of the steps
        state = state_of(FitConfig(iterations=iterations, sh_degree_interval=interval))
        degrees = [
            state.scene().degree for state.iteration in (0, 9, 10, 19, 20, 30, 99)
        ]
        assert degrees == [0, 0, 1, 1, 2, 3, 3]
    for config in (FitConfig(sh_degree_interval=0), FitConfig(iterations=29)):
        assert state_of(config).scene().degree == 3


def test_a_gpu_keeps_images(monkeypatch: pytest.MonkeyPatch) -> None:
    _, views, _ = scene_and_views(8)
    room = 4 * 2 * 20 * 36 * 32  # of which a quarter holds two images
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (room, room))
    target_of = targets_of(views, torch.device("meta"))
    first = target_of(0)
    assert first[1].is_meta
    assert target_of(1) is target_of(1)
    assert target_of(0) is first
    target_of(1), target_of(2)
    assert target_of(0) is not first


def trained() -> TrainState:
    _, views, start = scene_and_views(8)
    state = state_of(
        FitConfig(
            iterations=5, sh_degree=1, sh_degree_interval=1, strategy=FixedConfig()
        ),
        start=start,
    )
    advance(state, views, render=Renderer())
    return state


def test_rows_keep_what_adam_knows_of_them_unless_they_are_fresh() -> None:
    state = trained()
    old = {
        name: {
            key: value.clone()
            for key, value in state.optimiser.state[state.parameters[name]].items()
        }
        for name in state.trained
    }
    values = {name: value.detach().clone() for name, value in state.parameters.items()}
    source = torch.tensor([6, 1, 1])
    fresh = torch.tensor([False, False, True])
    state.apply(
        Edit(
            parameters={"scales": values["scales"][source] + 1},
            source=source,
            fresh=fresh,
        )
    )
    assert len(state.result()) == 3
    for name in state.trained:
        tensor = state.parameters[name]
        assert tensor.requires_grad
        assert torch.equal(
            tensor.detach(), values[name][source] + (1 if name == "scales" else 0)
        )
        for key in ("exp_avg", "exp_avg_sq"):
            kept = state.optimiser.state[tensor][key]
            assert torch.equal(kept[:2], old[name][key][[6, 1]])
            assert kept[:2].any()
            assert not kept[2].any()
        assert float(state.optimiser.state[tensor]["step"]) == 5
    assert [
        group["params"][0] is state.parameters[group["name"]]
        for group in state.optimiser.param_groups
    ] == [True] * len(state.trained)


@pytest.mark.parametrize("fused", [False, True])
def test_adam_has_the_bits_of_torch(fused: bool) -> None:
    ours, theirs = (torch.linspace(-1, 1, 7).requires_grad_(True) for _ in range(2))
    mine = Adam([{"params": [ours], "lr": 0.1}], fused=fused)
    other = torch.optim.Adam([theirs], lr=0.1, eps=1e-15, fused=fused)
    for step in range(5):
        for leaf, optimiser in ((ours, mine), (theirs, other)):
            ((leaf - 0.3) ** 2 * (step + 1)).sum().backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            optimiser.zero_grad()
    assert torch.equal(ours, theirs)
    assert all(
        torch.equal(mine.state[ours][key], other.state[theirs][key]) for key in MOMENTS
    )


def test_the_first_steps_look_at_smaller_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, views, start = scene_and_views()
    monkeypatch.setattr(loop, "LEAST_SIDE", 8)
    sizes: list[tuple[int, int]] = []
    plain = Renderer()

    def render(scene: GaussianScene, camera: Camera) -> Tensor:
        sizes.append((camera.width, camera.height))
        return plain(scene, camera)

    config = FitConfig(
        iterations=8, coarse_until=0.5, strategy=FixedConfig(), eval_interval=0
    )
    trained = fit(views, start, render=render, config=config)
    full = (36, 32)
    assert sizes == [(9, 8)] * 2 + [(18, 16)] * 2 + [full] * 4
    assert trained.history[-1].iteration == 8


def test_images_are_never_made_smaller_than_the_window_of_ssim() -> None:
    _, views, start = scene_and_views()
    config = FitConfig(iterations=4, strategy=FixedConfig(), eval_interval=0)
    coarse = dataclasses.replace(config, coarse_until=0.9)
    images = [
        fit(views, start, render=Renderer(), config=each).scene
        for each in (config, coarse)
    ]
    assert scene_hash(images[0]) == scene_hash(images[1])
