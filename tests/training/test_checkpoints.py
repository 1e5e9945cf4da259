"""Runs on the disk: what is written is what goes on, to the bit."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from mi_splat.scene import scene_hash
from mi_splat.training.checkpoints import CheckpointError, from_json, load_state, save_state, to_json
from mi_splat.training.loop import FitConfig, Progress, TrainState, advance, fit, scene_extent
from mi_splat.training.strategies import ClassicConfig, FixedConfig, MCMCConfig, StrategyConfig
from tests.training.sets import SHORT, scene_and_views, watching


@pytest.mark.parametrize(
    "strategy",
    [
        SHORT.strategy,
        MCMCConfig(densify_from=10, densify_interval=20, max_gaussians=80, dead_opacity=0.05),
        FixedConfig(),
    ],
    ids=["classic", "mcmc", "fixed"],
)
@pytest.mark.parametrize("at", [1, 20, 37])
def test_a_resumed_run_makes_the_same_bits(strategy: StrategyConfig, at: int, tmp_path: Path) -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(SHORT, strategy=strategy)
    whole = fit(views, start, render=watching(), config=config, seed=5)
    path = tmp_path / "state.safetensors"

    class Stop(Exception):  # noqa: N818
        pass

    state = TrainState(start, config, scene_extent=scene_extent(views), seed=5)

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
    for strategy in (ClassicConfig(densify_interval=7), MCMCConfig(max_gaussians=3), FixedConfig()):
        config = FitConfig(strategy=strategy, iterations=9)
        assert from_json(to_json(config)) == config


def test_bad_checkpoints_say_why(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="nothing there"):
        load_state(tmp_path / "none.safetensors")
    path = tmp_path / "bad.safetensors"
    path.write_bytes(b"\x05" * 100)
    with pytest.raises(CheckpointError, match="a checkpoint of this version"):
        load_state(path)


def test_checkpoints_of_another_format_say_what_changed(tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    notes = {"config": {"densification": None}, "extent": 1.0, "was_reset": False}
    path.write_bytes(save({"gradient": torch.zeros(1)}, metadata={"notes": json.dumps(notes)}))
    with pytest.raises(CheckpointError, match="knows its pictures by their bytes, got format 1; end it with"):
        load_state(path)
