"""A strategy that the library has never heard of: trained with, taken up again, and
named on the command line.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from mi_splat.io import load_splat
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.loop import Progress, TrainState, advance, fit, scene_extent
from mi_splat.training.resume import load_state, save_state
from mi_splat.training.strategies import (
    STRATEGIES,
    Edit,
    Step,
    Strategy,
    StrategyConfig,
)
from tests.training.sets import SHORT, scene_and_views, write_set


@dataclass(frozen=True, slots=True, kw_only=True)
class LotteryConfig(StrategyConfig):
    """Every so often one Gaussian, drawn by lot, is copied, and the faintest is left
    out.

    Attributes:
        every: Steps between two draws.
        reward: Weight of the negative mean scale in the loss.
    """

    every: int = 7
    reward: float = 0.001

    def build(self) -> Strategy:
        return Lottery(self)


class Lottery(Strategy):
    def __init__(self, options: LotteryConfig) -> None:
        self.options = options

    def initial_state(self, count: int) -> dict[str, Tensor]:
        return {"drawn": torch.zeros(count)}

    def before_backward(self, loss: Tensor, scene: GaussianScene) -> Tensor:
        return loss - self.options.reward * scene.scales.mean()

    def after_step(self, step: Step, state: dict[str, Tensor]) -> Edit | None:
        count = len(state["drawn"])
        if step.iteration % self.options.every:
            return Edit(parameters={"sh0": 0.999 * step.parameters["sh0"].detach()})
        # who was drawn before is less likely to be drawn again
        chances = 1 / (1 + state["drawn"])
        winner = torch.multinomial(chances, 1, generator=step.generator)
        state["drawn"][winner] += 1
        faintest = int(step.parameters["opacities"].argmin())
        source = torch.cat([torch.arange(count), winner])
        source = source[torch.arange(count + 1) != faintest]
        state["drawn"] = state["drawn"][source]
        fresh = torch.zeros(count, dtype=torch.bool)
        fresh[-1] = True
        return Edit(parameters={}, source=source, fresh=fresh, forget=("rotations",))


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STRATEGIES.own, "lottery", LotteryConfig)


def test_it_trains_and_goes_on_to_the_bit(tmp_path: Path) -> None:
    _, views, start = scene_and_views()
    settings = replace(SHORT, iterations=24, strategy=LotteryConfig())
    path = tmp_path / "state.safetensors"
    state = TrainState(start, settings, scene_extent=scene_extent(views), seed=3)

    def keep(line: Progress) -> None:
        if line.iteration == 15:
            save_state(state, path)

    whole = advance(state, views, render=Renderer(), on_step=keep).scene
    assert len(whole) == len(start)
    # copies have moved since
    assert len({tuple(row) for row in whole.means.tolist()}) == len(start)
    assert scene_hash(whole) != scene_hash(
        fit(views, start, render=Renderer(), config=settings, seed=4).scene
    )
    again, _ = load_state(path)
    assert float(again.strategy_state["drawn"].sum()) > 0
    assert again.config == settings
    assert scene_hash(advance(again, views, render=Renderer()).scene) == scene_hash(
        whole
    )


def test_the_command_line_knows_its_name_and_its_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_set(tmp_path / "set")
    out = tmp_path / "out"
    words = [
        "train",
        str(folder),
        "--out",
        str(out),
        "--iterations",
        "9",
        "--sh-degree",
        "1",
    ]
    words += ["--strategy", "lottery", "--every", "4"]
    assert cli.main([*words, "--help"]) == 0
    assert "Steps between two draws" in capsys.readouterr().out
    assert cli.main(words) == 0
    settings = json.loads((out / "config.json").read_text())["config"]
    assert settings["strategy"] == {
        "kind": "lottery",
        "every": 4,
        "reward": 0.001,
        "max_gaussians": 100_000,
    }
    first = load_splat(out / "splat.ply")
    assert cli.main(words) == 0  # read from the checkpoint
    assert scene_hash(load_splat(out / "splat.ply")) == scene_hash(first)
