"""What a run is made of: the order of its views, the degree that is trained, and what Adam keeps for each row."""

from __future__ import annotations

import pytest
import torch

from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import TrainingError, TrainState, advance, scene_extent
from mi_splat.training.strategies import Edit, FixedConfig
from tests.training.sets import scene_and_views


def state_of(config: FitConfig, *, start: GaussianScene | None = None, seed: int = 0) -> TrainState:
    return TrainState(start or scene_and_views(8)[2], config, scene_extent=1.0, seed=seed)


def test_all_views_are_seen_before_one_is_seen_again() -> None:
    orders = []
    for seed in (0, 1):
        state = state_of(FitConfig(), seed=seed)
        passes = [[state.next_view(30) for _ in range(30)] for _ in range(2)]
        assert [sorted(one) for one in passes] == [list(range(30))] * 2
        assert passes[0] != passes[1]
        orders += passes
    assert all(one not in (list(range(30)), list(range(29, -1, -1))) for one in orders)
    assert orders[0] != orders[2]


def test_the_degree_rises_by_one_each_interval() -> None:
    state = state_of(FitConfig(sh_degree=3, sh_degree_interval=10))
    degrees = []
    for state.iteration in (0, 9, 10, 19, 20, 30, 99):
        degrees.append(state.active_sh_degree)
        assert state.scene().degree == degrees[-1]
    assert degrees == [0, 0, 1, 1, 2, 3, 3]
    assert state_of(FitConfig(sh_degree=3, sh_degree_interval=0)).active_sh_degree == 3


def test_rotations_are_normalised_before_they_are_rendered() -> None:
    state = state_of(FitConfig())
    with torch.no_grad():
        state.parameters["rotations"].mul_(3.0)
    torch.testing.assert_close(state.scene().rotations.norm(dim=1), torch.ones(8))
    torch.testing.assert_close(state.result().rotations, state.scene().rotations.detach())


def trained() -> TrainState:
    _, views, start = scene_and_views(8)
    state = state_of(FitConfig(iterations=5, sh_degree=1, sh_degree_interval=1, strategy=FixedConfig()), start=start)
    advance(state, views, render=Renderer())
    return state


def test_rows_keep_what_adam_knows_of_them_unless_they_are_fresh() -> None:
    state = trained()
    old = {
        name: {key: value.clone() for key, value in state.optimiser.state[state.parameters[name]].items()}
        for name in state.trained
    }
    values = {name: value.detach().clone() for name, value in state.parameters.items()}
    source, fresh = torch.tensor([6, 1, 1]), torch.tensor([False, False, True])
    state.apply(Edit(parameters={"scales": values["scales"][source] + 1}, source=source, fresh=fresh))
    assert len(state.result()) == 3
    for name in state.trained:
        tensor = state.parameters[name]
        assert tensor.requires_grad
        assert torch.equal(tensor.detach(), values[name][source] + (1 if name == "scales" else 0))
        for key in ("exp_avg", "exp_avg_sq"):
            kept = state.optimiser.state[tensor][key]
            assert torch.equal(kept[:2], old[name][key][[6, 1]])
            assert kept[:2].any()
            assert not kept[2].any()
        assert float(state.optimiser.state[tensor]["step"]) == 5
    assert [group["params"][0] is state.parameters[group["name"]] for group in state.optimiser.param_groups] == [
        True
    ] * len(state.trained)


def test_rows_of_what_is_not_trained_go_with_the_others() -> None:
    state = state_of(FitConfig(trainable=("sh",), strategy=FixedConfig()))
    means = state.parameters["means"].clone()
    state.apply(Edit(parameters={}, source=torch.tensor([3, 0])))
    assert torch.equal(state.parameters["means"], means[[3, 0]])
    assert not state.parameters["means"].requires_grad
    assert state.parameters["sh0"].requires_grad
    assert len(state.scene()) == 2


def test_nothing_left_is_an_error() -> None:
    with pytest.raises(TrainingError, match="Gaussians left after pruning"):
        state_of(FitConfig()).apply(Edit(parameters={}, source=torch.zeros(0, dtype=torch.int64)))


def test_the_extent_is_that_of_3dgs() -> None:
    """1.1 times the largest distance of a camera from the mean of all."""
    _, views, _ = scene_and_views(8)
    positions = torch.stack([view.camera.position for view in views])
    assert scene_extent(views) == pytest.approx(1.1 * float((positions - positions.mean(0)).norm(dim=1).max()))
    assert scene_extent(views[:1]) == 1e-3
