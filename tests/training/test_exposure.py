"""Pictures of different exposures: the maps that undo it, and checkpoints that keep them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from mi_splat.cameras import View
from mi_splat.metrics import psnr
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.checkpoints import CheckpointError, load_state
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import score
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import Progress, advance, fit
from mi_splat.training.resume import train
from mi_splat.training.state import TrainState
from mi_splat.training.strategies import FixedConfig
from tests.io.noted import changed
from tests.training.sets import scene_and_views, views_of, watching

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


def test_the_splat_is_that_of_equal_pictures() -> None:
    truth, equal, exposed = differently_exposed()
    render, start = Renderer(), truth.replace(sh=torch.zeros_like(truth.sh))
    quality = {}
    for config in (PLAIN, EXPOSED):
        scene = fit(exposed, start, render=render, config=config).scene
        with torch.no_grad():
            pairs = [(render(scene, view.camera).clamp(0, 1), view.image) for view in equal]
        quality[config.exposure] = sum(float(psnr(*pair)) for pair in pairs) / len(pairs)
    assert quality[True] > quality[False] + 2, quality


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
    found = score(truth, shown, Renderer(), corrected=True)
    assert found is not None
    assert (found.corrected_psnr or 0) > 60 > 25 > found.psnr
    moved = score(truth, [View(view.camera, view.image.roll(3, 0)) for view in views], Renderer(), corrected=True)
    assert moved is not None
    assert moved.psnr <= (moved.corrected_psnr or 0) < moved.psnr + 6  # colours do not mend what lies elsewhere
