"""Starting points, training folders that go on where they stopped, and `mi-splat train`."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from attacks import cli
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera, View
from mi_splat.datasets import has_tests, load_dataset, write_transforms
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.io.points import PointCloud
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.sh import colour_to_dc
from mi_splat.training.checkpoints import CheckpointError, load_state
from mi_splat.training.initialization import from_points, random_points, spacing, with_outliers
from mi_splat.training.loop import FitConfig, Progress, extent_of
from mi_splat.training.resume import train
from mi_splat.training.strategies import ClassicConfig
from tests import oracle

CONFIG = FitConfig(
    iterations=40,
    sh_degree=1,
    sh_degree_interval=10,
    eval_interval=20,
    densification=ClassicConfig(
        densify_from=5, densify_interval=10, densify_grad_threshold=1e-5, opacity_reset_interval=0, max_gaussians=80
    ),
)


def test_spacing_is_the_distance_to_the_nearest() -> None:
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    assert torch.allclose(spacing(grid), torch.ones(64))
    assert torch.allclose(spacing(1000 + 0.01 * grid), torch.full((64,), 0.01), rtol=0.02)
    assert spacing(grid[:1]).tolist() == [1.0]


def test_points_become_round_gaussians_of_their_colour() -> None:
    points, colours = torch.rand(50, 3), torch.rand(50, 3)
    start = from_points(points, colours)
    assert torch.equal(start.means, points)
    assert torch.allclose(start.sh[:, 0], colour_to_dc(colours))
    assert torch.equal(start.scales[:, 0], start.scales[:, 2])
    with pytest.raises(InvalidValueError, match="two of shape"):
        from_points(points, colours[:3])


def views_of(count: int = 6) -> tuple[GaussianScene, list[View]]:
    truth = oracle.random_scene(50, degree=1, seed=9)
    cameras: list[Camera] = orbit((0.0, 0.0, 0.0), count=count, elevation=20.0, distance=4.0, focal=36.0, size=(32, 32))
    with torch.no_grad():
        return truth, [View(camera, Renderer()(truth, camera).clamp(0, 1)) for camera in cameras]


def test_random_points_lie_where_the_cameras_look() -> None:
    _, views = views_of()
    start = random_points(views, 200, seed=3)
    assert float(start.means.mean(0).norm()) < 0.5
    assert float(start.means.abs().max()) <= 2.1  # half of the cameras' distance
    assert torch.equal(start.means, random_points(views, 200, seed=3).means)
    assert not torch.equal(start.means, random_points(views, 200, seed=4).means)


def test_strays_lie_between_cameras_and_points() -> None:
    _, views = views_of()
    cloud = PointCloud(
        torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    )
    found = with_outliers(cloud, views, 50, seed=3)
    assert torch.equal(found.points[:2], cloud.points)
    assert torch.equal(found.colours[:2], cloud.colours)
    eyes = torch.stack([view.camera.position for view in views]).float()
    for place, colour in zip(found.points[2:], found.colours[2:], strict=True):
        point = cloud.points[int(colour[1])]
        way = torch.linalg.norm(place - eyes, dim=1) / torch.linalg.norm(point - eyes, dim=1)
        rest = torch.linalg.norm(place - point) / torch.linalg.norm(point - eyes, dim=1)
        eye = int((way + rest).argmin())
        assert float(way[eye] + rest[eye]) == pytest.approx(1, abs=1e-5)
        assert 0.1 - 1e-5 <= float(way[eye]) <= 0.9 + 1e-5
    assert torch.equal(with_outliers(cloud, views, 50, seed=3).points, found.points)
    assert not torch.equal(with_outliers(cloud, views, 50, seed=4).points, found.points)
    assert torch.equal(with_outliers(cloud, views, 0).points, cloud.points)
    for count, some in ((-1, views), (1, [])):
        with pytest.raises(InvalidValueError, match="count, views and points"):
            with_outliers(cloud, some, count)


def watching() -> Renderer:
    return Renderer(RenderSettings(), screen_gradients=ScreenGradients())


@pytest.fixture
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize(("threads", "step"), [(1, 23), (2, 31)], indirect=["threads"])
def test_a_folder_that_was_interrupted_goes_on(tmp_path: Path, threads: int, step: int) -> None:
    truth, views = views_of()
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    whole = train(views, start, tmp_path / "whole", render=watching(), config=CONFIG, held_out=views[:2], every=15)

    def press(line: Progress) -> None:
        if line.iteration == step:
            os.kill(os.getpid(), signal.SIGINT)

    broken = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt):
        train(views, start, broken, render=watching(), config=CONFIG, held_out=views[:2], on_step=press)
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
    assert seen == list(range(step + 1, 41))
    assert scene_hash(again.scene) == scene_hash(whole.scene)
    assert (broken / "splat.ply").read_bytes() == (tmp_path / "whole" / "splat.ply").read_bytes()
    figures = json.loads((broken / "metrics.json").read_text())
    assert [line["iteration"] for line in figures["history"]] == [20, 40]
    assert figures["psnr"] > 15
    assert figures["threads"] == threads
    assert json.loads((broken / "config.json").read_text())["config"]["iterations"] == 40


def test_a_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    truth, views = views_of(3)
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    short = dataclasses.replace(CONFIG, iterations=3)
    train(views, start, tmp_path, render=watching(), config=short)
    before = (tmp_path / "splat.ply").read_bytes()
    with pytest.raises(CheckpointError, match="iterations 3"):
        train(views, start, tmp_path, render=watching(), config=CONFIG)
    others = views_of(4)[1]
    darker = [View(view.camera, 0.5 * view.image) for view in views]
    moved = from_points(truth.means + 0.1, torch.full((50, 3), 0.5))
    for data, begin in ((others, start), (darker, start), (views, moved)):
        with pytest.raises(CheckpointError, match="the same pictures and start"):
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


def test_a_further_score_is_kept(tmp_path: Path) -> None:
    truth, views = views_of(3)
    start = from_points(truth.means, torch.full((50, 3), 0.5))
    config = dataclasses.replace(CONFIG, iterations=3)
    held_out = views[:2]
    found = train(
        views,
        start,
        tmp_path,
        render=watching(),
        config=config,
        held_out=held_out,
        lpips=lambda a, b: (a - b).abs().max(),
    )
    figures = json.loads((tmp_path / "metrics.json").read_text())
    with torch.no_grad():
        worst = [(Renderer()(found.scene, v.camera).clamp(0, 1) - v.image).abs().max() for v in held_out]
    assert figures["lpips"] == pytest.approx(float(sum(worst)) / 2, rel=1e-5)
    again, _ = load_state(tmp_path / "checkpoint.safetensors")
    assert again.history == list(found.history)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    truth, views = views_of()
    cloud = PointCloud(truth.means, torch.full((50, 3), 0.5))
    write_transforms(tmp_path / "set", views, test=views[:1], points=cloud)
    return tmp_path / "set"


def test_train_command(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["train", str(dataset), "--out", str(out), "--iterations", "20", "--sh-degree", "1"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "splat.ply" in said
    assert "PSNR" in said
    splat = load_splat(out / "splat.ply")
    assert splat.degree == 1
    names = PlyData.read(str(out / "splat.ply"))["vertex"].data.dtype.names
    assert names[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
    assert cli.main([*words, "--json"]) == 0  # nothing is left to do
    assert json.loads(capsys.readouterr().out)["gaussians"] == len(splat)
    assert np.isfinite(json.loads((out / "metrics.json").read_text())["ssim"])


def test_a_set_without_test_pictures_can_be_trained_on(dataset: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    shutil.copytree(dataset, alone)
    (alone / "transforms_test.json").unlink()
    assert has_tests(dataset)
    assert not has_tests(alone)
    assert cli.main(["train", str(alone), "--out", str(tmp_path / "out"), "--iterations", "3"]) == 0
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["held_out_views"] == 0
    assert figures["psnr"] is None


def test_a_set_on_the_disk_is_known_by_its_files(dataset: Path) -> None:
    one = load_dataset(dataset)
    assert one.fingerprint == load_dataset(dataset).fingerprint
    assert one.fingerprint != load_dataset(dataset, background=(1.0, 1.0, 1.0)).fingerprint
    assert one.fingerprint != load_dataset(dataset, downscale=2).fingerprint
    assert one.fingerprint != load_dataset(dataset, split="test").fingerprint


def test_a_training_is_set_up_without_reading_pictures(dataset: Path) -> None:
    views = load_dataset(dataset)
    before, start = extent_of(list(views)), random_points(list(views), 5)
    views = load_dataset(dataset)
    for path in views.paths:
        path.unlink()
    assert extent_of(views) == before
    assert torch.equal(random_points(views, 5).means, start.means)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "none.ply"], "none.ply"),
        (["--random", "0"], "count"),
        (["--outliers", "-1"], "count, views and points"),
        (["--outliers", "5", "--random", "9"], "--outliers: expected a start on the points of the set"),
        (["--trainable", "sh"], "densification"),
        (["--sh-degree", "7"], "sh_degree"),
    ],
)
def test_train_says_what_is_wrong(
    words: list[str], says: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["train", str(dataset), "--out", str(out), *words]) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not out.exists()
