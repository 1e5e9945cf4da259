"""Several detectors at once: the loss of all, a verdict of each, and one detector as if
there were no ensemble.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from attacks.dagger.attack import attack, problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.views import FixedViews
from attacks.detectors.base import Detector
from attacks.objectives.relabel import relabel
from attacks.search.loop import Evaluation
from mi_splat.cameras.camera import View, look_at
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from tests.datasets.sets import write_transforms
from tests.fakes import (
    CoarseDetector,
    ColourDetector,
    blobs,
    camera,
    register,
    toy_scene,
)

FINE = ColourDetector()
COARSE = CoarseDetector()


def run(detectors: Any, **settings: Any) -> Result:
    scene, mask = toy_scene()
    config = DaggerConfig(**{"eps": (12.0,), "noise_draws": 1, **settings})
    return attack(
        scene,
        mask,
        [camera()],
        detectors,
        relabel("person"),
        render=blobs,
        config=config,
    )


def evaluated(*detectors: Detector) -> Evaluation:
    """The clean object as an attack on these detectors begins."""
    config = DaggerConfig()
    views = FixedViews(*toy_scene(), camera(), render=blobs)
    problem = problem_of(views, detectors, relabel("person"), config)
    return problem.evaluate(
        problem.subset.parameters(("sh",)), views.held_out(config), config
    )


def test_the_loss_is_the_mean_of_the_losses() -> None:
    parts = [evaluated(detector) for detector in (FINE, COARSE)]
    mean = evaluated(FINE, COARSE)
    assert parts[0].loss != parts[1].loss
    assert mean.loss == pytest.approx(sum(part.loss for part in parts) / 2)
    torch.testing.assert_close(
        mean.gradients["sh"], (parts[0].gradients["sh"] + parts[1].gradients["sh"]) / 2
    )


def test_the_command_says_what_each_detector_saw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a set's images for training, of which one shows nothing of the object."""
    scene, _ = toy_scene()
    away = dataclasses.replace(
        camera(), to_world=look_at((0.0, -3.0, 0.0), (0.0, -6.0, 0.0))
    )
    shots = [
        View(one, torch.zeros(32, 32, 3))
        for one in (camera(), away, camera(offset=0.4), camera(offset=0.2))
    ]
    write_transforms(tmp_path / "set", shots[:3], test=shots[3:])
    save_splat(scene, tmp_path / "toy.ply")
    register(monkeypatch, {one.name: one for one in (FINE, COARSE)})
    words = [
        "dagger",
        str(tmp_path / "toy.ply"),
        "--mask",
        str(tmp_path / "mask.npy"),
        "--eps",
        "20",
    ]
    words += ["--cameras", str(tmp_path / "set"), "--noise-draws", "0"]
    words += ["--detectors", FINE.name, COARSE.name]
    np.save(tmp_path / "mask.npy", np.arange(10, 40))
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr()
    assert "1 of 3 images for training do not show the object" in shown.err
    lines = shown.out.splitlines()
    figures = {
        line.split("  ")[0]: line.partition("  ")[2].split()[:3] for line in lines
    }
    assert figures["fake_colour"] == figures["fake_coarse"] == ["2", "of", "2"]


def test_wrong_detectors_are_named() -> None:
    class Cats(ColourDetector):
        name = "fake_cats"
        classes = ("car", "cat", "stop sign")

    with pytest.raises(
        InvalidValueError,
        match="detector: expected one detector, or several with different names",
    ):
        run([FINE, ColourDetector()])
    with pytest.raises(InvalidValueError, match="detector: expected one detector"):
        run([])
    with pytest.raises(
        InvalidValueError,
        match="target of fake_cats: expected one of car, cat, stop sign, got person",
    ):
        run([FINE, Cats()])
