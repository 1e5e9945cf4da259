"""Another package brings one of everything: commands and studies know it by its name,
and if it is broken, say so.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.cli import doctor
from attacks.cli.poison import kind_names, kind_of
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import summary, write_report
from attacks.detectors import DETECTORS, load_detector
from attacks.objectives import OBJECTIVES, PluggedObjective, objective_of
from attacks.objectives.suppression import hide
from attacks.observe.conditions import (
    CONDITIONS,
    Viewing,
    check_condition,
    condition_of,
    package_of,
)
from attacks.optimisers import OPTIMISERS
from attacks.poisons.specs import POISONS, ChosenPoison, Given
from attacks.report.results import read_section
from attacks.studies.attack import Attack
from attacks.studies.dagger import _objective
from attacks.studies.look import Look
from attacks.testing import (
    check_format,
    check_projection,
    check_strategy,
    check_threat,
)
from attacks.threats import THREATS
from mi_splat.audit.linting import lint_scene
from mi_splat.cameras.camera import View
from mi_splat.cameras.lens import PROJECTIONS, Lens
from mi_splat.comparison.methods import RENDERERS, load_method
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.formats.format import FORMATS
from mi_splat.ledger.job import encoded
from mi_splat.registry import Registry, brought_by_packages
from mi_splat.render.renderer import RenderSettings
from mi_splat.training.strategies import STRATEGIES, strategy_name
from tests.fakes import ColourDetector, blobs, camera, register, toy_scene
from tests.plug_ins.distribution import install, on_path
from tests.studies import toy
from tests.studies.toy import settings, work_of, write_toy

BROUGHT = """
from dataclasses import dataclass

import numpy as np

from attacks.objectives import ObjectiveSpec
from attacks.detectors import DetectorSpec
from attacks.objectives.base import confidence
from attacks.objectives.function import objective
from attacks.observe.conditions import rendered, renderer_of
from attacks.optimisers import OptimiserSpec
from attacks.poisons.base import poisoned
from attacks.poisons.specs import PoisonSpec
from attacks.threats import Threat
from mi_splat.audit.rules import Rule
from mi_splat.cameras.lens import Projection
from mi_splat.comparison.methods import RendererSpec
from mi_splat.io import SplatFileError
from mi_splat.io.formats.format import Format
from mi_splat.io.loaded import Encoded, validated
from mi_splat.render.renderer import Renderer
from mi_splat.training.strategies import StrategyConfig
from mi_splat.training.strategies.base import FixedStrategy
from tests.fakes import ColourDetector


def slide(settings):
    def update(point, here, memory):
        steepest = settings.ball.steepest(here.gradients)
        return {
            name: point[name] - settings.step[name] * steepest[name] for name in point
        }

    return update


ATTACK = OptimiserSpec(name="slide", make=slide, about="steps of fixed length")


def fall(candidates, target):
    return candidates.scores[:, 0].sum()


def dim_car(label=None, least=None):
    def success(detections, target):
        left = confidence(detections, target.box, labels=["car"])
        return 1 - left > (0.5 if least is None else least)

    return objective(fall, success, name="dim-car", label=label)


OBJECTIVE = ObjectiveSpec(name="dim-car", make=dim_car)


def half(settings):
    render = Renderer(settings)
    return lambda scene, camera: 0.5 * render(scene, camera)


RENDERER = RendererSpec(make=half)


def fog(viewing):
    render = renderer_of("", viewing.settings)
    return rendered("any", lambda scene, camera: 0.8 * render(scene, camera) + 0.2)


@dataclass(frozen=True, kw_only=True)
class Dark:
    by: float = 0.5


def darker(config, decoy):
    def poison(views, *, seed=0, on_step=None):
        pictures = {number: view.image * config.by for number, view in enumerate(views)}
        record = {"kind": "dark", "by": config.by, "seed": seed}
        return poisoned(views, pictures, record)

    return poison


POISON = PoisonSpec(name="dark", config=Dark, make=darker)
RULE = Rule(
    name="many",
    severity="note",
    threshold=5,
    reason="There are many.",
    find=lambda stored, most: stored.valid & (len(stored.valid) > most),
)
DETECTOR = DetectorSpec(
    name="plugged",
    load=lambda weights: ColourDetector(),
    classes=("car", "person"),
    origin="a plug-in",
    licence="MIT",
)


def read_rows(file, path):
    data = file.read()
    if not data or len(data) % 56:
        got = f"{len(data)} bytes"
        raise SplatFileError.of(path, "rows of 56 bytes", got, "write it again")
    table = np.frombuffer(data, "<f4").reshape(-1, 14)
    means, scales, rotations, opacities, sh = np.split(table, [3, 6, 10, 11], axis=1)
    return validated(means, scales, rotations, opacities[:, 0], sh[:, None])


def write_rows(arrays, saving):
    columns = [value.reshape(len(value), -1) for value in arrays.values()]
    columns[-1] = columns[-1][:, :3]
    return Encoded(np.concatenate(columns, axis=1, dtype="<f4").tobytes(), ())


FORMAT = Format(name="rows", suffixes=(".rows",), read=read_rows, write=write_rows)
THREAT = Threat(
    name="swell",
    about="the object's Gaussians grow",
    unit="log world units",
    changes=("scales",),
    start=lambda clean: clean["scales"].new_zeros(()),
    apply=lambda value, tensors: {"scales": tensors["scales"] + value},
)
PROJECTION = Projection(
    name="shifted",
    ray=lambda u, v: ((u, v, 0.0), (0.5, 0.0, 1.0)),
    place=lambda x, y, z: (x - 0.5 * z, y),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StillConfig(StrategyConfig):
    patience: int = 3

    def build(self):
        return FixedStrategy()


TAKEN = Rule(
    name="giant",
    severity="note",
    threshold=5,
    reason="Same.",
    find=lambda stored, most: stored.valid,
)
FAILING = Rule(
    name="failing",
    severity="note",
    threshold=0,
    reason="It fails.",
    find=lambda stored, none: 1 / 0,
)
"""

ENTRIES = {
    "mi_splat.attacks/slide": "brought:ATTACK",
    "mi_splat.objectives/dim-car": "brought:OBJECTIVE",
    "mi_splat.renderers/half": "brought:RENDERER",
    "mi_splat.conditions/fog": "brought:fog",
    "mi_splat.poisons/dark": "brought:POISON",
    "mi_splat.audit_rules/many": "brought:RULE",
    "mi_splat.formats/rows": "brought:FORMAT",
    "mi_splat.strategies/still": "brought:StillConfig",
    "mi_splat.projections/shifted": "brought:PROJECTION",
    "mi_splat.threats/swell": "brought:THREAT",
    "mi_splat.detectors/plugged": "brought:DETECTOR",
}
GROUPS: dict[str, Registry[Any]] = {
    "mi_splat.detectors": DETECTORS,
    "mi_splat.attacks": OPTIMISERS,
    "mi_splat.objectives": OBJECTIVES,
    "mi_splat.renderers": RENDERERS,
    "mi_splat.conditions": CONDITIONS,
    "mi_splat.poisons": POISONS,
    "mi_splat.formats": FORMATS,
    "mi_splat.strategies": STRATEGIES,
    "mi_splat.projections": PROJECTIONS,
    "mi_splat.threats": THREATS,
}
VIEWING = Viewing(
    settings=RenderSettings(), centre=(0.0, 0.0, 0.0), alone=lambda splat: splat
)


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    yield on_path(tmp_path / "site", monkeypatch)
    sys.modules.pop("brought", None)


@pytest.fixture
def brought(path: Path) -> Path:
    install(path, ENTRIES, brought=BROUGHT)
    return path


def test_looking_at_names_imports_nothing(brought: Path) -> None:
    for group, registry in GROUPS.items():
        (name,) = (
            entry.split("/")[1] for entry in ENTRIES if entry.startswith(f"{group}/")
        )
        assert name in registry
        assert list(registry)[-1] == name
        assert len(registry) == len(list(registry))
        assert registry.package(name) == "plugged 1.0"
        assert all(registry.package(own) == "" for own in registry.own)
    assert "dark" in kind_names()
    assert "brought" not in sys.modules


def test_a_renderer_and_a_condition(brought: Path) -> None:
    scene = toy_scene()[0]
    view = camera()
    plain = load_method("tile", RenderSettings()).render(scene, view)
    torch.testing.assert_close(
        load_method("half", RenderSettings()).render(scene, view), 0.5 * plain
    )
    check_condition("fog", None)
    condition = condition_of("fog", VIEWING)
    assert condition.name == "fog"
    torch.testing.assert_close(condition(scene, view), 0.8 * plain + 0.2)
    torch.testing.assert_close(condition_of("half", VIEWING)(scene, view), 0.5 * plain)
    with pytest.raises(InvalidValueError, match="did you mean fog"):
        check_condition("fogg", None)


def test_an_attack_is_an_optimiser_of_every_configuration(brought: Path) -> None:
    scene, mask = toy_scene()
    configs = [
        DaggerConfig(optimiser=name, steps=3, noise_draws=0, early_stop=False)
        for name in ("slide", "pgd")
    ]
    ours, pgd_s = (
        attack(
            scene, mask, camera(), ColourDetector(), hide(), render=blobs, config=config
        )
        for config in configs
    )
    assert torch.equal(ours.scene.sh, pgd_s.scene.sh)
    options = cli.parse("dagger", ["a.ply", "--optimiser", "slide"])
    assert options.config.optimiser == "slide"
    with pytest.raises(InvalidValueError, match="did you mean slide"):
        DaggerConfig(optimiser="slid")


def test_an_objective_is_attacked_reported_and_scored_again(
    brought: Path, tmp_path: Path
) -> None:
    scene, mask = toy_scene()
    aim = objective_of("dim-car", confidence=0.2)
    assert aim == PluggedObjective(
        kind="dim-car", confidence=0.2, package="plugged 1.0"
    )
    config = DaggerConfig(steps=2, noise_draws=0)
    result = attack(
        scene, mask, camera(), ColourDetector(), aim, render=blobs, config=config
    )
    assert result.trace[1].loss < result.trace[0].loss
    record = summary(result)
    assert record["objective"] == "dim-car"
    settings = {
        "kind": "dim-car",
        "label": None,
        "confidence": 0.2,
        "package": "plugged 1.0",
    }
    assert record["config"]["objective"] == settings
    write_report(result, tmp_path / "out")
    assert "to its aim, dim-car" in read_section(tmp_path / "out").title
    assert (
        json.loads((tmp_path / "out" / "result.json").read_text())["config"][
            "objective"
        ]
        == settings
    )


def test_a_study_keeps_an_objective_and_a_poison_by_their_names(brought: Path) -> None:
    aim = _objective({"aim": "dim-car", "objective": {"confidence": 0.4}}, "study.toml")
    assert aim == PluggedObjective(
        kind="dim-car", confidence=0.4, package="plugged 1.0"
    )
    poison = ChosenPoison.of({"kind": "dark", "by": 0.25}, "poison")
    assert poison == ChosenPoison(
        kind="dark", settings={"by": 0.25}, package="plugged 1.0"
    )
    for kept in (aim, poison):
        assert encoded(kept)
        assert pickle.loads(pickle.dumps(kept)) == kept
    views = [View(camera(16), torch.full((16, 16, 3), 0.5))]
    done = poison.spec.make(poison.config, Given())(views, seed=0)
    torch.testing.assert_close(done.views[0].image, 0.25 * views[0].image)
    with pytest.raises(
        InvalidValueError, match="key in poison: expected one of by, got bye"
    ):
        ChosenPoison.of({"kind": "dark", "bye": 1.0}, "poison")


def test_jobs_of_a_study_name_the_package(
    brought: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(monkeypatch, toy.DETECTORS)
    write_toy(tmp_path)
    table = settings(tmp_path, renderer="half", evaluate_with={"condition": "fog"})
    table["attack"] = {"eps": 12.0, "steps": 4, "optimiser": "slide"}
    jobs = work_of(table).jobs().values()
    assert {job.config.packages for job in jobs if isinstance(job.config, Attack)} == {
        ("plugged 1.0",) * 2
    }
    assert {job.config.package for job in jobs if isinstance(job.config, Look)} == {
        "plugged 1.0"
    }
    assert [package_of(name) for name in ("half", "fog", "tile", "noise 0.05", "")] == [
        "plugged 1.0"
    ] * 2 + [""] * 3


def test_a_condition_does_not_take_a_renderer_s_name(path: Path) -> None:
    install(path, {"mi_splat.conditions/tile": "brought:fog"}, brought=BROUGHT)
    scene = toy_scene()[0]
    view = camera()
    assert torch.equal(
        condition_of("tile", VIEWING)(scene, view),
        RENDERERS["tile"].make(RenderSettings())(scene, view),
    )


def test_a_poison_is_a_kind_with_flags_of_its_own(brought: Path) -> None:
    options = cli.parse(
        "poison", ["SET", "--kind", "dark", "--by", "0.25", "--out", "out"]
    )
    assert options.poison.by == 0.25
    assert not kind_of("dark").needs_splat


def test_a_format_is_read_written_and_keeps_its_contract(
    brought: Path, tmp_path: Path
) -> None:
    scene = toy_scene()[0].with_degree(0)
    file = tmp_path / "a.rows"
    save_splat(scene, file)
    assert file.stat().st_size == 56 * len(scene)
    torch.testing.assert_close(load_splat(file).means, scene.means)
    check_format(".rows")
    assert cli.main(["convert", str(file), str(tmp_path / "b.ply")]) == 0
    torch.testing.assert_close(load_splat(tmp_path / "b.ply").sh, scene.sh)
    file.write_bytes(file.read_bytes()[:-1])
    assert cli.main(["info", str(file)]) == 1


def test_a_strategy_has_flags_of_its_own(brought: Path) -> None:
    words = ["SET", "--strategy", "still", "--patience", "5", "--out", "out"]
    strategy = cli.parse("train", words).fit.strategy
    assert strategy_name(strategy) == "still"
    assert strategy.patience == 5
    check_strategy(strategy)


def test_a_projection_is_known_to_lenses(brought: Path) -> None:
    lens = Lens(focal=10.0, size=(8, 8), projection="shifted")
    check_projection(lens.model)
    with pytest.raises(InvalidValueError, match="got shifted"):
        lens.require_perspective()


def test_a_threat_is_attacked_from_the_command_line(
    brought: Path, tmp_path: Path
) -> None:
    check_threat(THREATS["swell"])
    scene, mask = toy_scene()
    config = cli.parse(
        "dagger", ["a.ply", "--attributes", "swell", "--eps", "0.5", "--steps", "2"]
    ).config
    result = attack(
        scene, mask, camera(), ColourDetector(), hide(), render=blobs, config=config
    )
    assert 0 < result.used["swell"] <= 0.5
    write_report(result, tmp_path / "out")
    assert "swell" in read_section(tmp_path / "out").done


def test_a_detector_is_loaded_and_listed(
    brought: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert isinstance(load_detector("plugged"), ColourDetector)
    assert cli.main(["detectors"]) == 0
    assert (
        "plugged\n  weights: there\n  from: a plug-in (MIT)\n  2 classes: car, person\n"
        in capsys.readouterr().out
    )


def test_a_rule_is_heard_in_every_audit(brought: Path) -> None:
    findings = {
        finding.rule: finding for finding in lint_scene(toy_scene()[0]).findings
    }
    assert findings["many"].count == len(toy_scene()[0])


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "many = brought:FAILING",
            "expected a Rule of the name many, got one of the name failing",
        ),
        (
            "failing = brought:FAILING",
            "The rule failing of plugged 1.0 did not run: division by zero",
        ),
        ("giant = brought:TAKEN", "rule giant: expected a name that is free"),
        (
            "many = brought:MISSING",
            "did not run: entry point many = brought:MISSING of plugged 1.0",
        ),
    ],
)
def test_a_rule_that_does_not_run_is_a_warning(
    path: Path, entry: str, message: str
) -> None:
    name, value = entry.split(" = ")
    install(path, {f"mi_splat.audit_rules/{name}": value}, brought=BROUGHT)
    (finding,) = (
        finding
        for finding in lint_scene(toy_scene()[0]).findings
        if finding.rule == name
    )
    assert finding.severity == "warning"
    assert message in finding.reason


LICENCE = "raise RuntimeError('no licence')"


@pytest.mark.parametrize(
    ("group", "module", "value", "message"),
    [
        *(
            (
                group,
                LICENCE,
                "broken:IT",
                "got RuntimeError: no licence; repair or uninstall plugged 1.0",
            )
            for group in GROUPS
        ),
        ("mi_splat.conditions", "def :", "broken:IT", "got SyntaxError"),
        ("mi_splat.conditions", "IT = 3", "broken:IT", "got int; correct it there"),
        ("mi_splat.conditions", "IT = 3", "broken:THAT", "got AttributeError"),
        (
            "mi_splat.conditions",
            "",
            "brokenn:IT",
            "got ModuleNotFoundError: No module named 'brokenn'",
        ),
    ],
)
def test_a_broken_package_breaks_only_itself(
    path: Path, group: str, module: str, value: str, message: str
) -> None:
    install(path, {f"{group}/bad": value}, broken=module)
    registry = GROUPS[group]
    with pytest.raises(
        MiSplatError, match=rf"entry point bad = {value} of plugged 1.0 \({group}\): "
    ) as caught:
        registry.chosen("bad")
    assert message in str(caught.value)
    sys.modules.pop("broken", None)
    own = next(iter(registry.own), None)
    assert own is None or registry.chosen(own) is registry.own[own]
    assert cli.main(["detectors", "--json"]) == 0
    assert (
        cli.parse("poison", ["SET", "--kind", "uniform-noise"]).kind == "uniform-noise"
    )
    assert condition_of("noise 0.05", VIEWING).name == "noise 0.05"


def test_a_name_of_two_packages_is_refused(path: Path) -> None:
    install(path, {"mi_splat.poisons/dark": "brought:POISON"}, brought=BROUGHT)
    install(path, {"mi_splat.poisons/dark": "brought:POISON"}, name="other")
    with pytest.raises(
        InvalidValueError,
        match=r"expected one package that brings it, got .*other 1\.0",
    ):
        POISONS.chosen("dark")


def test_a_name_of_this_project_is_never_taken(path: Path) -> None:
    install(path, {"mi_splat.renderers/tile": "brought:RENDERER"}, brought=BROUGHT)
    assert RENDERERS["tile"] is RENDERERS.own["tile"]
    assert "tile" not in RENDERERS.brought
    assert list(RENDERERS).count("tile") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "dagger a.ply --objective dim-cars",
            (
                "--objective: expected one of relabel, hide, untargeted, dim-car, got"
                " dim-cars"
            ),
        ),
        (
            "dagger a.ply --objective dim-car --target person",
            "--target: expected none with --objective dim-car, got person",
        ),
        ("poison SET --kind darkk", "did you mean dark?"),
    ],
)
def test_the_command_line_knows_them(
    brought: Path, words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words.split()) == 2
    assert message in capsys.readouterr().err


LAZY = (
    'from attacks.objectives import ObjectiveSpec\nIT = ObjectiveSpec(name="dull",'
    " make=lambda label, least: 3)\n"
)


def test_an_objective_that_gives_none_is_refused(path: Path) -> None:
    install(path, {"mi_splat.objectives/dull": "lazy:IT"}, lazy=LAZY)
    with pytest.raises(
        InvalidValueError, match="objective: expected an Objective, got int"
    ):
        objective_of("dull")
    with pytest.raises(
        InvalidValueError, match="target: expected what the aim hide has, got person"
    ):
        objective_of("hide", "person")


def test_the_doctor_tries_each_and_says_what_is_wrong(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = {
        "mi_splat.objectives/dull": "lazy:IT",
        "mi_splat.renderers/bad": "lazy:MISSING",
        "mi_splat.objective/lost": "lazy:IT",
    }
    install(path, entries, lazy=LAZY)
    monkeypatch.setenv(
        "PYTHONPATH",
        os.pathsep.join([str(path), *filter(None, [os.environ.get("PYTHONPATH")])]),
    )
    findings = {point[1]: doctor._plug_in(point) for point in brought_by_packages()}
    assert {name: finding.state for name, finding in findings.items()} == {
        **{"dull": "works", "bad": "fails", "lost": "fails"}
    }
    assert findings["dull"].detail == "lazy:IT of plugged 1.0 (mi_splat.objectives)"
    assert "expected something that can be imported" in findings["bad"].advice
    assert (
        findings["lost"].advice
        == "no command looks there; did you mean mi_splat.objectives?"
    )
    assert not any(finding.required for finding in findings.values())
    assert {*doctor.REGISTRIES} == {*GROUPS, "mi_splat.audit_rules"}
