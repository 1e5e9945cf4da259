"""The sanity suite: green on the attack of this project, and red on attacks that are broken on purpose."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.sanity import CHECKS, Attack, Case, Finding, Runs
from attacks.detectors import load_detector
from attacks.detectors.base import Candidates
from attacks.objectives import relabel
from mi_splat.cameras import Camera
from mi_splat.cli import cameras as cli_cameras
from mi_splat.io import save_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import read_scene
from tests.fakes import CoarseDetector, ColourDetector, blobs, camera, register, toy_scene
from tests.project.layers import ROOT


class Reversed(torch.autograd.Function):
    """Nothing, but with the gradient's sign turned."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return -gradients[0]


class FlippedDetector(ColourDetector):
    """Has gradients of the wrong sign."""

    def candidates(self, images: Tensor) -> list[Candidates]:
        turned: Tensor = Reversed.apply(images)
        return super().candidates(turned)


class MaskedDetector(ColourDetector):
    """Has no gradients."""

    def candidates(self, images: Tensor) -> list[Candidates]:
        return super().candidates(images.detach() + 0 * images)


def half_cut(scene: GaussianScene, view: Camera) -> Tensor:
    """A renderer that has no gradient in red and blue."""
    picture = blobs(scene, view)
    return torch.stack([picture[..., 0].detach(), picture[..., 1], picture[..., 2].detach()], -1)


def case(**changes: Any) -> Case:
    scene, mask = toy_scene()
    usual = Case(
        scene=scene,
        mask=mask,
        cameras=(camera(), camera(offset=0.3)),
        detector=ColourDetector(),
        objective=relabel("person"),
        render=blobs,
        config=DaggerConfig(eps=(10.0,), steps=10),
        surrogate=CoarseDetector(),
    )
    return dataclasses.replace(usual, **changes)


def findings_of(make: Attack = attack, checks: str = "", **changes: Any) -> dict[str, Finding]:
    """What the checks of these names find in one view; all checks, in two views, if none is named."""
    names = checks.split()
    runs = Runs(case(**{**({"cameras": (camera(),)} if names else {}), **changes}), make)
    return {name: check(runs) for name, check in CHECKS.items() if not names or name in names}


def red(findings: dict[str, Finding]) -> set[str]:
    return {name for name, one in findings.items() if one.passed is False}


@pytest.fixture(scope="module")
def sane() -> dict[str, Finding]:
    return findings_of()


def test_the_attack_of_this_project_is_sane(sane: dict[str, Finding]) -> None:
    assert red(sane) == set(), [one.figures for one in sane.values() if not one.passed]
    assert len(sane) == 14
    assert all(one.passed for one in sane.values())
    assert sane["renderer_gradient"].values["cosine"] > 0.999
    assert sane["radius"].values["successes"][0] == 0
    assert sane["radius"].values["successes"][-1] == 2


def test_a_flipped_gradient_is_red() -> None:
    broken = findings_of(
        checks="noise radius white_box unbounded renderer_gradient gradient", detector=FlippedDetector()
    )
    assert red(broken) == {"gradient", "radius", "white_box", "unbounded", "noise"}
    assert broken["gradient"].values["cosine"] < -0.9
    assert broken["white_box"].values["attack on fake_coarse"]["successes"] > 0


def test_a_detached_gradient_is_red() -> None:
    broken = findings_of(checks="white_box unbounded gradient zero_gradients", detector=MaskedDetector())
    assert red(broken) == set(broken)
    assert broken["zero_gradients"].values["most"] == 1.0


def test_a_renderer_without_half_of_its_gradient_is_red() -> None:
    broken = findings_of(checks="renderer_gradient gradient", render=half_cut)
    assert red(broken) == set(broken)


def broken_by(**changes: Any) -> Attack:
    """The attack, which secretly takes other settings than it says; numbers are factors on its own."""

    def make(*arguments: Any, render: Any, config: DaggerConfig) -> Result:
        settings = {name: value(config) if callable(value) else value for name, value in changes.items()}
        other = dataclasses.replace(config, **settings)
        return dataclasses.replace(attack(*arguments, render=render, config=other), config=config)

    return make


def test_an_attack_that_ignores_its_ball_is_red() -> None:
    broken = findings_of(broken_by(eps=(40.0,)), checks="radius budget")
    assert red(broken) == {"budget", "radius"}


def test_an_attack_that_changes_other_gaussians_is_red() -> None:
    def make(scene: GaussianScene, mask: Tensor, *arguments: Any, **settings: Any) -> Result:
        wider = mask.clone()
        wider[0] = True
        result: Result = attack(scene, wider, *arguments, **settings)
        return result

    broken = findings_of(make, checks="noise budget")
    assert red(broken) == {"budget"}
    assert broken["budget"].values["other_gaussians_changed"] > 0


def test_an_attack_that_random_points_beat_is_red() -> None:
    broken = findings_of(checks="random_search square", detector=FlippedDetector())
    assert red(broken) == set(broken), broken


class NoisyDetector(ColourDetector):
    """Never says the same twice."""

    looks = 0

    def candidates(self, images: Tensor) -> list[Candidates]:
        self.looks += 1
        return super().candidates(images + 1e-3 * self.looks)


def test_a_detector_that_is_random_is_red() -> None:
    assert red(findings_of(checks="repeatable", detector=NoisyDetector())) == {"repeatable"}


def test_lines_that_mean_nothing_to_an_attack_are_grey() -> None:
    config = DaggerConfig(eps=(10.0,), steps=10, optimiser="square")
    greys = findings_of(checks="unbounded zero_gradients", config=config)
    assert {finding.colour for finding in greys.values()} == {"grey"}


def test_an_attack_that_keeps_another_point_than_the_best_is_red() -> None:
    def make(*arguments: Any, **settings: Any) -> Result:
        result: Result = attack(*arguments, **settings)
        return dataclasses.replace(result, best=result.trace[0])

    broken = findings_of(make, checks="more_steps")
    assert red(broken) == {"more_steps"}
    assert broken["more_steps"].values["passed_over"] > 0


def test_an_attack_that_noise_beats_is_red() -> None:
    scene, mask = toy_scene()
    green = scene.sh.clone()
    green[mask, 0] = green[mask, 0][:, [1, 0, 2]]  # what it wants is there already
    broken = findings_of(checks="clean noise radius", scene=scene.replace(sh=green))
    assert red(broken) == {"clean", "noise", "radius"}


class TestCommand:
    """The command, on the toy scene."""

    WORDS = ("--mask", "mask.npy", "--eps", "10", "--steps", "8", "--seeds", "2")
    VIEW = ("--distance", "3", "--fov", "50", "--size", "32")

    @pytest.fixture(autouse=True)
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        save_splat(toy_scene()[0], tmp_path / "toy.ply")
        np.save(tmp_path / "mask.npy", np.arange(10, 40))
        monkeypatch.chdir(tmp_path)
        known = {"fasterrcnn_small": ColourDetector(), "other": CoarseDetector(), "flipped": FlippedDetector()}
        register(monkeypatch, known)
        monkeypatch.setattr(cli_cameras, "Renderer", lambda settings: blobs)

    def call(self, *words: str) -> int:
        return cli.main(["dagger", "--sanity", "toy.ply", *self.WORDS, *self.VIEW, "--out", "out", *words])

    def few(self, monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
        monkeypatch.setattr("attacks.dagger.sanity.CHECKS", {name: CHECKS[name] for name in names})

    def test_all_green(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.few(monkeypatch, "clean", "white_box", "renderer_gradient")
        assert self.call("--surrogate", "other") == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[-1].startswith("0 of 3 lines are red")
        assert all(line.startswith("green") for line in lines[:-1])
        text = Path("out/sanity.md").read_text()
        assert "| green | has gradients of the renderer" in text
        values = json.loads(Path("out/result.json").read_text())
        assert (values["passed"], values["surrogate"], len(values["checks"])) == (True, "fake_coarse", 3)
        assert values["selection"] == {"mask": "mask.npy"}
        assert list(recorded_cameras(Path("out/result.json")) or ()) == ["orbit"]

    def test_red_lines_are_said_and_end_with_one(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.few(monkeypatch, "clean", "gradient")
        assert self.call("--detectors", "flipped", "--surrogate", "none", "--json") == 1
        values = json.loads(capsys.readouterr().out)
        assert values["passed"] is False
        assert "gradient" in {one["check"] for one in values["checks"] if one["colour"] == "red"}
        assert self.call("--seeds", "0", "--force") == 2
        assert "--seeds: expected a number >= 1" in capsys.readouterr().err


@pytest.mark.nightly
def test_the_gradients_of_the_shipped_scene_are_those_of_the_chain() -> None:
    loaded = read_scene(ROOT / "scenes" / "car_street.xml")
    shipped = Case(
        scene=loaded.scene,
        mask=loaded.objects["car"],
        cameras=tuple(loaded.cameras.values())[:1],
        detector=load_detector("fasterrcnn_small"),
        objective=relabel("person"),
        render=Renderer(loaded.settings),
        config=DaggerConfig(),
    )
    names = ("renderer_gradient", "gradient")
    renderer, chain = (CHECKS[name](Runs(shipped)) for name in names)
    assert renderer.passed, renderer.figures
    assert renderer.values["cosine"] > 0.9999
    assert chain.passed, chain.figures
