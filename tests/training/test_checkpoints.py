"""Runs on the disk: what is written is what goes on, to the bit."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from mi_splat.scene import scene_hash
from mi_splat.training.loop import Progress, TrainState, advance, fit, scene_extent
from mi_splat.training.resume import CheckpointError, load_state, save_state
from mi_splat.training.strategies import FixedConfig, MCMCConfig, StrategyConfig
from tests.io.noted import Change, changed
from tests.training.sets import SHORT, scene_and_views, watching


@pytest.mark.parametrize(
    "strategy",
    [
        SHORT.strategy,
        MCMCConfig(
            densify_from=10, densify_interval=20, max_gaussians=80, dead_opacity=0.05
        ),
        FixedConfig(),
    ],
    ids=["classic", "mcmc", "fixed"],
)
def test_a_resumed_run_makes_the_same_bits(
    strategy: StrategyConfig, tmp_path: Path
) -> None:
    _, views, start = scene_and_views()
    config = dataclasses.replace(SHORT, strategy=strategy)
    state = TrainState(start, config, scene_extent=scene_extent(views), seed=5)
    paths = {at: tmp_path / f"{at}.safetensors" for at in (1, 20, 37)}

    def keep(line: Progress) -> None:
        if line.iteration in paths:
            save_state(state, paths[line.iteration])

    whole = scene_hash(advance(state, views, render=watching(), on_step=keep).scene)
    for at, path in paths.items():
        again, threads = load_state(path)
        assert threads == torch.get_num_threads()
        assert again.iteration == at
        assert scene_hash(advance(again, views, render=watching()).scene) == whole
    assert (
        scene_hash(fit(views, start, render=watching(), config=config, seed=6).scene)
        != whole
    )


def test_files_that_are_no_checkpoints_say_why(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    old = save(
        {"gradient": torch.zeros(1)}, metadata={"notes": json.dumps({"extent": 1.0})}
    )
    contents = {
        None: "nothing there",
        b"\x05" * 100: "a checkpoint of this version",
        old: "got format 1; end it with",
    }
    for content, words in contents.items():
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(CheckpointError, match=words):
            load_state(path)


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after two steps of three, with an evaluation."""
    _, views, start = scene_and_views(8)
    config = dataclasses.replace(SHORT, iterations=3, eval_interval=1)
    state = TrainState(start, config, scene_extent=scene_extent(views), seed=5)
    path = tmp_path_factory.mktemp("begun") / "state.safetensors"

    def keep(line: Progress) -> None:
        if line.iteration == 2:
            save_state(state, path)

    advance(state, views, render=watching(), held_out=views[:1], on_step=keep)
    return path


BROKEN: dict[str, tuple[Change, str]] = {
    "a parameter of NaN": (
        lambda n, t: t["parameters/means"][1].fill_(torch.nan),
        "finite numbers in parameters/mea",
    ),
    "a parameter of one row": (
        lambda n, t: t.update({"parameters/scales": torch.zeros(1, 3)}),
        "parameters, scales",
    ),
    "no means": (
        lambda n, t: t.pop("parameters/means"),
        "means: expected at least one row",
    ),
    "a moment of another shape": (
        lambda n, t: t.update({"exp_avg/sh0": torch.zeros(2)}),
        "exp_avg: expected",
    ),
    "a strategy of other rows": (
        lambda n, t: t.update({"strategy/grad2d": torch.zeros(3)}),
        "strategy, grad2d",
    ),
    "no generator": (
        lambda n, t: t.pop("generator"),
        "the state of a generator, got none",
    ),
    "a negative view": (
        lambda n, t: n.update(view_queue=[-1]),
        "view_queue: expected whole numbers from 0",
    ),
    "steps after the last": (
        lambda n, t: n.update(iteration=4),
        "iteration: expected a whole number from 0 to 3",
    ),
    "a history of something else": (
        lambda n, t: n["history"][0].update(loss="low"),
        "loss: expected a number",
    ),
    "an extent of zero": (
        lambda n, t: n.update(scene_extent=0),
        "scene_extent: expected a number above 0",
    ),
    "a strategy in words": (
        lambda n, t: n["config"].update(strategy="classic"),
        "a checkpoint of this version",
    ),
    "another setting": (
        lambda n, t: n["config"].update(more=1),
        "settings: expected settings that this version",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_checkpoints_whose_parts_do_not_fit_are_refused(
    begun: Path, name: str, tmp_path: Path
) -> None:
    change, words = BROKEN[name]
    path = tmp_path / "state.safetensors"
    shutil.copy(begun, path)
    assert load_state(path)[0].iteration == 2
    changed(path, change)
    with pytest.raises(CheckpointError, match=words):
        load_state(path)
