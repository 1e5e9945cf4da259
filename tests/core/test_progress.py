"""`on_step` of one function: a bar, and curves that TensorBoard reads."""

from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import DaggerConfig, EotConfig, Result, attack, attack_views, relabel
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import View
from mi_splat.errors import MiSplatError
from mi_splat.progress import bar, tensorboard, together
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from tests.dagger.toy import QUICK, toy_views
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard reads out of a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(item.step, item.value) for item in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def attacked_twice(on_step: Any) -> Result:
    """Two runs of two steps on a toy."""
    config = DaggerConfig(steps=2, restarts=2, noise_draws=1, early_stop=False)
    scene, detector = toy_scene()[0], ColourDetector()
    return attack(scene, [0], camera(), detector, relabel("person"), render=blobs, config=config, on_step=on_step)


def test_a_bar_follows_an_attack_and_its_restarts(capsys: pytest.CaptureFixture[str]) -> None:
    with bar(6, "attack") as on_step:
        attacked_twice(on_step)
    last = capsys.readouterr().err.split("\r")[-1]
    assert "attack: 100%" in last
    assert "6/6" in last
    assert "loss" in last


def test_a_bar_follows_numbers_and_is_left_where_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    with bar(text="a\x1b[31m") as on_step:
        on_step(1, 4)
        on_step(3, 4)
    told = capsys.readouterr().err
    assert "3/4" in told.split("\r")[-1]
    assert "\x1b[31m" not in told


def test_training_writes_curves_that_tensorboard_reads(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    views = [
        View(one, torch.rand(16, 16, 3)) for one in hemisphere((0, 0, 0), count=2, distance=4, focal=20, size=(16, 16))
    ]
    heard = list[float]()
    on_step = together(tensorboard(tmp_path), lambda step: heard.append(step.loss))
    config = FitConfig(iterations=3, strategy=FixedConfig())
    fit(views, toy_scene()[0], render=blobs, config=config, held_out=views, on_step=on_step)
    read = curves(tmp_path)
    assert set(read) == {"loss", "gaussians", "psnr", "ssim"}
    assert [step for step, _ in read["loss"]] == [1, 2, 3]
    assert [value for _, value in read["loss"]] == pytest.approx(heard)


def test_an_attack_writes_curves_that_tensorboard_reads(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    result = attacked_twice(tensorboard(tmp_path))
    read = curves(tmp_path)
    both = read["loss"] + read["loss of run 2"]
    assert [step for step, _ in both] == [line.index for line in result.trace]
    assert [loss for _, loss in both] == pytest.approx([line.loss for line in result.trace])
    assert {"score", "share", "score of run 2"} <= set(read)


def test_an_attack_on_drawn_views_does_so_too(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    config = EotConfig(**{**QUICK, "steps": 2})
    on_step = tensorboard(tmp_path)
    result = attack_views(toy_views(), ColourDetector(), relabel("person"), config=config, on_step=on_step)
    assert [step for step, _ in curves(tmp_path)["loss"]] == [line.index for line in result.trace] != []


def test_together_asks_for_an_end_where_one_does() -> None:
    heard = list[object]()
    assert together(lambda step: True, heard.append)(1) is True
    assert together(heard.append)(2) is False
    assert heard == [1, 2]


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MiSplatError, match=r"pip install -e '\.\[tensorboard\]'"):
        tensorboard(tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
