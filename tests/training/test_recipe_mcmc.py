"""What the paper of MCMC fixes (Kheradmand et al. 2024)."""

from __future__ import annotations

import pytest
import torch

from mi_splat.scene import GaussianScene
from mi_splat.training.strategies import MCMCConfig, build_strategy
from mi_splat.training.strategies.mcmc import explore, relocate
from tests.training.sets import Seen, scene_and_views, small, step_of


def test_mcmc_grows_by_a_twentieth_and_moves_the_dead() -> None:
    values = small(100)
    values["opacities"][:2] = torch.tensor([0.00499, 0.00501]).logit()
    edit = relocate(values, config=MCMCConfig(), generator=torch.Generator().manual_seed(0))
    assert edit.source is not None
    assert edit.fresh is not None
    assert len(edit.source) == 105
    assert edit.source[0] != 0
    assert edit.source[1] == 1
    assert edit.fresh[[0, 100, 101, 102, 103, 104]].all()
    assert set(edit.fresh.nonzero().flatten().tolist()) == {0, *range(100, 105), *edit.source[[0]].tolist()} | set(
        edit.source[100:].tolist()
    )
    assert not edit.fresh[1]


def test_mcmc_draws_by_opacity() -> None:
    values = small(2)
    values["opacities"] = torch.tensor([0.1, 0.9]).logit()
    config = MCMCConfig(growth=1000.0)
    edit = relocate(values, config=config, generator=torch.Generator().manual_seed(0))
    assert edit.source is not None
    assert float(edit.source[2:].float().mean()) == pytest.approx(0.9, abs=0.03)


def test_mcmc_rounds_come_in_their_time_and_noise_at_every_step() -> None:
    config = MCMCConfig(densify_from=4, densify_until=8, densify_interval=2, max_gaussians=None)
    strategy = build_strategy(config)
    values = small(20)
    values["opacities"][:] = 0.005  # of little opacity, so that the noise moves them
    rounds = []
    for iteration in range(1, 13):
        step = step_of(values, iteration, 100, Seen(torch.zeros(20), torch.zeros(20)))
        edit = strategy.after_step(step, {})
        assert edit is not None
        if edit.source is None:
            expected = explore(values, lr_means=1e-4, config=MCMCConfig(), generator=torch.Generator().manual_seed(0))
            assert torch.equal(edit.parameters["means"], expected)
        else:
            rounds.append(iteration)
    assert rounds == [6, 8]


def test_mcmc_noise_has_the_size_of_the_paper() -> None:
    """Noise of 5e5 times the rate, through the covariance, gated by a sigmoid of slope 100 around 0.005."""
    values = small(2)
    values["scales"][:] = torch.tensor([0.1, 0.2, 0.3]).log()
    values["opacities"] = torch.tensor([0.005, 0.045]).logit()
    draws = torch.randn(2, 3, generator=torch.Generator().manual_seed(1))
    moved = explore(values, lr_means=1e-4, config=MCMCConfig(), generator=torch.Generator().manual_seed(1))
    gate = torch.tensor([[0.5], [1 / (1 + 2.718281828**4)]])
    expected = 5e5 * 1e-4 * gate * draws * torch.tensor([0.01, 0.04, 0.09])
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=1e-7)


def test_mcmc_noise_turns_with_the_gaussian() -> None:
    """A needle along x, turned to lie along y, is shaken along y only."""
    values = small(1)
    values["scales"][0] = torch.tensor([0.5, 1e-4, 1e-4]).log()
    values["rotations"][0] = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
    values["opacities"][:] = -9.0
    moved = explore(values, lr_means=1e-4, config=MCMCConfig(), generator=torch.Generator().manual_seed(1))[0]
    assert abs(float(moved[1])) > 1e3 * max(abs(float(moved[0])), abs(float(moved[2])))


def test_mcmc_adds_its_two_regularisers() -> None:
    leaf = [value.detach().requires_grad_(True) for value in scene_and_views(8)[0].tensors()]
    scene = GaussianScene.unchecked(*leaf)
    loss = build_strategy(MCMCConfig()).before_backward(torch.tensor(2.0), scene)
    assert float(loss.detach()) == pytest.approx(
        2 + 0.01 * float(scene.opacities.mean().detach()) + 0.01 * float(scene.scales.mean().detach())
    )
    loss.backward()  # type: ignore[no-untyped-call]
    for value, count in ((scene.opacities, 8), (scene.scales, 24)):
        assert value.grad is not None
        torch.testing.assert_close(value.grad, torch.full_like(value, 0.01 / count))
