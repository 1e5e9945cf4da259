"""What the papers fix: settings of 3DGS (Kerbl et al. 2023) and of MCMC (Kheradmand et
al. 2024), and what they do.
"""

import pytest
import torch
from torch import Tensor

from mi_splat.render.renderer import Renderer
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import TrainState, advance, scene_extent
from mi_splat.training.strategies import ClassicConfig, Edit, FixedConfig, MCMCConfig
from mi_splat.training.strategies.classic import (
    ClassicStrategy,
    densify_and_prune,
    reset_opacities,
)
from mi_splat.training.strategies.mcmc import explore
from tests.training.sets import Seen, scene_and_views, small, step_of, watching


def state_of(config: FitConfig, *, extent: float = 1.0) -> TrainState:
    return TrainState(scene_and_views(8)[0], config, scene_extent=extent, seed=0)


def test_learning_rates_at_both_ends_and_in_the_middle() -> None:
    state = state_of(FitConfig(iterations=1000, lr_sh_divisor=20), extent=3.0)
    others = {
        "scales": 5e-3,
        "rotations": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
    for iteration, rate in ((0, 1.6e-4), (500, 1.6e-5), (1000, 1.6e-6)):
        state.iteration = iteration
        rates = state.learning_rates()
        assert rates.pop("means") == pytest.approx(3 * rate)
        assert rates == pytest.approx(others)


def test_adam_steps_with_these_rates() -> None:
    _, views, start = scene_and_views()
    config = FitConfig(iterations=4, sh_degree=1, strategy=FixedConfig())
    state = TrainState(start, config, scene_extent=scene_extent(views), seed=0)
    used: dict[str, float] = {}
    before = {name: value.detach().clone() for name, value in state.parameters.items()}

    class Stop(Exception):  # noqa: N818
        pass

    def look(_: object) -> None:
        used.update(
            {group["name"]: group["lr"] for group in state.optimiser.param_groups}
        )
        raise Stop

    with pytest.raises(Stop):
        advance(state, views, render=Renderer(), on_step=look)
    state.iteration = 0
    assert used == state.learning_rates()
    for group in state.optimiser.param_groups:
        moved = (state.parameters[group["name"]].detach() - before[group["name"]]).abs()
        # The first step of Adam is as long as the rate wherever there is a gradient,
        # however small: eps is smaller yet.
        if group["name"] != "shN":  # of no use before its degree is trained
            # What is lost in adding it to a number of this size is not counted.
            assert float(moved.max()) == pytest.approx(group["lr"], rel=1e-2)


def schedule(config: ClassicConfig, iterations: int) -> tuple[list[int], list[int]]:
    """The steps at which a training adds and removes Gaussians, and those at which it
    resets opacities.
    """
    strategy = ClassicStrategy(config)
    values = small(1)
    state = strategy.initial_state(1)
    seen = Seen(torch.zeros(1), torch.ones(1))
    rounds = []
    resets = []
    for iteration in range(1, iterations):
        edit = strategy.after_step(step_of(values, iteration, iterations, seen), state)
        if edit is not None and edit.source is not None:
            rounds.append(iteration)
        if edit is not None and "opacities" in edit.forget:
            resets.append(iteration)
    return rounds, resets


def test_rounds_and_resets_come_when_the_paper_has_them() -> None:
    """Every 100 steps after the 500th, resets every 3,000, both in the first half of
    the training.
    """
    assert schedule(ClassicConfig(), 7000) == (list(range(600, 3501, 100)), [3000])
    assert schedule(
        ClassicConfig(densify_until=1000, opacity_reset_interval=0), 2000
    ) == (
        list(range(600, 1001, 100)),
        [],
    )
    assert schedule(ClassicConfig(densify_until=1300), 2000)[0][-1] == 1300


def one_round(
    values: dict[str, Tensor], grad2d: Tensor, *, prune_large: bool = False
) -> list[int]:
    edit = densify_and_prune(
        values,
        grad2d,
        scene_extent=2.0,
        config=ClassicConfig(),
        prune_large=prune_large,
        generator=torch.Generator().manual_seed(0),
    )
    assert edit.source is not None
    return edit.source.tolist()


def test_thresholds_of_the_classic_strategy() -> None:
    assert one_round(small(), torch.tensor([1.99e-4, 2.01e-4, 0.0])) == [0, 1, 2, 1]
    values = small()
    # 1 % of the extent is 0.02
    values["scales"] = torch.tensor([[0.0199], [0.0201], [1e-3]]).log().repeat(1, 3)
    # 0 is cloned, 1 is split
    assert one_round(values, torch.tensor([1.0, 1.0, 0.0])) == [0, 2, 0, 1, 1]
    values = small()
    values["opacities"] = torch.tensor([0.00499, 0.00501, 0.5]).logit()
    assert one_round(values, torch.zeros(3)) == [1, 2]
    values = small()
    values["scales"] = torch.tensor([[0.199], [0.201], [1e-3]]).log().repeat(1, 3)
    assert one_round(values, torch.zeros(3)) == [0, 1, 2]
    assert one_round(values, torch.zeros(3), prune_large=True) == [0, 2]


def test_a_reset_comes_after_its_round_and_large_ones_go_from_then_on() -> None:
    config = ClassicConfig(
        densify_from=0, densify_interval=2, opacity_reset_interval=2, densify_until=100
    )
    strategy = ClassicStrategy(config)
    values = small(3)
    values["scales"][1] = 0.0
    state = strategy.initial_state(3)
    seen = Seen(torch.tensor([1.0, 0.0, 0.0]), torch.ones(3))
    edit = strategy.after_step(step_of(values, 2, 100, seen), state)
    assert edit is not None
    assert edit.source is not None
    # none is pruned by the opacity that it is now reset to
    assert edit.source.tolist() == [0, 1, 2, 0]
    assert edit.forget == ("opacities",)
    assert edit.parameters["opacities"].sigmoid().tolist() == pytest.approx([0.01] * 4)
    assert torch.equal(edit.parameters["means"], values["means"][edit.source])
    seen = Seen(torch.zeros(4), torch.ones(4))
    later = strategy.after_step(step_of(edit.parameters, 4, 100, seen), state)
    assert later is not None
    assert later.source is not None
    assert later.source.tolist() == [0, 2, 3]


def test_a_reset_makes_adam_forget() -> None:
    _, views, start = scene_and_views()
    config = FitConfig(iterations=6, sh_degree=1, strategy=FixedConfig())
    state = TrainState(start, config, scene_extent=1.0, seed=0)
    advance(state, views, render=watching())
    moments = {
        name: state.optimiser.state[state.parameters[name]]
        for name in ("opacities", "scales")
    }
    lowered = reset_opacities(state.parameters["opacities"])
    state.apply(Edit(parameters={"opacities": lowered}, forget=("opacities",)))
    assert torch.equal(state.parameters["opacities"], lowered)
    for key in ("exp_avg", "exp_avg_sq"):
        assert not moments["opacities"][key].any()
        assert moments["scales"][key].any()
    assert float(moments["opacities"]["step"]) == 6


# What the paper of MCMC fixes (Kheradmand et al. 2024)


def test_mcmc_rounds_come_in_their_time_and_noise_at_every_step() -> None:
    config = MCMCConfig(
        densify_from=4, densify_until=8, densify_interval=2, max_gaussians=None
    )
    strategy = config.build()
    values = small(20)
    values["opacities"][:] = 0.005  # of little opacity, so that the noise moves them
    rounds = []
    for iteration in range(1, 13):
        step = step_of(values, iteration, 100, Seen(torch.zeros(20), torch.zeros(20)))
        edit = strategy.after_step(step, {})
        assert edit is not None
        if edit.source is None:
            expected = explore(
                values,
                lr_means=1e-4,
                config=MCMCConfig(),
                generator=torch.Generator().manual_seed(0),
            )
            assert torch.equal(edit.parameters["means"], expected)
        else:
            rounds.append(iteration)
    assert rounds == [6, 8]


def test_mcmc_noise_has_the_size_of_the_paper() -> None:
    """Noise of 5e5 times the rate, through the covariance, gated by a sigmoid of slope
    100 around 0.005.
    """
    values = small(2)
    values["scales"][:] = torch.tensor([0.1, 0.2, 0.3]).log()
    values["opacities"] = torch.tensor([0.005, 0.045]).logit()
    draws = torch.randn(2, 3, generator=torch.Generator().manual_seed(1))
    moved = explore(
        values,
        lr_means=1e-4,
        config=MCMCConfig(),
        generator=torch.Generator().manual_seed(1),
    )
    gate = torch.tensor([[0.5], [1 / (1 + 2.718281828**4)]])
    expected = 5e5 * 1e-4 * gate * draws * torch.tensor([0.01, 0.04, 0.09])
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=1e-7)
