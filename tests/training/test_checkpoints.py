"""Runs on the disk: what is written is what goes on, to the bit."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from mi_splat.cameras import View
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.evaluation import score
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, Progress, TrainState, advance, fit, scene_extent
from mi_splat.training.resume import CheckpointError, load_state, save_state, train
from mi_splat.training.strategies import FixedConfig, MCMCConfig, StrategyConfig
from tests.io.noted import Change, changed
from tests.training.sets import SHORT, scene_and_views, views_of, watching


@pytest.mark.parametrize(
    "strategy",
    [
        SHORT.strategy,
        MCMCConfig(densify_from=10, densify_interval=20, max_gaussians=80, dead_opacity=0.05),
        FixedConfig(),
    ],
    ids=["classic", "mcmc", "fixed"],
)
def test_a_resumed_run_makes_the_same_bits(strategy: StrategyConfig, tmp_path: Path) -> None:
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
    assert scene_hash(fit(views, start, render=watching(), config=config, seed=6).scene) != whole


def test_files_that_are_no_checkpoints_say_why(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    old = save({"gradient": torch.zeros(1)}, metadata={"notes": json.dumps({"extent": 1.0})})
    contents = {None: "nothing there", b"\x05" * 100: "a checkpoint of this version", old: "got format 1; end it with"}
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
    "a parameter of NaN": (lambda n, t: t["parameters/means"][1].fill_(torch.nan), "finite numbers in parameters/mea"),
    "a parameter of one row": (lambda n, t: t.update({"parameters/scales": torch.zeros(1, 3)}), "parameters, scales"),
    "no means": (lambda n, t: t.pop("parameters/means"), "means: expected at least one row"),
    "a moment of another shape": (lambda n, t: t.update({"exp_avg/sh0": torch.zeros(2)}), "exp_avg: expected"),
    "a strategy of other rows": (lambda n, t: t.update({"strategy/grad2d": torch.zeros(3)}), "strategy, grad2d"),
    "no generator": (lambda n, t: t.pop("generator"), "the state of a generator, got none"),
    "a negative view": (lambda n, t: n.update(view_queue=[-1]), "view_queue: expected whole numbers from 0"),
    "steps after the last": (lambda n, t: n.update(iteration=4), "iteration: expected a whole number from 0 to 3"),
    "a history of something else": (lambda n, t: n["history"][0].update(loss="low"), "loss: expected a number"),
    "an extent of zero": (lambda n, t: n.update(scene_extent=0), "scene_extent: expected a number above 0"),
    "a strategy in words": (lambda n, t: n["config"].update(strategy="classic"), "a checkpoint of this version"),
    "another setting": (lambda n, t: n["config"].update(more=1), "settings: expected settings that this version"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_checkpoints_whose_parts_do_not_fit_are_refused(begun: Path, name: str, tmp_path: Path) -> None:
    change, words = BROKEN[name]
    path = tmp_path / "state.safetensors"
    shutil.copy(begun, path)
    assert load_state(path)[0].iteration == 2
    changed(path, change)
    with pytest.raises(CheckpointError, match=words):
        load_state(path)


# Pictures of different exposures: the maps that undo it, and checkpoints that keep them


PLAIN = FitConfig(
    iterations=400,
    sh_degree=1,
    sh_degree_interval=0,
    eval_interval=0,
    strategy=FixedConfig(),
    trainable=("sh",),
    lr_sh=2e-2,
)
EXPOSED = dataclasses.replace(PLAIN, exposure=True)


def differently_exposed() -> tuple[GaussianScene, list[View], list[View]]:
    """The truth, pictures of it, and as a phone takes them: 0.7 to 1.3 times as bright, with other whites."""
    truth, views = views_of(9)
    exposed = []
    for number, view in enumerate(views):
        gain, tint = (0.7, 1.3, 1.0)[number % 3], (0.1, 0.0, -0.1)[number // 3]
        white = torch.tensor([1 + tint, 1.0, 1 - tint])
        exposed.append(View(view.camera, (0.7 * gain * white * view.image).clamp(0, 1)))
    return truth, [View(view.camera, 0.7 * view.image) for view in views], exposed


def test_the_mean_of_the_maps_stays_the_identity() -> None:
    _, views, start = scene_and_views()
    state = TrainState(start, dataclasses.replace(EXPOSED, iterations=2), scene_extent=1.0, seed=0)
    advance(state, views[:3], render=Renderer())
    assert state.exposures is not None
    torch.testing.assert_close(state.exposures.values.mean(0), torch.eye(3, 4))
    (unseen,) = state.view_queue
    seen = [index for index in range(3) if index != unseen]
    assert not torch.equal(state.exposures.values[seen[0]], state.exposures.values[seen[1]])


def test_a_run_goes_on_to_the_bit(tmp_path: Path) -> None:
    truth, _, exposed = differently_exposed()
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    config = dataclasses.replace(EXPOSED, iterations=12)

    def stop(line: Progress) -> None:
        if line.iteration == 8:
            raise KeyboardInterrupt

    whole = train(exposed, start, tmp_path / "whole", render=watching(), config=config, every=100)
    with pytest.raises(KeyboardInterrupt):
        train(exposed, start, tmp_path / "half", render=watching(), config=config, every=7, on_step=stop)
    resumed = train(exposed, start, tmp_path / "half", render=watching(), config=config, every=7)
    assert scene_hash(resumed.scene) == scene_hash(whole.scene)
    states = [load_state(tmp_path / name / "checkpoint.safetensors")[0] for name in ("whole", "half")]
    one, other = (state.exposures.tensors() for state in states if state.exposures is not None)
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(one["maps"][0], torch.eye(3, 4))
    file = tmp_path / "half" / "checkpoint.safetensors"
    changed(file, lambda notes, tensors: tensors.update({"exposures/maps": tensors["exposures/maps"][:4]}))
    with pytest.raises(CheckpointError, match="exp_avg"):
        load_state(file)


def test_held_out_views_are_compared_with_their_exposure_too() -> None:
    truth, views, *_ = scene_and_views()
    shown = [View(view.camera, 0.6 * view.image + torch.tensor([0.1, 0.0, 0.2])) for view in views]
    scored = score(truth, shown, Renderer(), corrected=True)
    assert scored is not None
    assert (scored.corrected_psnr or 0) > 60 > 25 > scored.psnr
    moved = score(truth, [View(view.camera, view.image.roll(3, 0)) for view in views], Renderer(), corrected=True)
    assert moved is not None
    assert moved.psnr <= (moved.corrected_psnr or 0) < moved.psnr + 6  # colours do not mend what lies elsewhere
