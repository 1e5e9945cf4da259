"""Training folders that go on where they stopped."""

import dataclasses
import json
import os
import signal
from pathlib import Path

import pytest
import torch

from mi_splat.cameras.camera import View
from mi_splat.errors import InvalidValueError
from mi_splat.processes import sigterm_as_interrupt
from mi_splat.scene import scene_hash
from mi_splat.training.evaluation import score
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import Fit, FitConfig, OnStep, Progress
from mi_splat.training.resume import CheckpointError, Keep, best_of, train
from mi_splat.training.strategies import ClassicConfig
from tests.training.sets import views_of, watching

CONFIG = FitConfig(
    iterations=40,
    sh_degree=1,
    sh_degree_interval=10,
    eval_interval=20,
    strategy=ClassicConfig(
        densify_from=5,
        densify_until=15_000,
        densify_interval=10,
        densify_grad_threshold=1e-5,
        opacity_reset_interval=0,
        max_gaussians=80,
    ),
)


def test_a_folder_that_was_interrupted_goes_on(tmp_path: Path) -> None:
    truth, views = views_of()
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    whole = train(
        views,
        start,
        tmp_path / "whole",
        render=watching(),
        config=CONFIG,
        held_out=views[:2],
        every=15,
    )

    def press(line: Progress) -> None:
        if line.iteration == 31:
            os.kill(os.getpid(), signal.SIGTERM)

    broken = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt), sigterm_as_interrupt():
        train(
            views,
            start,
            broken,
            render=watching(),
            config=CONFIG,
            held_out=views[:2],
            on_step=press,
        )
    assert (broken / "checkpoint.safetensors").is_file()
    assert not (broken / "splat.ply").exists()
    seen: list[int] = []
    again = train(
        views,
        start,
        broken,
        render=watching(),
        config=CONFIG,
        held_out=views[:2],
        on_step=lambda p: seen.append(p.iteration),
    )
    assert seen == list(range(32, 41))
    assert scene_hash(again.scene) == scene_hash(whole.scene)
    assert (broken / "splat.ply").read_bytes() == (
        tmp_path / "whole" / "splat.ply"
    ).read_bytes()
    figures = json.loads((broken / "metrics.json").read_text())
    assert [line["iteration"] for line in figures["history"]] == [20, 40]
    assert figures["psnr"] > 15
    assert figures["threads"] == torch.get_num_threads()
    assert (
        json.loads((broken / "config.json").read_text())["config"]["iterations"] == 40
    )


def test_a_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    truth, views = views_of(3)
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    short = dataclasses.replace(CONFIG, iterations=3)
    train(views, start, tmp_path, render=watching(), config=short)
    before = (tmp_path / "splat.ply").read_bytes()
    with pytest.raises(CheckpointError, match="a run with iterations 3 and not 2"):
        train(
            views,
            start,
            tmp_path,
            render=watching(),
            config=dataclasses.replace(CONFIG, iterations=2),
        )
    with pytest.raises(
        CheckpointError, match=r"a run with lambda_dssim 0\.2 and not 0\.5"
    ):
        train(
            views,
            start,
            tmp_path,
            render=watching(),
            config=dataclasses.replace(short, lambda_dssim=0.5),
        )
    others = views_of(4)[1]
    darker = [View(view.camera, 0.5 * view.image) for view in views]
    moved = from_points(truth.means + 0.1, torch.full((50, 3), 0.5))
    for data, begin in ((others, start), (darker, start), (views, moved)):
        with pytest.raises(CheckpointError, match="the same images and start"):
            train(data, begin, tmp_path, render=watching(), config=short)
    with pytest.raises(InvalidValueError, match="positive number of steps"):
        train(views, start, tmp_path, render=watching(), config=short, every=0)
    with pytest.raises(CheckpointError, match="seed 0"):
        train(views, start, tmp_path, render=watching(), config=short, seed=1)
    assert (tmp_path / "splat.ply").read_bytes() == before


def test_another_number_of_threads_is_told(tmp_path: Path) -> None:
    truth, views = views_of(3)
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    short = dataclasses.replace(CONFIG, iterations=3)
    train(views, start, tmp_path, render=watching(), config=short)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        with pytest.warns(UserWarning, match=f"began with {threads} threads"):
            train(views, start, tmp_path, render=watching(), config=short)
    finally:
        torch.set_num_threads(threads)


def test_the_best_evaluation_is_kept_although_a_run_goes_on_and_is_killed(
    tmp_path: Path,
) -> None:
    truth, views = views_of()
    # The held-out view is none that training comes nearer to.
    wrong = View(views[0].camera, 1 - views[0].image)
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    config = dataclasses.replace(CONFIG, eval_interval=5)

    def press(line: Progress) -> None:
        if line.iteration == 23:
            os.kill(os.getpid(), signal.SIGTERM)

    def run(out: Path, keep: Keep, on_step: OnStep | None = None) -> Fit:
        return train(
            views[1:],
            start,
            out,
            render=watching(),
            config=config,
            held_out=[wrong],
            every=15,
            keep=keep,
            on_step=on_step,
        )

    best = run(tmp_path / "whole", "best")
    kept = best_of(best.history)
    assert kept is not None
    assert kept.iteration < config.iterations
    figures = json.loads((tmp_path / "whole/metrics.json").read_text())
    assert figures["kept_iteration"] == kept.iteration
    assert kept.held_out is not None
    assert figures["psnr"] == kept.held_out.psnr
    again = score(best.scene, [wrong], watching())
    assert again is not None
    assert again.psnr == pytest.approx(kept.held_out.psnr, abs=1e-4)

    with pytest.raises(KeyboardInterrupt), sigterm_as_interrupt():
        run(tmp_path / "broken", "best", press)
    resumed = run(tmp_path / "broken", "best")
    assert scene_hash(resumed.scene) == scene_hash(best.scene)

    last = run(tmp_path / "whole", "last")
    figures = json.loads((tmp_path / "whole/metrics.json").read_text())
    assert figures["kept_iteration"] == config.iterations
    assert scene_hash(last.scene) != scene_hash(best.scene)
