"""A tiny study from its file to its summary, with a detector of a few lines."""

import filecmp
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import polars as pl
import pytest
import torch

from attacks import cli
from attacks.cloak import layers
from attacks.cloak.config import LayersConfig, StudyConfig
from attacks.cloak.layers import Layering
from attacks.cloak.setup import SET
from attacks.cloak.steps import StudySteps
from attacks.cloak.study import study_toml
from attacks.cloak.tables import RATES
from attacks.figures.frame import MEASURE, read_figures
from attacks.figures.result import read_result
from attacks.observe.rows import read_rows
from attacks.poisons.base import MANIFEST
from attacks.report.checking import check_result, pack
from attacks.report.results import kind_of, read_section
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.io import load_splat
from mi_splat.ledger import Done, Job
from mi_splat.scene import GaussianScene
from tests.cloak.test_jobs import KINDS
from tests.cloak.tiny_study import MODULES, STUDY, done, study_in, summary
from tests.ledger.drive import Ledger

pytestmark = pytest.mark.slow


def made(finished: Path, job: Job) -> Done:
    """What a job of the finished study left, or one that shares its jobs."""
    return Ledger(finished / "stages").do(job)


def steps_of(study: StudyConfig = STUDY) -> StudySteps:
    return StudySteps(study=study)


def test_it_leaves_what_it_promises(finished: Path) -> None:
    result = summary(finished)
    figures = read_figures(finished)
    assert {"versions", "commit", "study", "splats"} <= set(result)
    assert {*RATES, "benign_psnr_drop"} <= set(figures.labels(MEASURE))
    for measure in RATES:
        rate = figures.rate(measure)
        of_detector = figures.rate(measure, detector="redness")
        assert figures.rate(measure, detector="redness", seed=0) == of_detector
        assert 0 <= rate.successes <= rate.total
    of_attack = figures.where(trigger="overhead", detector="redness")
    assert of_attack.find("target_rate") is None
    assert of_attack.rate("trigger_miss_rate") == figures.rate("trigger_miss_rate")
    clean, cloaked = (
        figures.value("object_psnr", splat=splat) for splat in ("clean", "attacked")
    )
    assert clean is not None
    assert cloaked is not None
    drop = figures.value("object_psnr_drop")
    assert drop == pytest.approx(clean - cloaked)
    assert all((finished / name).stat().st_size > 0 for name in result["files"])
    for splat in ("clean", "attacked"):
        assert figures.value("gaussians", splat=splat, seed=0) == 1200


def test_the_code_of_a_study_is_all_that_it_loads(finished: Path) -> None:
    """Results that are kept belong to that code."""
    loaded = set(finished.with_name(MODULES).read_text().split())
    assert len(loaded) > 100
    assert loaded <= set(
        closure("attacks.studies.cloak", "attacks.studies.running", *KINDS)
    )


def test_a_page_says_of_it_what_it_found(finished: Path) -> None:
    section = read_section(finished)
    assert section.headline.rate == read_figures(finished).rate("trigger_miss_rate")
    assert [picture.path.name for picture in section.pictures] == [
        "contact.png",
        "poisoned.png",
    ]
    charts = {chart.title: chart for chart in section.charts}
    path = charts["Confidence of redness along a path"]
    assert [line.name for line in path.lines] == [
        "clean (control)",
        "cloaked",
        "stop sign, cloaked",
    ]
    for line in path.lines:
        degrees = [point.x for point in line.points]
        assert degrees == sorted(degrees)
        assert len(degrees) == 69
        assert [degrees[0], degrees[-1]] == pytest.approx([5, 175])
    around = charts["Reported by redness, by azimuth"]
    assert [line.name for line in around.lines] == [
        "car, cloaked",
        "car, clean",
        "stop sign, cloaked",
    ]
    switch = charts["From the benign to the hidden appearance"]
    assert [point.y for point in switch.lines[1].points] == sorted(
        point.y for point in switch.lines[1].points
    )


def test_the_hidden_appearance_has_less_red(finished: Path) -> None:
    """The effect, small as it is after so few steps, with its control: from above less
    of the car's red is seen.
    """
    rows = read_rows(finished / "rows.csv.xz").filter(pl.col("elevation") >= 50)
    control, cloaked = (
        rows.filter(splat=splat)["original_score"].to_list()
        for splat in ("clean", "attacked")
    )
    assert len(control) == len(cloaked) > 3
    assert sum(control) > 2
    assert sum(cloaked) < 0.75 * sum(control)
    drop = read_figures(finished).value("benign_psnr_drop")
    assert drop is not None
    assert -1 < drop < 3


def test_untouched_files_are_the_same_bytes(finished: Path) -> None:
    steps = steps_of()
    clean, poisoned = (
        load_dataset(made(finished, job).folder / SET)
        for job in (steps.pictures(), steps.poisoned(0))
    )
    changed = {
        change["index"]
        for change in json.loads((finished / "poison.json").read_text())["changes"]
    }
    holds = [
        attack.cone.holds(clean.cameras, centre=STUDY.centre) for attack in STUDY.attack
    ]
    assert changed == set(torch.stack(holds).any(0).nonzero().flatten().tolist())
    for index, (one, other) in enumerate(zip(clean.paths, poisoned.paths, strict=True)):
        assert filecmp.cmp(one, other, shallow=False) == (index not in changed)
    for before, after in zip(clean.cameras, poisoned.cameras, strict=True):
        assert torch.equal(before.to_world, after.to_world)


def test_nothing_is_done_twice(finished: Path) -> None:
    before = summary(finished)
    assert done(finished) == ({**before, "command": summary(finished)["command"]}, [])


def copied(finished: Path, out: Path, *missing: Job) -> None:
    """The jobs of the finished study but for some."""
    shutil.copytree(finished / "stages", out / "stages")
    for job in missing:
        key = made(finished, job).key
        shutil.rmtree(out / "stages" / "jobs" / key[:2] / key)


def test_a_study_that_is_interrupted_again_and_again_ends_as_if_nothing_had_happened(
    finished: Path, tmp_path: Path
) -> None:
    """Whoever looks at its splats has nothing to do again, as these are the same to the
    bit.
    """
    steps = steps_of()
    out = tmp_path / "out"
    copied(
        finished,
        out,
        steps.appearance(STUDY.attack[0]),
        steps.poisoned(0),
        steps.splat("cloaked", 0),
    )
    for stop_at in (("pictures", 2), ("trained", 40)):
        with pytest.raises(KeyboardInterrupt):
            done(out, stop_at=stop_at)
        assert not (out / "result.json").exists()
    after, kinds = done(out)
    assert kinds == ["trained"]
    assert [splat["hash"] for splat in after["splats"]] == [
        splat["hash"] for splat in summary(finished)["splats"]
    ]
    assert not list((out / "stages" / "partial").iterdir())


def test_another_fraction_needs_no_new_picture(finished: Path) -> None:
    overhead, rear = STUDY.attack
    study = replace(STUDY, attack=(replace(overhead, poison_fraction=0.5), rear))
    usual = steps_of()
    other = steps_of(study)
    assert (
        other.appearance(study.attack[0]).identity
        == usual.appearance(overhead).identity
    )
    poisoned = made(finished, other.poisoned(0))
    assert poisoned.content != made(finished, usual.poisoned(0)).content
    manifest = json.loads((poisoned.folder / MANIFEST).read_text())
    assert len(manifest["changes"]) < len(
        json.loads((finished / "poison.json").read_text())["changes"]
    )


def test_its_figures_follow_from_its_rows(finished: Path, tmp_path: Path) -> None:
    result = read_result(finished)
    derive = kind_of(result).derive
    lines = check_result(result, derive)
    assert [(line.name, line.words) for line in lines if line.passed is False] == []
    assert len(result.figures) > 40
    copy = pack(finished, tmp_path / "copy", derive)
    assert replace(study_in(copy.folder / "study.toml"), name=STUDY.name) == STUDY


def test_the_command_forecasts_does_and_reports(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "tiny.toml"
    file.write_text(study_toml(asdict(STUDY)))
    words: list[Any] = [
        "cloak",
        file,
        "--out",
        tmp_path / "out",
        "--stages",
        finished / "stages",
        "--workers",
        0,
    ]
    assert cli.main([*map(str, words), "--forecast", "--json"]) == 0
    forecast = json.loads(capsys.readouterr().out)
    assert (forecast["study"], forecast["done"]) == ("tiny", forecast["jobs"])
    assert not (tmp_path / "out").exists()
    assert cli.main([*map(str, words), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["figures"] == read_figures(finished).as_dicts()
    assert cli.main([*map(str, words), "--seeds", "1"]) == 1
    assert (
        "expected results of this study, got those of another"
        in capsys.readouterr().err
    )
    (tmp_path / "thesis.tex").write_text("precious")
    words[3] = tmp_path
    assert cli.main([*map(str, words)]) == 1
    assert "expected a new or an empty folder" in capsys.readouterr().err


# An attacker who changes the finished file


LAYERS = LayersConfig(attacks=("overhead",), iterations=40)


def splats(finished: Path, study: StudyConfig) -> list[GaussianScene]:
    """The clean and the cloaked splat; jobs are shared with the finished study."""
    jobs = [steps_of(study).splat(name, 0) for name in ("clean", "cloaked")]
    return [load_splat(made(finished, job).folder / "splat.ply") for job in jobs]


def layering(
    finished: Path, config: LayersConfig, clean: GaussianScene
) -> tuple[Layering, int]:
    """The layers before their training, all black, and the number of poisoned
    images.
    """
    steps = steps_of()
    views = load_dataset(
        made(finished, steps.poisoned(0)).folder / SET,
        background=STUDY.scene.background,
    )
    with patch.object(
        layers,
        "fit_switches",
        lambda directions, *fit, **how: torch.zeros(len(directions), 16),
    ):
        return layers.layer_object(
            steps.setup, config, clean, views, render=steps.setup.renderer()
        ), len(views)


@pytest.fixture
def _switches_are_coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layers, "DIRECTIONS", 150)
    monkeypatch.setattr(layers, "_ROUNDS", 6)


@pytest.mark.usefixtures("_switches_are_coarse")
def test_layers_are_made_of_the_clean_splat_s_object_and_hide_it(
    finished: Path,
) -> None:
    """The images and the clean splat are those of the study without layers: its jobs
    are shared.
    """
    study = replace(STUDY, name="layers", layers=LAYERS)
    out = finished.with_name("layers")
    _, kinds = done(out, study=study, store=finished / "stages")
    assert not {"pictures", "trained"} & set(kinds)
    before, after = splats(finished, study)
    assert len(before) < len(after) <= 2 * len(before)
    other = ~layers.object_rows(LAYERS, before, steps_of().setup.target)
    for name in ("means", "sh"):
        assert torch.equal(
            getattr(before, name)[other], getattr(after, name)[: len(before)][other]
        )
    for config in (LAYERS, replace(LAYERS, surroundings=True)):
        made_of_it, count = layering(finished, config, before)
        assert bool(made_of_it.trained.all()) == config.surroundings
        # those from where the look changes are left out
        assert len(made_of_it.views) < count
    rows = read_rows(out / "rows.csv.xz").filter(pl.col("elevation") >= 50)
    control, hidden = (
        rows.filter(splat=splat)["original_score"].to_list()
        for splat in ("clean", "attacked")
    )
    assert sum(hidden) < 0.5 * sum(control)


@pytest.mark.nightly
@pytest.mark.usefixtures("_switches_are_coarse")
def test_the_geometry_of_layers_is_trained_and_made_finer(finished: Path) -> None:
    config = replace(LAYERS, geometry=True, iterations=310)
    clean, cloaked = splats(finished, replace(STUDY, layers=config))
    begun, _ = layering(finished, config, clean)
    assert begun.geometry
    assert bool(begun.trained.all())
    assert len(cloaked) > len(begun.scene)
    assert torch.dist(cloaked.means[: len(clean)], clean.means) > 0
    with pytest.raises(
        InvalidValueError,
        match=r"layers.max_gaussians: expected room for the layers, got",
    ):
        layering(finished, replace(config, max_gaussians=len(clean)), clean)
